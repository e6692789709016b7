"""From MAVLink's frames to the project's and back.

The vehicle: north, east, down; yaw clockwise from north. The world: x east, y north; psi counter-clockwise
from x. Positions of two vehicles are comparable once both are given from one point on Earth.
"""

import math
from typing import NamedTuple

from maniple.core.geometry import wrap

METRES_PER_DEGREE = 111_318.845_024_502_15
"""Of latitude, and of longitude at the equator, as ArduPilot reckons (its LOCATION_SCALING_FACTOR)."""

FARTHEST_M = 5000.0
"""Up to this distance of two origins the Earth is taken to be flat. North then differs between them by less
than 0.1 degrees, up to a latitude of 60 degrees."""


class Origin(NamedTuple):
    """A point on Earth as MAVLink has it: two vehicles that were told the same have the same."""

    latitude_e7: int
    """1e-7 degrees."""
    longitude_e7: int
    """1e-7 degrees."""
    altitude_mm: int

    @classmethod
    def of(cls, latitude: float, longitude: float, altitude: float) -> "Origin":
        """From degrees, degrees and metres."""
        return cls(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3))


def east_north(origin: Origin, point: Origin) -> tuple[float, float]:
    """Where `point` lies, seen from `origin` (m, m), on a flat Earth."""
    north = (point.latitude_e7 - origin.latitude_e7) * 1e-7 * METRES_PER_DEGREE
    turned = (point.longitude_e7 - origin.longitude_e7 + 1_800_000_000) % 3_600_000_000 - 1_800_000_000
    between = math.radians(0.5e-7 * (point.latitude_e7 + origin.latitude_e7))
    return turned * 1e-7 * METRES_PER_DEGREE * math.cos(between), north


def pose(
    north: float, east: float, yaw: float, at: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float, float]:
    """(x, y, psi) of a vehicle whose own origin lies `at` (east, north) in the world."""
    return east + at[0], north + at[1], wrap(0.5 * math.pi - yaw)


def north_east_yaw(
    x: float, y: float, psi: float, at: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float, float]:
    """The inverse of `pose`."""
    return y - at[1], x - at[0], wrap(0.5 * math.pi - psi)


def twist(v_north: float, v_east: float, yaw: float, yaw_rate: float) -> tuple[float, float, float]:
    """(u, w, v): forward, counter-clockwise, to the left."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return v_north * cos + v_east * sin, -yaw_rate, v_north * sin - v_east * cos
