"""A fence in the world that the circle around a robot's body does not leave.

The fence is a simple polygon. To a robot inside it is as if it saw the nearest point of every edge: an edge
is convex, so however the robot turns, it comes no nearer to it than it goes in the direction of that point.
So the two rules of `clearance` that keep a robot clear of what it sees keep it inside, too, by the same
margin.

To a robot that is outside all the same (it was put there, pushed, or its pose was corrected) it is as if it
overlapped something in the direction that leads farther out: it may go only where that is not, back in.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from maniple.control.returns import Returns
from maniple.core.geometry import Floats, Pose, wrap_array
from maniple.core.scenario import outline
from maniple.core.scenario.types import Point

_ON_M = 1e-9
"""A point that is nearer than this to the fence is on it: it has no direction from there."""


class Fence(NamedTuple):
    """A simple polygon of k edges, the way that it is looked at."""

    x: Floats
    """Of the corners where the edges begin, m, shape (k,)."""
    y: Floats
    along_x: Floats
    """From there to where they end, m."""
    along_y: Floats
    per_square: Floats
    """One by their squared lengths, 1/m^2."""
    outward: Floats
    """Directions out of the polygon, square to the edges, rad."""


def fence_of(corners: Sequence[Point]) -> Fence | None:
    """The fence with these corners (m, in the world), in either order; None for no corners."""
    if not corners:
        return None
    x, y = np.array(corners, dtype=np.float64).T
    along_x, along_y = np.roll(x, -1) - x, np.roll(y, -1) - y
    side = -math.copysign(0.5 * math.pi, outline.area(corners))
    return Fence(
        x,
        y,
        along_x,
        along_y,
        1.0 / (along_x * along_x + along_y * along_y),
        np.arctan2(along_y, along_x) + side,
    )


def seen_from(pose: Pose, fence: Fence) -> Returns:
    """The fence as a range finder at `pose` in the world would see it: from inside, the nearest point of
    every edge. From outside, one return in the direction away from the fence, at minus the distance from it.
    """
    x, y = fence.x - pose.x, fence.y - pose.y
    share = np.clip(-(x * fence.along_x + y * fence.along_y) * fence.per_square, 0.0, 1.0)
    gap_x, gap_y = x + share * fence.along_x, y + share * fence.along_y
    distance, bearing = np.hypot(gap_x, gap_y), np.arctan2(gap_y, gap_x)
    nearest = int(distance.argmin())
    if distance[nearest] < _ON_M:
        distance, bearing = np.zeros(1), fence.outward[nearest : nearest + 1]
    elif not _is_inside(x, y, fence):
        distance, bearing = -distance[nearest : nearest + 1], bearing[nearest : nearest + 1] + math.pi
    return Returns(distance, wrap_array(bearing - pose.psi), True, True)


def is_out(seen: Returns, radius: float) -> bool:
    """Whether a circle of this radius around where the fence was `seen_from` is not inside it."""
    return bool(seen.distance.min() < radius)


def _is_inside(x: Floats, y: Floats, fence: Fence) -> bool:
    """Whether the point that the edges begin (x, y) from is inside: a ray from it to the east leaves an odd
    number of times."""
    crosses = (y > 0.0) != (np.roll(y, -1) > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        east = x - y * fence.along_x / fence.along_y > 0.0
    return bool(np.count_nonzero(crosses & east) % 2)
