"""What types can't say about a task: whether it can be followed by the robots of a resolved scenario."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from maniple.core.geometry import wrap
from maniple.core.scenario.places import legs_of
from maniple.core.scenario.types import (
    Csv,
    FigureEight,
    Leg,
    Line,
    Orbit,
    Point,
    Positioning,
    Robot,
    Samples,
    Scenario,
    Task,
    Waypoints,
)
from maniple.core.scenario.types import Sequence as Legs
from maniple.core.scenario.ways import speed_at, way_of

TOLERANCE_M = 0.01
"""What is nearer together than this counts as the same place."""

FARTHEST_M = 10_000.0
"""Ground truth is sent as float32, which resolves 1 mm up to here."""

LONGEST_S = 1e6
"""Of a part of a task."""

SHARPEST_RAD = math.radians(170.0)
"""Of the corners of a way: one that turns back leaves no room for an arc."""

LEAST_STEP_S = 1e-3
"""Between samples."""

MOST_SAMPLES = 20_000
"""Of one way: each process of a run is given all of them."""


def task_problems(scenario: Scenario) -> Iterator[str]:
    """What is wrong with the task of a scenario that is right otherwise: path, value, what would be valid."""
    if found := list(way_problems(scenario.task)):
        yield from found
        return
    for path, leg in _paths(scenario.task):
        yield from _motion_problems(path, leg, scenario)


def way_problems(task: Task) -> Iterator[str]:
    """What is wrong with a task whoever is to do it."""
    for path, leg in _paths(task):
        yield from _leg_problems(path, leg)
        yield from _far_points(path, leg)


def _paths(task: Task) -> Iterator[tuple[str, Leg]]:
    """Every part of a task under its path."""
    for index, leg in enumerate(legs_of(task)):
        yield f"task.tasks[{index}]" if isinstance(task, Legs) else "task", leg


def _leg_problems(path: str, leg: Leg) -> Iterator[str]:
    match leg:
        case Line(start=start, end=end):
            if math.dist(start, end) < TOLERANCE_M:
                yield f"{path}.end = {list(end)}: is where {path}.start is; must be {_apart()}"
        case Waypoints(points=points):
            yield from _corner_problems(f"{path}.points", points)
        case Orbit(radius_m=size) if size < TOLERANCE_M:
            yield f"{path}.radius_m = {size}: must be >= {TOLERANCE_M}"
        case FigureEight(size_m=size) if size < TOLERANCE_M:
            yield f"{path}.size_m = {size}: must be >= {TOLERANCE_M}"
        case Samples():
            yield from _sample_problems(path, leg)
        case Csv(file=file):
            yield f"{path}.file = {file!r}: has not been loaded; must be samples in a resolved scenario"


def _corner_problems(path: str, points: Sequence[Point]) -> Iterator[str]:
    for index, (before, here) in enumerate(pairwise(points)):
        if math.dist(before, here) < TOLERANCE_M:
            where = f"{path}[{index + 1}] = {list(here)}"
            yield f"{where}: is where the point before it is; must be {_apart()}"
            return
    headings = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    for index, (old, new) in enumerate(pairwise(headings)):
        if abs(turn := wrap(new - old)) > SHARPEST_RAD:
            yield (
                f"{path}[{index + 1}] = {list(points[index + 1])}: the way turns back there, by "
                f"{math.degrees(turn):.0f} degrees; must be at most {math.degrees(SHARPEST_RAD):.0f}"
            )


def _sample_problems(path: str, leg: Samples) -> Iterator[str]:
    times = leg.times_s
    if len(times) != len(leg.poses):
        yield f"{path}.poses: there are {len(leg.poses)}; must be {len(times)}, one for each of times_s"
    if len(times) > MOST_SAMPLES:
        yield f"{path}.times_s: there are {len(times)}; must be at most {MOST_SAMPLES}"
    if times[0] != 0.0:
        yield f"{path}.times_s[0] = {times[0]}: must be 0"
    for index, (before, here) in enumerate(pairwise(times)):
        if not here - before >= LEAST_STEP_S:
            where = f"{path}.times_s[{index + 1}] = {here}"
            yield f"{where}: must be at least {LEAST_STEP_S} s after the one before, {before}"
            return


def _far_points(path: str, leg: Leg) -> Iterator[str]:
    for name, point in _extent(leg):
        if max(map(abs, point)) > FARTHEST_M:
            yield f"{path}.{name}: reaches to {list(point)}; must be within {FARTHEST_M:g} m"
            return


def _extent(leg: Leg) -> Iterator[tuple[str, Sequence[float]]]:
    """Points that show how far a leg reaches, and the fields they come from."""
    match leg:
        case Line(start=start, end=end):
            yield from (("start", start), ("end", end))
        case Waypoints(points=points):
            yield from ((f"points[{index}]", point) for index, point in enumerate(points))
        case Orbit(centre=(x, y), radius_m=size):
            yield from (("centre", leg.centre), ("radius_m", (abs(x) + size, abs(y) + size)))
        case FigureEight(centre=(x, y), size_m=size):
            yield from (("centre", leg.centre), ("size_m", (abs(x) + size, abs(y) + size)))
        case Samples(poses=poses):
            yield from ((f"poses[{index}]", pose[:2]) for index, pose in enumerate(poses))
        case Positioning(target=target, start=start):
            yield from (("target", target[:2]), ("start", start[:2]))


def _motion_problems(path: str, leg: Leg, scenario: Scenario) -> Iterator[str]:
    """Ways that take too long, or are too fast for a robot."""
    way = way_of(leg)
    what = f"{path}.times_s" if isinstance(leg, Samples) else f"{path}.speed_mps"
    if not isinstance(leg, Samples | Positioning | Csv):
        what += f" = {leg.speed_mps}"
    if not way.travel_s <= LONGEST_S:
        yield f"{what}: the way takes {way.travel_s:g} s; must be <= {LONGEST_S:g} s"
        return
    twists = way.twists()
    own, turning = speed_at(twists, (0.0, 0.0)), float(abs(twists[:, 2]).max())
    for index, (robot, place) in enumerate(zip(scenario.robots, scenario.formation.points, strict=True)):
        who = f"robots[{index}] ({robot.id})"
        limit, where = speed_limit(scenario, robot)
        if own >= limit:
            yield f"{what}: too fast for {who}; must be < {limit}, the {where}"
        elif (speed := speed_at(twists, place)) >= limit:
            yield (
                f"{what}: too fast for {who}, whose place moves at up to {speed:.3g} m/s on the outside of a "
                f"turn; must be < {limit}, the {where}"
            )
        elif turning >= (most := scenario.model_of(robot).w_max_radps):
            yield (
                f"{what}: the formation turns at up to {turning:.3g} rad/s, too fast for {who}; "
                f"must be < {most}, the w_max_radps of models.{robot.model}"
            )
        else:
            continue
        return


def speed_limit(scenario: Scenario, robot: Robot) -> tuple[float, str]:
    """How fast (m/s) a robot is in the direction it is slowest in, and the parameter that says so."""
    model = scenario.model_of(robot)
    if model.v_max_mps is not None and model.v_max_mps < model.u_max_mps:
        return model.v_max_mps, f"v_max_mps of models.{robot.model}"
    return model.u_max_mps, f"u_max_mps of models.{robot.model}"


def _apart() -> str:
    return f"more than {TOLERANCE_M} m away"
