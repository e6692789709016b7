"""The task as a reference: where the formation's frame is to be at each moment, and how fast it moves."""

import math
from typing import NamedTuple

from maniple.core.geometry import Pose
from maniple.core.scenario.places import end_pose, start_pose
from maniple.core.scenario.types import Line, Task

REST = (0.0, 0.0, 0.0)
"""The velocity of a reference that stands."""


class Reference(NamedTuple):
    """The desired formation's frame in the formation frame."""

    pose: Pose
    velocity: tuple[float, float, float]
    """(m/s, m/s, rad/s counter-clockwise)."""


def duration_s(task: Task) -> float:
    """How long the task takes: the way, and the rest at its end."""
    return _travel_s(task) + task.settle_s


def reference(task: Task, t_s: float) -> Reference:
    """The reference at task time `t_s`: before 0 at the start, after the way at the end, at rest in both."""
    travel_s = _travel_s(task)
    start = start_pose(task)
    if t_s < 0.0:
        return Reference(start, REST)
    if t_s >= travel_s:
        return Reference(end_pose(task), REST)
    vx, vy = start.rotate(task.speed_mps, 0.0)
    return Reference(Pose(start.x + vx * t_s, start.y + vy * t_s, start.psi), (vx, vy, 0.0))


def _travel_s(line: Line) -> float:
    return math.dist(line.start, line.end) / line.speed_mps
