"""Where the desired formation is: the chain of triangles and their desired shapes."""

import math
from typing import NamedTuple

from maniple.core.geometry import Pose
from maniple.core.scenario.types import Scenario, Task


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


def start_pose(task: Task) -> Pose:
    """Where the formation's frame is when the task begins."""
    return Pose(float(task.start[0]), float(task.start[1]), heading(task))


def end_pose(task: Task) -> Pose:
    """Where the formation's frame is when the task ends."""
    return Pose(float(task.end[0]), float(task.end[1]), heading(task))


def heading(task: Task) -> float:
    """Direction (rad) of travel."""
    (x0, y0), (x1, y1) = task.start, task.end
    return math.atan2(y1 - y0, x1 - x0)


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
