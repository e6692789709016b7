"""What an agent may expect of a driver, and a driver of its agent.

A driver is an edge component: it may do I/O. It speaks `hw/ID/drive` (in), `hw/ID/motion` and `hw/ID/scan`
(out) and nothing else, so an agent can't tell one from another. Watchdog and limits are not its job: they
are in the agent's guard, and the hardware's own.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Protocol, TypeAlias

from maniple.control.limits import Limits, Velocity
from maniple.core.errors import ScenarioError
from maniple.core.messages import Drive, DriverState, Motion, Scan
from robot_agent.modes import Event

Step: TypeAlias = Literal["connect", "configure", "activate", "deactivate", "close", "fail"]
"""The steps of a driver's life; "fail" is what happens to it, the others are asked of it."""

LIFE_CYCLE: Mapping[tuple[DriverState, Step], DriverState] = {
    ("closed", "connect"): "connected",
    ("closed", "close"): "closed",
    ("connected", "configure"): "configured",
    ("connected", "close"): "closed",
    ("connected", "fail"): "fault",
    ("configured", "activate"): "active",
    ("configured", "deactivate"): "configured",
    ("configured", "close"): "closed",
    ("configured", "fail"): "fault",
    ("active", "activate"): "active",
    ("active", "deactivate"): "configured",
    ("active", "close"): "closed",
    ("active", "fail"): "fault",
    ("fault", "close"): "closed",
    ("fault", "fail"): "fault",
}
"""The state after a step. What is not listed is a mistake of whoever takes the step."""

EVENTS: Mapping[DriverState, Event] = {
    "closed": "driver_lost",
    "connected": "driver_lost",
    "configured": "driver_ready",
    "active": "driver_active",
    "fault": "driver_lost",
}
"""What a driver's state, if it is controllable, means to its agent."""

COUNTS: Mapping[DriverState, bool] = {
    "closed": False,
    "connected": False,
    "configured": True,
    "active": True,
    "fault": True,
}
"""Whether encoder counts go on from the report before: not while the hardware is still to be configured."""


class Capabilities(NamedTuple):
    """What a driver can do, known before it is connected."""

    u_max_mps: float
    w_max_radps: float
    reverse: bool
    """Whether it can drive backwards."""
    accepts_yaw_rate: bool
    """Whether it follows a commanded turning rate."""
    motion_hz: float
    scan_hz: float
    frame: str
    """`frame_id` of the odometry made from its reports."""
    v_max_mps: float = 0.0
    """Sideways, either way; 0 for one that can't."""


class Driver(Protocol):
    """Hardware, as a process beside an agent wraps it. Every step is one of `LIFE_CYCLE`.

    For drivers of real hardware, of which there is none here yet: what they are to implement. The simulator
    speaks the same three topics as a node, without this class.
    """

    @property
    def capabilities(self) -> Capabilities:
        """Known before `connect`."""
        ...

    @property
    def state(self) -> DriverState:
        """Where it is in its life."""
        ...

    def take(self, step: Step) -> None:
        """Take a step of the life cycle.

        Raises:
            ManipleError: the step is not open in this state, or the hardware refuses it.
        """
        ...

    def read(self) -> Sequence[Motion | Scan]:
        """What came from the hardware since the last call: stamped when it was measured, with the state,
        whether it is controllable, and if not, why."""
        ...

    def write(self, drive: Drive) -> Velocity:
        """Pass an order on. Returns what is actually applied, after clipping."""
        ...

    def stop(self) -> None:
        """Bring the robot to a stand, in any state."""
        ...


def within(limits: Limits, capabilities: Capabilities, robot: str) -> Limits:
    """The limits of a robot with this driver.

    Raises:
        ScenarioError: the driver can't follow (u, w) at all.
    """
    if not capabilities.accepts_yaw_rate:
        raise ScenarioError(
            f"robots: {robot}: its driver does not follow a turning rate; choose a driver that does"
        )
    u_max = min(limits.u_max, capabilities.u_max_mps)
    return limits._replace(
        u_min=max(limits.u_min, -u_max) if capabilities.reverse else 0.0,
        u_max=u_max,
        w_max=min(limits.w_max, capabilities.w_max_radps),
        v_max=min(limits.v_max, capabilities.v_max_mps),
    )
