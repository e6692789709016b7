"""What a presented rover knows of where it is: the state of ArduPilot's EKF as others see it.

Local coordinates are north and east of the filter's origin, metres; headings are compass yaw, clockwise from
north. The world of the simulator has x east and y north.
"""

import math
from typing import NamedTuple

from maniple.core.geometry import wrap
from maniple.core.messages import Motion
from maniple.core.time import MILLISECOND, SECOND, Duration, Time, to_seconds

ATTITUDE, VELOCITY_HORIZ, VELOCITY_VERT = 1, 2, 4
POS_HORIZ_REL, POS_HORIZ_ABS, POS_VERT_ABS = 8, 16, 32
CONST_POS_MODE, PRED_POS_HORIZ_REL, PRED_POS_HORIZ_ABS = 128, 256, 512
UNINITIALIZED = 1024
"""Bits of EKF_STATUS_REPORT."""

LEVEL: Duration = SECOND
"""After power-up the filter knows its attitude."""
GNSS_GOOD: Duration = 4 * SECOND
"""And the satellites are good enough to be used."""
OWN_ORIGIN: Duration = 15 * SECOND
"""Who has been given no origin until then takes where it stands."""
_BODY_SILENT: Duration = 500 * MILLISECOND
_FED: Duration = SECOND
_LEAST_FEEDS = 4
"""An external position counts where this many came within that: at 4 Hz or more."""
_TRUST = 0.2
"""How far each external position moves the estimate."""

_METRES_PER_UNIT = 6_378_100.0 * math.radians(1e-7)
"""North, of 1e-7 degrees of latitude, on ArduPilot's sphere."""


class Geo(NamedTuple):
    """A place on earth, as MAVLink has it."""

    latitude: int
    """1e-7 degrees."""
    longitude: int
    altitude: int
    """mm."""

    @classmethod
    def of(cls, latitude_deg: float, longitude_deg: float, altitude_m: float) -> "Geo":
        """From degrees and metres."""
        return cls(round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1e3))

    @property
    def valid(self) -> bool:
        """Whether there is such a place; (0, 0) is none to ArduPilot."""
        inside = abs(self.latitude) <= 900_000_000 and abs(self.longitude) <= 1_800_000_000
        return inside and (self.latitude, self.longitude) != (0, 0)

    def moved(self, north: float, east: float) -> "Geo":
        """The place so many metres from here."""
        per_east = _METRES_PER_UNIT * max(math.cos(math.radians(self.latitude * 1e-7)), 0.01)
        return Geo(
            self.latitude + round(north / _METRES_PER_UNIT),
            self.longitude + round(east / per_east),
            self.altitude,
        )

    def offset(self, other: "Geo") -> tuple[float, float]:
        """How far north and east of here the other is, m."""
        middle = math.radians(0.5e-7 * (self.latitude + other.latitude))
        per_east = _METRES_PER_UNIT * max(math.cos(middle), 0.01)
        return (
            (other.latitude - self.latitude) * _METRES_PER_UNIT,
            (other.longitude - self.longitude) * per_east,
        )


class Local(NamedTuple):
    """Where the vehicle is, and how it moves."""

    north: float
    """m."""
    east: float
    yaw: float
    """rad in (-pi, pi], clockwise from north."""
    v_north: float
    """m/s."""
    v_east: float
    yaw_rate: float
    """rad/s."""


