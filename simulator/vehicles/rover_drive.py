"""How the speed and steering controllers of a presented rover answer, ahead of the body's own dynamics.

Fitted to what was measured on ArduPilot Rover: of the speed 0.1 s of dead time, then 1 m/s^2 (90 % of a step
to 0.5 m/s after 0.70 s); of the turning rate 90 % after 0.15 s; both end where they were told to.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from maniple.control.limits import Velocity
from maniple.core.time import MILLISECOND, SECOND, Duration, Time

DEAD_TIME: Duration = 100 * MILLISECOND
"""Before a new speed has any effect."""
SPEED_LAG_S = 0.12
TURN_LAG_S = 0.065
_LONGEST_S = 0.2
"""A longer step is a freeze: it counts as this."""


class Answer(NamedTuple):
    """What the vehicle makes of what it is told."""

    velocity: Velocity
    """That it has in mind now."""
    order: Velocity
    """What its motors are told, so that the body has that velocity."""


class RoverDrive:
    """Speed and steering controllers of a body with the velocity dynamics `theta` (see
    `maniple.core.scenario.types.RobotModel.theta`), which they know: they feed it what that asks for."""

    def __init__(self, theta: Sequence[float]) -> None:
        self._theta = tuple(theta)
        self._told: deque[tuple[Time, float]] = deque()
        self._last: Time | None = None
        self.rest()

    def rest(self) -> None:
        """Forget everything: the vehicle stands."""
        self._told.clear()
        self._target = self._ramp = self._u = self._w = 0.0

    def step(self, u: float, w: float, acceleration: float, now: Time) -> Answer:
        """Go on to `now`, wanting `u` (m/s), by way of at most `acceleration` (m/s^2), and `w` (rad/s)."""
        dt = 0.0 if self._last is None else min((now - self._last) / SECOND, _LONGEST_S)
        self._last = now
        self._told.append((now + DEAD_TIME, u))
        while self._told and self._told[0][0] <= now:
            self._target = self._told.popleft()[1]
        reach = acceleration * dt
        self._ramp += min(max(self._target - self._ramp, -reach), reach)
        u_before, w_before = self._u, self._w
        self._u += (self._ramp - self._u) * -math.expm1(-dt / SPEED_LAG_S)
        self._w += (w - self._w) * -math.expm1(-dt / TURN_LAG_S)
        per_s = 1.0 / dt if dt > 0.0 else 0.0
        u_rate, w_rate = (self._u - u_before) * per_s, (self._w - w_before) * per_s
        th1, th2, th3, th4, th5, th6 = self._theta
        return Answer(
            Velocity(self._u, self._w),
            Velocity(
                th1 * u_rate - th3 * self._w**2 + th4 * self._u,
                th2 * w_rate + th5 * self._u * self._w + th6 * self._w,
            ),
        )
