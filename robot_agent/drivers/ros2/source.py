"""What is heard of a robot on one of its topics: by whom, how often, how long ago. Pure; times in ns."""

import math
from collections import deque
from typing import Literal, TypeAlias

from maniple.core.geometry import Pose, wrap
from maniple.core.time import SECOND, Duration, Time, to_seconds
from robot_agent.drivers.interface import Capabilities

STALE: Duration = SECOND // 2
"""What was heard longer ago says nothing about now."""

_COUNTED = 10
_PACE = 0.75
"""What comes sooner after the last than this share of the period is left out: no more than the period on
average, and nothing waits."""
_SLIP_M, _SLIP_RAD = 0.1, 0.2
_TIMES = 2.0
"""Odometry may be off by so much at once, and tell of this times the fastest that the robot goes."""

Verdict: TypeAlias = Literal["taken", "second", "anew"]
"""Of a message: from who is listened to; from another beside that; from another who took over."""


class Source:
    """The publisher that is listened to on a topic, of those there may be."""

    def __init__(self) -> None:
        self._gid: bytes | None = None
        self._heard: deque[Time] = deque(maxlen=_COUNTED + 1)
        self._second: Time | None = None

    def hear(self, gid: bytes, now: Time) -> Verdict:
        """Somebody published; `gid` is empty where the network does not say who."""
        verdict: Verdict = "taken"
        if self._gid not in (None, gid):
            if self.is_fresh(now):
                self._second = now
                return "second"
            verdict = "anew"
        if not self.is_fresh(now):
            self._heard.clear()
        self._gid = gid
        self._heard.append(now)
        return verdict

    def age(self, now: Time) -> Duration | None:
        """Since the last; None before the first."""
        return now - self._heard[-1] if self._heard else None

    def is_fresh(self, now: Time) -> bool:
        """Whether the last says something about now."""
        age = self.age(now)
        return age is not None and age <= STALE

    def is_disputed(self, now: Time) -> bool:
        """Whether two publish there."""
        return self._second is not None and now - self._second <= STALE

    def rate_hz(self) -> float:
        """How often it publishes; 0 as long as that can't be said."""
        if len(self._heard) <= _COUNTED or self._heard[-1] == self._heard[0]:
            return 0.0
        return _COUNTED / to_seconds(self._heard[-1] - self._heard[0])


class Pacer:
    """Passes on no more than was promised."""

    def __init__(self, rate_hz: float) -> None:
        self._gap: Duration = round(_PACE * SECOND / rate_hz)
        self._last: Time | None = None

    def lets_pass(self, now: Time) -> bool:
        """Whether what arrived now is passed on."""
        if self._last is not None and now - self._last < self._gap:
            return False
        self._last = now
        return True


def has_jumped(before: Pose, after: Pose, elapsed: Duration, able: Capabilities) -> bool:
    """Whether no robot with these capabilities gets from one pose to the other so soon: its odometry began
    anew, or was set."""
    seconds = to_seconds(elapsed)
    way = math.hypot(after.x - before.x, after.y - before.y)
    fastest = math.hypot(able.u_max_mps, able.v_max_mps)
    far = way > _SLIP_M + _TIMES * fastest * seconds
    return far or abs(wrap(after.psi - before.psi)) > _SLIP_RAD + _TIMES * able.w_max_radps * seconds
