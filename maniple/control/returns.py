"""What a range finder saw, as distances and bearings from the robot's centre."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maniple.core.geometry import Floats, Pose, wrap, wrap_array
from maniple.core.messages import Scan

_EDGE = math.radians(3.0)
"""A fan that ends this little short of abeam still counts as seeing the whole half-plane."""


class Returns(NamedTuple):
    """The returns of one scan, in the order of the beams; beams that saw nothing are left out."""

    distance: Floats
    """From the robot's centre, m, shape (k,)."""
    bearing: Floats
    """In the robot's frame, rad in (-pi, pi], shape (k,)."""
    sees_ahead: bool
    """Whether the field of view covers everything from abeam right over ahead to abeam left."""
    sees_behind: bool
    """Whether it covers everything from abeam left over behind to abeam right."""


class _Fan(NamedTuple):
    """The beams of a range finder in the robot's frame: all that does not change from scan to scan."""

    x: float
    y: float
    cos: Floats
    sin: Floats
    bearing: Floats
    sees_ahead: bool
    sees_behind: bool


def returns_of(scan: Scan) -> Returns:
    """The returns of a scan, with the mount of the sensor applied.

    `range_max_m` or more is nothing; less than `range_min_m` is something too near to measure and is
    kept as it reads.
    """
    ranges = np.frombuffer(scan.ranges, dtype="<f4")
    fan = _fan(scan.first_angle_rad, scan.increment_rad, len(ranges), scan.mount)
    hit = (ranges < scan.range_max_m).nonzero()[0]
    r = np.maximum(ranges[hit], 0.0, dtype=np.float64)
    if fan.x == 0.0 == fan.y:
        return Returns(r, fan.bearing[hit], fan.sees_ahead, fan.sees_behind)
    x = fan.cos[hit] * r
    x += fan.x
    y = fan.sin[hit] * r
    y += fan.y
    return Returns(np.hypot(x, y), np.arctan2(y, x), fan.sees_ahead, fan.sees_behind)


def moved(returns: Returns, motion: Pose) -> Returns:
    """The same returns seen from where the robot is now, if what they came from stands still.

    `motion` is the robot's present pose in the frame of where it was when it scanned.
    """
    if not any(motion):
        return returns
    x = returns.distance * np.cos(returns.bearing) - motion.x
    y = returns.distance * np.sin(returns.bearing) - motion.y
    return returns._replace(distance=np.hypot(x, y), bearing=wrap_array(np.arctan2(y, x) - motion.psi))


@lru_cache(maxsize=256)
def _fan(first: float, increment: float, count: int, mount: tuple[float, float, float]) -> _Fan:
    angles: Floats = first + mount[2] + increment * np.arange(count, dtype=np.float64)
    return _Fan(
        mount[0],
        mount[1],
        np.cos(angles),
        np.sin(angles),
        wrap_array(angles),
        _covers(first + mount[2], increment, count, -0.5 * math.pi),
        _covers(first + mount[2], increment, count, 0.5 * math.pi),
    )


def _covers(first: float, increment: float, count: int, start: float) -> bool:
    """Whether a fan covers the half turn counter-clockwise from the direction `start`, almost."""
    span = increment * max(count - 1, 0)
    if span + increment * 1.001 >= 2 * math.pi:
        return True
    offset = wrap(start + _EDGE - first)
    return (offset if offset >= 0.0 else offset + 2 * math.pi) + math.pi - 2 * _EDGE <= span
