"""The robots' drives as far as they take orders: activation, clipping, and what happens in silence."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

from maniple.core.messages import Drive, DriverState
from maniple.core.scenario.types import RobotModel
from maniple.core.time import Duration, from_seconds

Order: TypeAlias = Literal["activate", "deactivate"]
"""What a `Drive` message asks of the life cycle."""

TRANSITIONS: Mapping[tuple[DriverState, Order], DriverState] = {
    ("configured", "activate"): "active",
    ("configured", "deactivate"): "configured",
    ("active", "activate"): "active",
    ("active", "deactivate"): "configured",
}
"""Life cycle of a simulated drive, which is connected and configured from the start."""

_NEVER: Duration = 2**62


class Change(NamedTuple):
    """From physics step `tick` on, a robot's drive follows (u, w), or brakes until it stands."""

    tick: int
    robot: int
    u: float
    w: float
    braking: bool


class Drives:
    """Drives of n robots. Times are ns since the first step's start; step k ends at k * period.

    Args:
        models: the type of each robot.
        period: length of a physics step, ns.
    """

    def __init__(self, models: Sequence[RobotModel], period: Duration) -> None:
        self._period = period
        self._limits = tuple((m.u_max_mps, m.w_max_radps, from_seconds(m.drive_timeout_s)) for m in models)
        self._states: list[DriverState] = ["configured"] * len(models)
        self._references = [(0.0, 0.0)] * len(models)
        self._deadlines = [_NEVER] * len(models)
        self._earliest = _NEVER
        self.changes: list[Change] = []
        """What physics has yet to apply, in order of tick."""

    def state(self, robot: int) -> DriverState:
        """Where the drive is in its life cycle."""
        return self._states[robot]

    def reference(self, robot: int) -> tuple[float, float] | None:
        """(u m/s, w rad/s) the drive follows after its limits, or None if it brakes or stands by itself."""
        return self._references[robot] if self._deadlines[robot] != _NEVER else None

    def command(self, robot: int, order: Drive, elapsed: Duration) -> None:
        """Obey `order` from the first step that is due after `elapsed`."""
        self.expire(elapsed)
        state = TRANSITIONS[self._states[robot], "activate" if order.active else "deactivate"]
        self._states[robot] = state
        tick = elapsed // self._period + 1
        if state != "active":
            self._deadlines[robot] = _NEVER
            self.changes.append(Change(tick, robot, 0.0, 0.0, True))
            return
        u_max, w_max, timeout = self._limits[robot]
        u = min(max(order.u_mps, -u_max), u_max)
        w = min(max(order.w_radps, -w_max), w_max)
        self._references[robot] = (u, w)
        self._deadlines[robot] = elapsed + timeout
        self._earliest = min(self._earliest, elapsed + timeout)
        self.changes.append(Change(tick, robot, u, w, False))

    def expire(self, elapsed: Duration) -> None:
        """Let the drives that have heard nothing for their timeout brake from the first step due then."""
        if elapsed < self._earliest:
            return
        for robot, deadline in enumerate(self._deadlines):
            if deadline <= elapsed:
                self._deadlines[robot] = _NEVER
                self.changes.append(Change(-(-deadline // self._period), robot, 0.0, 0.0, True))
        self.changes.sort(key=lambda change: change.tick)
        self._earliest = min(self._deadlines)
