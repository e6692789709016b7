"""Whether a resolved scenario stays inside its geofence, as far as that is known before it runs."""

import math
from collections.abc import Iterator
from typing import NamedTuple

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
    looks = min(max(math.ceil(way.length_m / STEP_M), LEAST_LOOKS), MOST_LOOKS) if way.travel_s else 1
    team = _team(scenario)
    worst, told = 1e-9, ""
    for k in range(looks + 1):
        t_s = way.travel_s * k / looks
        middles, known = _middles(way, t_s, team)
        left = inside_by(middles, scenario)
        need = np.where(known, team.at_middle, team.at_place)
        index = int((need - left).argmax())
        if need[index] - left[index] > worst:
            worst, robot = float(need[index] - left[index]), scenario.robots[index]
            x, y = middles[index].tolist()
            told = (
                f"{path}: leads {robot.id} out of guard.fence: after {t_s:.1f} s "
                f"{'the middle of its circle' if known[index] else 'its place'}, [{x:.2f}, {y:.2f}], is "
                f"{_place(float(left[index]))}; must be at least {need[index]:.3g} m inside"
            )
    if told:
        yield told


class _Team(NamedTuple):
    """Of n robots, what does not change on the way; lengths in m."""

    places: Floats
    """In the formation's frame, shape (n, 2)."""
    behind: Floats
    """From the control point back to the middle of the circle, shape (n,)."""
    heads: NDArray[np.bool_]
    """Whether the robot heads where its place goes: not where its heading is free, and not where it is
    decided when the run begins who takes which place."""
    at_middle: Floats
    """How far inside the middle of the circle has to be, shape (n,)."""
    at_place: Floats
    """And the place, if the heading is not known; the least of all robots where any may take it."""


def _team(scenario: Scenario) -> _Team:
    models = [scenario.model_of(robot) for robot in scenario.robots]
    circles = [outline.circle(model) for model in models]
    points = [robot.control_point_m for robot in scenario.robots]
    behind = np.array([point - ahead for point, (ahead, _) in zip(points, circles, strict=True)])
    at_middle = np.array([radius + scenario.guard.margin_m for _, radius in circles])
    at_place = at_middle - np.abs(behind)
    assigned = scenario.planning.method == "given" and not scenario.planning.relabel
    return _Team(
        np.array(scenario.formation.points, dtype=np.float64),
        behind,
        np.array([assigned and model.drive != "omnidirectional" for model in models]),
        at_middle,
        at_place if assigned else np.full_like(at_place, at_place.min()),
    )


def _middles(way: Way, t_s: float, team: _Team) -> tuple[Floats, NDArray[np.bool_]]:
    """Where the middles of the robots' circles are when all are at their places, shape (n, 2), and of which
    that is known; of the others, whose heading is not, the places themselves."""
    frame, (vx, vy, turning) = way.at(t_s)
    c, s = math.cos(frame.psi), math.sin(frame.psi)
    arms = team.places @ np.array([[c, s], [-s, c]])
    velocity = np.array([vx, vy]) + turning * np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    known = team.heads & (speed > _STANDS_MPS)
    back = np.where(known, team.behind / np.maximum(speed, _STANDS_MPS), 0.0)
    middles: Floats = arms + np.array([frame.x, frame.y]) - back[:, None] * velocity
    return middles, known


def inside_by(points: Floats, scenario: Scenario) -> Floats:
    """How far (m) points of shape (k, 2) are inside the fence; negative outside. Shape (k,)."""
    starts = np.array(scenario.guard.fence, dtype=np.float64)
    along = np.roll(starts, -1, axis=0) - starts
    away = points[:, None] - starts
    share = (away * along).sum(axis=2) / (along * along).sum(axis=1)
    gaps = away - np.clip(share, 0.0, 1.0)[..., None] * along
    distance = np.hypot(gaps[..., 0], gaps[..., 1]).min(axis=1)
    north = starts[:, 1] > points[:, None, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        east = away[..., 1] * along[:, 0] / along[:, 1] > away[..., 0]
    crossings = np.count_nonzero((north != np.roll(north, -1, axis=1)) & east, axis=1)
    return np.asarray(np.where(crossings % 2 == 1, distance, -distance))


def _place(left: float) -> str:
    return f"{abs(left):.3g} m {'inside' if left >= 0.0 else 'outside'}"
