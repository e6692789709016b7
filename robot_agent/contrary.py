"""Whether a robot moves against what its drive is told: crossed motors, a compass half a turn off, a driver
that takes a sign the other way. Every correction of the law, the avoidance or the fence then drives it
farther."""

import math
from typing import NamedTuple

from maniple.control.limits import Velocity
from maniple.core.scenario.types import RobotModel
from maniple.core.time import SECOND, Duration, Time, from_seconds, to_seconds

WITHIN: Duration = SECOND
"""What moves against what it is told for so long is contrary."""
STUCK_AFTER: Duration = 3 * SECOND
"""What is told to drive for so long and does not move, is said to."""

_TOLD = Velocity(0.1, 0.2, 0.1)
_CLEARLY = 0.5
"""Told is what is more than `_TOLD`, or than this share of what a slow robot can do; against it moves what
moves more than half as fast."""
_LAG, _GAIN = 2.0, 0.5
"""How much slower a drive may follow than its model says, and how much less of it may arrive."""
_DRIVES = Velocity(0.05, 0.1, 0.05)
_STILL = Velocity(0.02, 0.04, 0.02)

_WAYS = (("drive forwards", "moves backwards"), ("turn left", "turns right"), ("drive left", "moves right"))
_OTHER_WAYS = (
    ("drive backwards", "moves forwards"),
    ("turn right", "turns left"),
    ("drive right", "moves left"),
)


class _Against(NamedTuple):
    """One of u, w and v is of the other sign than it was told."""

    since: Time
    drive: float
    """What it would be by now of a drive that is far slower than the model's, from what it was at first."""


class Contrary:
    """Compares what a drive of robots of a type was told with what is measured.

    A motion of the other sign counts while what is told does not change its sign, nor gets small. It is
    contrary when it has lasted for `WITHIN` and is not a drive's lag either: one that follows within twice
    the lag of `model`, with at least half of its gain, would have turned round by then. So no such drive is
    ever taken for contrary, whatever it is told, and however long it takes to turn round.
    """

    def __init__(self, model: RobotModel) -> None:
        self._theta = model.theta
        th1, th2, _, th4, _, th6 = model.theta
        self._lag_s = _LAG * max(th1 / th4, th2 / th6)
        most = Velocity(model.u_max_mps, model.w_max_radps, model.v_max_mps or 0.0)
        self._told_least = Velocity(*(min(a, _CLEARLY * b) for a, b in zip(_TOLD, most, strict=True)))
        self._timeout = from_seconds(model.drive_timeout_s)
        self._told, self._told_at, self._at = Velocity(), 0, 0
        self._measured = Velocity()
        self._against: list[_Against | None] = [None, None, None]
        self._still_since: Time | None = None
        self.stuck = False
        """Whether it was told to drive for `STUCK_AFTER` and has not moved since."""

    def tell(self, told: Velocity, now: Time) -> None:
        """The drive is told `told` from now on."""
        self._follow(now)
        for axis, before in enumerate(self._against):
            if before is not None and not self._opposed(axis, told[axis], self._measured[axis]):
                self._against[axis] = None
        if not any(abs(is_) > least for is_, least in zip(told, _DRIVES, strict=True)):
            self._still_since, self.stuck = None, False
        self._told, self._told_at = told, now

    def hear(self, measured: Velocity, now: Time) -> str:
        """The robot is measured to move so; in what it is contrary, for people, or empty."""
        if now - self._told_at > self._timeout:
            self.tell(Velocity(), now)  # nobody has said anything since: the drive brakes by itself
        self._follow(now)
        self._measured = measured
        self._look_whether_it_moves(now)
        found = ""
        for axis, (told, is_) in enumerate(zip(self._told, measured, strict=True)):
            if not self._opposed(axis, told, is_):
                self._against[axis] = None
                continue
            against = self._against[axis] or _Against(now, is_)
            self._against[axis] = against
            if now - against.since >= WITHIN and against.drive * told > 0.0:
                told_to, does = (_WAYS if told > 0.0 else _OTHER_WAYS)[axis]
                found = found or (
                    f"told to {told_to} for {to_seconds(WITHIN):g} s and {does} (its motors, its compass)"
                )
        return found

    def _opposed(self, axis: int, told: float, measured: float) -> bool:
        """Whether one is clearly of the other sign than the other."""
        least = self._told_least[axis]
        return told * measured < 0.0 and abs(told) > least and abs(measured) > 0.5 * least

    def _follow(self, now: Time) -> None:
        """Let the slow drive follow what was told, by the dynamics of the model and how it moved."""
        elapsed_s, self._at = to_seconds(now - self._at), now
        if not any(self._against):
            return
        _, _, th3, th4, th5, th6 = self._theta
        u, w, _ = self._measured
        coupling, gain = (th3 * w * w, -th5 * u * w, 0.0), (th4, th6, th4)
        share = math.exp(-max(elapsed_s, 0.0) / self._lag_s)
        for axis, against in enumerate(self._against):
            if against is not None:
                end = (_GAIN * self._told[axis] + coupling[axis]) / gain[axis]
                self._against[axis] = against._replace(drive=end + (against.drive - end) * share)

    def _look_whether_it_moves(self, now: Time) -> None:
        told = any(abs(is_) > least for is_, least in zip(self._told, _DRIVES, strict=True))
        moves = any(abs(is_) > least for is_, least in zip(self._measured, _STILL, strict=True))
        if moves or not told:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = now
        self.stuck = self._still_since is not None and now - self._still_since >= STUCK_AFTER
