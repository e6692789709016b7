"""Where the desired formation is, how fast its places move, and the shapes of its chain of triangles."""

import math
from functools import lru_cache
from typing import NamedTuple

from maniple.core.geometry import Pose
from maniple.core.scenario.types import Leg, Point, Positioning, Samples, Scenario, Sequence, Task
from maniple.core.scenario.ways import speed_at, way_of


class Shape(NamedTuple):
    """The desired shape of one triangle R1 R2 R3 of the chain, eq. (4); lengths in m."""

    robots: tuple[str, str, str]
    p: float
    """From R1 to R2."""
    q: float
    """From R1 to R3."""
    beta: float
    """Angle (rad) from R1R2 to R1R3, counter-clockwise, in (-pi, pi]."""
    median: float
    """From R1 to the middle between R2 and R3."""
    height: float
    """Smallest height of the triangle: 0 for three robots in a line."""


def legs_of(task: Task) -> tuple[Leg, ...]:
    """The parts of a task: those of a sequence, or the one it is."""
    return task.tasks if isinstance(task, Sequence) else (task,)


def start_pose(task: Task) -> Pose:
    """Where the formation's frame is when the task begins, for positioning where the robots are placed.

    Raises:
        ScenarioError: it is in a file that has not been loaded.
    """
    first = legs_of(task)[0]
    if isinstance(first, Positioning):
        return Pose(*map(float, first.start))
    if isinstance(first, Samples):
        return Pose(*map(float, first.poses[0]))
    return way_of(first).at(0.0)[0]


def end_pose(task: Task) -> Pose:
    """Where the formation's frame is when the task ends.

    Raises:
        ScenarioError: it is in a file that has not been loaded.
    """
    way = way_of(legs_of(task)[-1])
    return way.at(way.travel_s)[0]


def fastest_mps(task: Task, place: Point = (0.0, 0.0)) -> float:
    """Largest speed (m/s) of a place that is fixed in the formation's frame; 0 for positioning. On the
    outside of a turn it is more than the frame's own.

    Raises:
        ScenarioError: a file of the task has not been loaded.
    """
    return max(speed_at(way_of(leg).twists(), place) for leg in legs_of(task))


def fastest_place_mps(scenario: Scenario) -> float:
    """Largest speed (m/s) of the formation's frame and of all its places during the task of a resolved
    scenario."""
    return _fastest_place(scenario.task, scenario.formation.points)


@lru_cache(maxsize=16)
def _fastest_place(task: Task, places: tuple[Point, ...]) -> float:
    twists = [way_of(leg).twists() for leg in legs_of(task)]
    return max(speed_at(one, place) for one in twists for place in ((0.0, 0.0), *places))


def desired_shapes(scenario: Scenario) -> list[Shape]:
    """The n-2 triangles of the chain, in order: triangle j is robots j, j+1 and j+2."""
    ids = [robot.id for robot in scenario.robots]
    points = scenario.formation.points
    shapes = []
    for j in range(len(ids) - 2):
        (x1, y1), (x2, y2), (x3, y3) = points[j : j + 3]
        px, py, qx, qy = x2 - x1, y2 - y1, x3 - x1, y3 - y1
        p, q = math.hypot(px, py), math.hypot(qx, qy)
        cross = px * qy - py * qx
        longest = max(p, q, math.hypot(x3 - x2, y3 - y2))
        shapes.append(
            Shape(
                robots=(ids[j], ids[j + 1], ids[j + 2]),
                p=p,
                q=q,
                beta=math.atan2(cross, px * qx + py * qy),
                median=0.5 * math.hypot(px + qx, py + qy),
                height=abs(cross) / longest if longest > 0.0 else 0.0,
            )
        )
    return shapes
