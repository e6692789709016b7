"""Ranges from DISTANCE_SENSOR, a message for each sector of 45 degrees, and from OBSTACLE_DISTANCE, a fan."""

import math
from typing import Any, NamedTuple

import numpy as np

from maniple.core.messages import Scan, pack_floats
from maniple.core.time import MILLISECOND, Duration, Time

SECTORS = 8
"""Orientations 0 to 7 of MAV_SENSOR_ORIENTATION: forward, then clockwise."""

FRESH: Duration = 500 * MILLISECOND
"""A range that is older says nothing about now: a sector that falls silent is not looked at, not free."""

_FRAME_GLOBAL, _FRAME_BODY = 0, 12
_BEAMS = 72
_UNKNOWN = 65535
_INVALID = 1


class _Sector(NamedTuple):
    at: Time
    range_m: float
    min_m: float
    max_m: float
    cone_rad: float


class Ranges:
    """Collects them into scans, at most one each `period`."""

    def __init__(self, period: Duration) -> None:
        self._period = period
        self._sectors: dict[int, _Sector] = {}
        self._fan: tuple[Time, Scan] | None = None
        self._news = False
        self._said: Time | None = None

    def sector(self, message: Any, now: Time) -> None:
        """A DISTANCE_SENSOR has arrived."""
        if not 0 <= message.orientation < SECTORS or message.signal_quality == _INVALID:
            return
        if not 0 <= message.min_distance < message.max_distance:
            return
        fov = message.horizontal_fov
        cone = fov if math.isfinite(fov) and 0.0 < fov <= math.pi else 2.0 * math.pi / SECTORS
        low, high, seen = (
            0.01 * cm for cm in (message.min_distance, message.max_distance, message.current_distance)
        )
        self._sectors[message.orientation] = _Sector(now, seen, low, high, cone)
        self._news = True

    def fan(self, message: Any, yaw: float | None, now: Time) -> None:
        """An OBSTACLE_DISTANCE has arrived, while the vehicle headed to `yaw`, where that is known."""
        step = math.radians(message.increment_f if message.increment_f > 0.0 else message.increment)
        if not (math.isfinite(step) and 0.0 < step <= math.pi and math.isfinite(message.angle_offset)):
            return
        if not 0 <= message.min_distance < message.max_distance or len(message.distances) != _BEAMS:
            return
        turned = -math.radians(message.angle_offset)
        if message.frame == _FRAME_GLOBAL and yaw is not None:
            turned += yaw
        elif message.frame != _FRAME_BODY:
            return
        beams = min(_BEAMS, int(2.0 * math.pi / step + 0.5))
        low, high = 0.01 * message.min_distance, 0.01 * message.max_distance
        known = [index for index in range(beams) if message.distances[index] != _UNKNOWN]
        if not known:
            return
        ranges = [_told(0.01 * message.distances[index], low, high, high) for index in known]
        directions = [math.remainder(turned - step * index, 2.0 * math.pi) for index in known]
        self._fan = now, _scan(directions, ranges, low, high, step)
        self._news = True

    def due(self, now: Time) -> Scan | None:
        """The scan that is due; None where there is nothing new, or one was given just now."""
        if not self._news or (self._said is not None and now - self._said < self._period):
            return None
        scan = self._latest(now)
        if scan is not None:
            self._news, self._said = False, now
        return scan

    def heard(self, now: Time) -> str:
        """What there is, for people."""
        if self._fan is not None and now - self._fan[0] <= FRESH:
            return "OBSTACLE_DISTANCE"
        fresh = sorted(key for key, sector in self._sectors.items() if now - sector.at <= FRESH)
        return f"DISTANCE_SENSOR, sectors {', '.join(map(str, fresh))}" if fresh else "none"

    def _latest(self, now: Time) -> Scan | None:
        """A fan says more than sectors."""
        if self._fan is not None and now - self._fan[0] <= FRESH:
            return self._fan[1]
        fresh = {key: sector for key, sector in self._sectors.items() if now - sector.at <= FRESH}
        if not fresh:
            return None
        low = min(sector.min_m for sector in fresh.values())
        high = max(sector.max_m for sector in fresh.values())
        ranges = [_told(s.range_m, s.min_m, s.max_m, high) for s in fresh.values()]
        directions = [-2.0 * math.pi / SECTORS * key for key in fresh]
        return _scan(directions, ranges, low, high, max(sector.cone_rad for sector in fresh.values()))


def _told(range_m: float, low: float, high: float, most: float) -> float:
    """As a scan has it: `most` where nothing is seen, 0 where something is too near to measure."""
    if range_m >= high:
        return most
    return 0.0 if range_m < low else range_m


def _scan(directions: list[float], ranges: list[float], low: float, high: float, cone: float) -> Scan:
    """Beams from the middle of the vehicle, counter-clockwise."""
    order = np.argsort([math.remainder(angle, 2.0 * math.pi) for angle in directions], kind="stable")
    beams = np.zeros((len(directions), 3))
    beams[:, 2] = [math.remainder(directions[index], 2.0 * math.pi) for index in order]
    return Scan(
        first_angle_rad=0.0,
        increment_rad=0.0,
        range_min_m=low,
        range_max_m=high,
        mount=(0.0, 0.0, 0.0),
        beams=pack_floats(beams),
        cone_rad=cone,
        ranges=pack_floats([ranges[index] for index in order]),
    )
