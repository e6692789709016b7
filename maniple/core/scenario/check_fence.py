"""Whether a resolved scenario stays inside its geofence, as far as that is known before it runs."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maniple.core.geometry import Floats, Pose
from maniple.core.scenario import outline
from maniple.core.scenario.check_task import FARTHEST_M, way_problems
from maniple.core.scenario.places import legs_of
from maniple.core.scenario.types import Leg, Scenario
from maniple.core.scenario.types import Sequence as Legs
from maniple.core.scenario.ways import Way, way_of

STEP_M = 0.1
"""Places are looked at this often along a way,"""
MOST_LOOKS = 2000
"""but not more often than this on one, and"""
LEAST_LOOKS = 50
"""not less."""

_STANDS_MPS = 1e-6


def fence_problems(scenario: Scenario) -> Iterator[str]:
    """What is wrong with the fence, and who would have to leave it: at the start, or to be at its place on
    the way of the task. How the robots get from one part of a task to the next is not known here."""
    corners = scenario.guard.fence
    if not corners:
        return
    found = list(_shape_problems(scenario))
    yield from found or _start_problems(scenario)
    if not found and not list(way_problems(scenario.task)):
        for index, leg in enumerate(legs_of(scenario.task)):
            path = f"task.tasks[{index}]" if isinstance(scenario.task, Legs) else "task"
            yield from _way_problems(path, leg, scenario)


def _shape_problems(scenario: Scenario) -> Iterator[str]:
    """A fence that is no simple polygon."""
    corners = scenario.guard.fence
    if len(corners) < 3:
        yield f"guard.fence: has {len(corners)} corners; must have at least 3, or none for no fence"
        return
    if (sides := outline.self_contact(corners)) is not None:
        i, j = sides
        what = f"edge {i} has no length" if i == j else f"edges {i} and {j} meet"
        yield f"guard.fence: {what}; must be the corners of a simple polygon, in order"
    elif abs(outline.area(corners)) < 1e-9:
        yield "guard.fence: encloses no area; must be a polygon with an inside"
    for index, corner in enumerate(corners):
        if max(map(abs, corner)) > FARTHEST_M:
            yield f"guard.fence[{index}] = {list(corner)}: must be within {FARTHEST_M:g} m"


def _start_problems(scenario: Scenario) -> Iterator[str]:
    """Robots that are not inside when they start."""
    for index, robot in enumerate(scenario.robots):
        assert robot.pose is not None, "the scenario is resolved"
        ahead, radius = outline.circle(scenario.model_of(robot))
        middle = Pose(*robot.pose).compose(Pose(ahead, 0.0, 0.0))
        (left,) = inside_by(np.array([middle[:2]]), scenario)
        if left < radius:
            pose = [round(value, 3) for value in robot.pose]
            yield (
                f"robots[{index}].pose = {pose}: {robot.id} is not inside guard.fence at the start: the "
                f"middle of the circle around its body is {_place(left)}; must be at least {radius:.3g} m "
                "inside"
            )


def _way_problems(path: str, leg: Leg, scenario: Scenario) -> Iterator[str]:
    """A robot whose place on a way is too near the fence for it; the one that is worst off."""
    way = way_of(leg)
    looks = min(max(math.ceil(way.length_m / STEP_M), LEAST_LOOKS), MOST_LOOKS) if way.travel_s else 0
    times = [way.travel_s * k / looks for k in range(looks + 1)] if looks else [0.0]
    needs = _needs(scenario)
    worst, told = 0.0, ""
    for t_s in times:
        middles, known = _middles(way, t_s, scenario)
        left = inside_by(middles, scenario)
        short = np.where(known, needs[1], needs[0]) - left
        index = int(short.argmax())
        if short[index] > max(worst, 1e-9):
            worst, robot = float(short[index]), scenario.robots[index]
            x, y = middles[index].tolist()
            need = (needs[1] if known[index] else needs[0])[index]
            told = (
                f"{path}: leads {robot.id} out of guard.fence: after {t_s:.1f} s "
                f"{'the middle of its circle' if known[index] else 'its place'}, [{x:.2f}, {y:.2f}], is "
                f"{_place(float(left[index]))}; must be at least {need:.3g} m inside"
            )
    if told:
        yield told


def _needs(scenario: Scenario) -> tuple[Floats, Floats]:
    """How far inside its place, whatever its heading, and the middle of its circle have to be for each robot,
    m; for any, the least of all, where it is not known who goes where."""
    at_place, at_middle = [], []
    for robot in scenario.robots:
        ahead, radius = outline.circle(scenario.model_of(robot))
        at_middle.append(radius + scenario.guard.margin_m)
        at_place.append(at_middle[-1] - abs(robot.control_point_m - ahead))
    if _unassigned(scenario):
        at_place = [min(at_place)] * len(at_place)
    return np.array(at_place), np.array(at_middle)


def _middles(way: Way, t_s: float, scenario: Scenario) -> tuple[Floats, NDArray[np.bool_]]:
    """Where the middles of the robots' circles are when all are at their places, shape (n, 2), and of which
    that is known; of the others, whose heading is not, the places themselves."""
    frame, (vx, vy, turning) = way.at(t_s)
    c, s = math.cos(frame.psi), math.sin(frame.psi)
    arms = np.array(scenario.formation.points) @ np.array([[c, s], [-s, c]])
    velocity = np.array([vx, vy]) + turning * np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    models = [scenario.model_of(robot) for robot in scenario.robots]
    steered = np.array([model.drive != "omnidirectional" for model in models])
    known = steered & (speed > _STANDS_MPS) & (not _unassigned(scenario))
    behind = np.array(
        [
            robot.control_point_m - outline.circle(model)[0]
            for robot, model in zip(scenario.robots, models, strict=True)
        ]
    )
    back = np.where(known, behind / np.maximum(speed, _STANDS_MPS), 0.0)
    middles: Floats = arms + np.array([frame.x, frame.y]) - back[:, None] * velocity
    return middles, known


def _unassigned(scenario: Scenario) -> bool:
    """Whether it is decided when the run begins who goes where."""
    return scenario.planning.method != "given" or scenario.planning.relabel


def inside_by(points: Floats, scenario: Scenario) -> Floats:
    """How far (m) points of shape (k, 2) are inside the fence; negative outside. Shape (k,)."""
    starts = np.array(scenario.guard.fence, dtype=np.float64)
    along = np.roll(starts, -1, axis=0) - starts
    away = points[:, None] - starts
    share = (away * along).sum(axis=2) / (along * along).sum(axis=1)
    gaps = away - np.clip(share, 0.0, 1.0)[..., None] * along
    distance = np.hypot(gaps[..., 0], gaps[..., 1]).min(axis=1)
    inside = [outline.inside(scenario.guard.fence, (x, y)) for x, y in points.tolist()]
    return np.asarray(np.where(inside, distance, -distance))


def _place(left: float) -> str:
    return f"{abs(left):.3g} m {'inside' if left >= 0.0 else 'outside'}"