class Estimate:
    """The filter of one vehicle since it was switched on at `boot`.

    Args:
        site: where on earth the world's (0, 0) is.
        gnss: whether it has a position of its own, else it has to be fed with one.
    """

    def __init__(self, site: Geo, gnss: bool, boot: Time) -> None:
        self._site, self._gnss, self._boot = site, gnss, boot
        self.origin: Geo | None = None
        """Of the filter's local coordinates."""
        self._shift = (0.0, 0.0)
        self._motion: tuple[Motion, Time] | None = None
        self._feeds: list[Time] = []
        self._error: tuple[float, float] | None = None

    def see(self, motion: Motion, now: Time) -> None:
        """The body says how it moves, its true pose in the world."""
        if motion.pose is not None:
            self._motion = motion, now

    def set_origin(self, origin: Geo, now: Time) -> bool:
        """What SET_GPS_GLOBAL_ORIGIN asks for; false where it comes too early, or there is an origin already:
        that stays until the next start."""
        if self.origin is not None or not origin.valid or now - self._boot < LEVEL:
            return False
        self.origin = origin
        if self._gnss:
            self._shift = origin.offset(self._site)
        return True

    def feed(self, north: float, east: float, now: Time) -> None:
        """An external position (m) in local coordinates arrived."""
        self._feeds = [t for t in self._feeds if now - t < _FED] + [now]
        true = self._true(now)
        if true is None or self._gnss:
            return
        error = north - true.north, east - true.east
        if self._error is None:
            self._error = error
        self._error = (
            self._error[0] + _TRUST * (error[0] - self._error[0]),
            self._error[1] + _TRUST * (error[1] - self._error[1]),
        )

    def update(self, now: Time) -> bool:
        """Let time pass; whether the filter took where it stands as its origin."""
        self._feeds = [t for t in self._feeds if now - t < _FED]
        if not self._feeds:
            self._error = None
        if self.origin is None and self._gnss and now - self._boot >= OWN_ORIGIN:
            true = self._true(now)
            if true is not None:
                return self.set_origin(self._site.moved(true.north, true.east), now)
        return False

    def attitude(self, now: Time) -> Local | None:
        """Yaw and yaw rate are good in this; None before they are, and where the body is silent."""
        return self._true(now) if now - self._boot >= LEVEL else None

    def position(self, now: Time) -> Local | None:
        """All of this is good; None where the filter has no position."""
        true = self._true(now)
        if true is None or self.origin is None or not self._aided(now):
            return None
        error = self._error if self._error is not None else (0.0, 0.0)
        return true._replace(north=true.north + error[0], east=true.east + error[1])

    def fix(self, now: Time) -> Geo | None:
        """What its satellite receiver says; None where it has none, or that knows nothing yet."""
        true = self._true(now)
        if true is None or not self._gnss or now - self._boot < GNSS_GOOD:
            return None
        return self._site.moved(true.north - self._shift[0], true.east - self._shift[1])

    def flags(self, now: Time) -> int:
        """Of EKF_STATUS_REPORT."""
        if self.attitude(now) is None:
            return UNINITIALIZED
        flags = ATTITUDE | VELOCITY_VERT | POS_VERT_ABS
        if not self._aided(now):
            return flags | CONST_POS_MODE
        flags |= VELOCITY_HORIZ
        if not self._gnss or self.origin is not None:
            flags |= POS_HORIZ_REL | PRED_POS_HORIZ_REL
        if self.origin is not None:
            flags |= POS_HORIZ_ABS | PRED_POS_HORIZ_ABS
        return flags

    def _aided(self, now: Time) -> bool:
        """Whether something tells it where it is."""
        if self._gnss:
            return now - self._boot >= GNSS_GOOD
        return len(self._feeds) >= _LEAST_FEEDS and self._error is not None

    def _true(self, now: Time) -> Local | None:
        """Where the body is, with its last velocities carried on to now."""
        if self._motion is None or now - self._motion[1] > _BODY_SILENT:
            return None
        motion, seen = self._motion
        assert motion.pose is not None
        (x, y, psi), (u, w, v) = motion.pose, motion.twist
        age = to_seconds(now - seen)
        middle = psi + 0.5 * w * age
        x += (u * math.cos(middle) - v * math.sin(middle)) * age
        y += (u * math.sin(middle) + v * math.cos(middle)) * age
        psi += w * age
        return Local(
            north=y + self._shift[0],
            east=x + self._shift[1],
            yaw=wrap(0.5 * math.pi - psi),
            v_north=u * math.sin(psi) + v * math.cos(psi),
            v_east=u * math.cos(psi) - v * math.sin(psi),
            yaw_rate=-w,
        )
