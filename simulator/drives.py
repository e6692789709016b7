"""The robots' drives as far as they take orders: activation, clipping, and what happens in silence."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

from maniple.control.limits import Velocity, curvature_max
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
_STAND = Velocity()


class Change(NamedTuple):
    """From physics step `tick` on, a robot's drive follows `velocity`, or brakes until it stands."""

    tick: int
    robot: int
    velocity: Velocity
    braking: bool


class Drives:
    """Drives of n robots. Times are ns since the first step's start; step k ends at k * period.

    Args:
        models: the type of each robot.
        period: length of a physics step, ns.
    """

    def __init__(self, models: Sequence[RobotModel], period: Duration) -> None:
        self._period = period
        self._limits = tuple(_limits(model) for model in models)
        self._states: list[DriverState] = ["configured"] * len(models)
        self._references = [_STAND] * len(models)
        self._deadlines = [_NEVER] * len(models)
        self._earliest = _NEVER
        self.changes: list[Change] = []
        """What physics has yet to apply, in order of tick."""

    def state(self, robot: int) -> DriverState:
        """Where the drive is in its life cycle."""
        return self._states[robot]

    def reference(self, robot: int) -> Velocity | None:
        """What the drive follows after its limits, or None if it brakes or stands by itself."""
        return self._references[robot] if self._deadlines[robot] != _NEVER else None

    def command(self, robot: int, order: Drive, elapsed: Duration) -> None:
        """Obey `order` from the first step that is due after `elapsed`."""
        self.expire(elapsed)
        state = TRANSITIONS[self._states[robot], "activate" if order.active else "deactivate"]
        self._states[robot] = state
        tick = elapsed // self._period + 1
        if state != "active":
            self._deadlines[robot] = _NEVER
            self.changes.append(Change(tick, robot, _STAND, True))
            return
        u_max, w_max, v_max, curvature, timeout = self._limits[robot]
        u = min(max(order.u_mps, -u_max), u_max)
        if curvature is not None:
            w_max = min(w_max, curvature * abs(u))
        w = min(max(order.w_radps, -w_max), w_max)
        v = min(max(order.v_mps, -v_max), v_max)
        self._references[robot] = velocity = Velocity(u, w, v)
        self._deadlines[robot] = elapsed + timeout
        self._earliest = min(self._earliest, elapsed + timeout)
        self.changes.append(Change(tick, robot, velocity, False))

    def expire(self, elapsed: Duration) -> None:
        """Let the drives that have heard nothing for their timeout brake from the first step due then."""
        if elapsed < self._earliest:
            return
        for robot, deadline in enumerate(self._deadlines):
            if deadline <= elapsed:
                self._deadlines[robot] = _NEVER
                self.changes.append(Change(-(-deadline // self._period), robot, _STAND, True))
        self.changes.sort(key=lambda change: change.tick)
        self._earliest = min(self._deadlines)


def _limits(model: RobotModel) -> tuple[float, float, float, float | None, Duration]:
    """Largest u, w and v, the largest w for each u of a car, and how long silence is borne."""
    curvature = curvature_max(model) if model.drive == "car" else None
    timeout = from_seconds(model.drive_timeout_s)
    return model.u_max_mps, model.w_max_radps, model.v_max_mps or 0.0, curvature, timeout
