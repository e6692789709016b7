"""What a range finder saw, as distances and bearings from the robot's centre."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maniple.core.geometry import Floats, Pose, wrap, wrap_array
from maniple.core.messages import Scan, unpack_floats

_EDGE = math.radians(3.0)
"""A fan that ends this little short of abeam still counts as seeing the whole half-plane."""
_HOLE = math.radians(10.5)
"""Neighbouring cones this little apart count as seeing what is between: what is wider than a fifth of its
distance can't hide there."""


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
    half_cone: float = 0.0
    """Half of the opening angle of a beam, rad: what is on its axis here may be this far off."""


class _Fan(NamedTuple):
    """The beams of a range finder in the robot's frame: all that does not change from scan to scan."""

    x: Floats
    """Where the beams start, m: one number for all, or one for each."""
    y: Floats
    cos: Floats
    sin: Floats
    bearing: Floats
    central: bool
    """Whether all beams start in the robot's centre."""
    sees_ahead: bool
    sees_behind: bool


def returns_of(scan: Scan) -> Returns:
    """The returns of a scan, with the mount of the sensor applied.

    `range_max_m` or more is nothing; less than `range_min_m` is something too near to measure and is
    kept as it reads. What a cone sees is put on its axis; `half_cone` says how wrong that may be.
    """
    ranges = np.frombuffer(scan.ranges, dtype="<f4")
    if scan.beams:
        fan = _array(scan.beams, scan.cone_rad, scan.mount)
        ranges = ranges[: len(fan.cos)]
    else:
        fan = _fan(scan.first_angle_rad, scan.increment_rad, len(ranges), scan.mount)
    half = 0.5 * scan.cone_rad
    hit = (ranges < scan.range_max_m).nonzero()[0]
    r = np.maximum(ranges[hit], 0.0, dtype=np.float64)
    if fan.central:
        return Returns(r, fan.bearing[hit], fan.sees_ahead, fan.sees_behind, half)
    x = fan.cos[hit] * r
    x += fan.x[hit] if scan.beams else fan.x
    y = fan.sin[hit] * r
    y += fan.y[hit] if scan.beams else fan.y
    return Returns(np.hypot(x, y), np.arctan2(y, x), fan.sees_ahead, fan.sees_behind, half)


def moved(returns: Returns, motion: Pose) -> Returns:
    """The same returns seen from where the robot is now, if what they came from stands still.

    `motion` is the robot's present pose in the frame of where it was when it scanned.
    """
    if not any(motion):
        return returns
    x = returns.distance * np.cos(returns.bearing) - motion.x
    y = returns.distance * np.sin(returns.bearing) - motion.y
    return returns._replace(distance=np.hypot(x, y), bearing=wrap_array(np.arctan2(y, x) - motion.psi))


def joined(first: Returns, second: Returns) -> Returns:
    """Both, as of one range finder with the wider beams that sees what both see."""
    return Returns(
        np.concatenate((first.distance, second.distance)),
        np.concatenate((first.bearing, second.bearing)),
        first.sees_ahead and second.sees_ahead,
        first.sees_behind and second.sees_behind,
        max(first.half_cone, second.half_cone),
    )


@lru_cache(maxsize=256)
def _fan(first: float, increment: float, count: int, mount: tuple[float, float, float]) -> _Fan:
    angles: Floats = first + mount[2] + increment * np.arange(count, dtype=np.float64)
    return _Fan(
        np.array([mount[0]]),
        np.array([mount[1]]),
        np.cos(angles),
        np.sin(angles),
        wrap_array(angles),
        mount[0] == 0.0 == mount[1],
        _covers(first + mount[2], increment, count, -0.5 * math.pi),
        _covers(first + mount[2], increment, count, 0.5 * math.pi),
    )


@lru_cache(maxsize=256)
def _array(beams: bytes, cone: float, mount: tuple[float, float, float]) -> _Fan:
    x, y, direction = unpack_floats(beams, 3).T
    place = complex(mount[0], mount[1]) + (x + 1j * y) * np.exp(1j * mount[2])
    bearing = wrap_array(direction + mount[2])
    return _Fan(
        place.real.copy(),
        place.imag.copy(),
        np.cos(bearing),
        np.sin(bearing),
        bearing,
        not place.any(),
        _cones_cover(bearing, 0.5 * cone, -0.5 * math.pi),
        _cones_cover(bearing, 0.5 * cone, 0.5 * math.pi),
    )


def _cones_cover(axes: Floats, half: float, start: float) -> bool:
    """Whether cones about these axes cover the half turn counter-clockwise from `start`, almost."""
    reach = _EDGE - _HOLE
    offsets = wrap_array(axes - start - 0.5 * math.pi) + 0.5 * math.pi
    for offset in sorted(offsets.tolist()):
        if offset - half <= reach + _HOLE:
            reach = max(reach, offset + half)
    return bool(reach >= math.pi - _EDGE)


def _covers(first: float, increment: float, count: int, start: float) -> bool:
    """Whether a fan covers the half turn counter-clockwise from the direction `start`, almost."""
    span = increment * max(count - 1, 0)
    if span + increment * 1.001 >= 2 * math.pi:
        return True
    offset = wrap(start + _EDGE - first)
    return (offset if offset >= 0.0 else offset + 2 * math.pi) + math.pi - 2 * _EDGE <= span
