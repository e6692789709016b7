"""What an agent may expect of a driver, and a driver of its agent.

A driver is an edge component: it may do I/O. Its process speaks `hw/ID/drive` (in), `hw/ID/motion` and
`hw/ID/scan` (out) and nothing else, so an agent can't tell one from another. Watchdog and limits are not its
job: they are in the agent's guard, in the driver's process, and the hardware's own.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

from maniple.control.limits import Limits, Velocity
from maniple.core.errors import ScenarioError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Time
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
    """`frame_id` of the odometry made from its reports: `maniple.core.edges.WORLD` where they are given in
    the world frame, else the robot's id."""
    v_max_mps: float = 0.0
    """Sideways, either way; 0 for one that can't."""


class Driver(Protocol):
    """Hardware, as a process beside an agent wraps it (`maniple driver run`). Every step is one of
    `LIFE_CYCLE`.

    One thread calls it, every few milliseconds, with the time by its own clock (ns). No call blocks: what
    takes longer is begun, and goes on in `read`. The process keeps the life cycle going, watches over the
    agent, and clips what is written to the capabilities, for every driver alike. The simulator speaks the
    same three topics as a node, without this class.
    """

    @property
    def capabilities(self) -> Capabilities:
        """Known before `connect`."""
        ...

    @property
    def state(self) -> DriverState:
        """Where it is in its life."""
        ...

    @property
    def reason(self) -> str:
        """Why it is not where it was asked to be, in words for people: what is waited for, what was refused.
        Empty where all is well."""
        ...

    def take(self, step: Step, now: Time) -> None:
        """Begin a step of the life cycle. `state` changes once the hardware has taken it; until then, and
        where it refuses, `reason` says why. A step that is under way may be asked for again.

        Raises:
            ManipleError: the step is not open in this state.
        """
        ...

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        """What came from the hardware since the last call, with the state, whether it is controllable, and if
        not, why. Nothing while there is no news: stale values are never repeated."""
        ...

    def write(self, drive: Drive, now: Time) -> Velocity:
        """Pass an order on. Returns what is actually applied, after its own clipping."""
        ...

    def see(self, pose: ExternalPose, now: Time) -> None:
        """Take in where others see the robot. Drivers whose vehicles need none ignore it."""
        ...

    def stop(self, now: Time) -> None:
        """Bring the robot to a stand, in any state."""
        ...


@runtime_checkable
class Answering(Protocol):
    """A driver that may also tell what its vehicle says about itself; `maniple driver check` shows it."""

    def answers(self) -> Mapping[str, str]:
        """What the vehicle has answered so far, a few words each, in the order in which people want to read
        it: "firmware", "mode", "armed", "ekf", "gps", "battery" and so on. Only what was heard; empty before
        `connect`. It does no I/O."""
        ...


@runtime_checkable
class Successor(Protocol):
    """A driver whose vehicle others may take. The one before it knew who has it; that is lost with it."""

    def succeed(self) -> None:
        """There was another driver of this vehicle, and it is gone. Told before anything is asked of it."""
        ...


class DriverFactory(Protocol):
    """Makes the driver of a robot of a resolved scenario: what the entry points `maniple.drivers` name.

    It does no I/O and imports nothing heavy: an agent makes one to know the capabilities. `endpoint` is the
    router of the hardware network, empty where there is none yet.
    """

    def __call__(self, scenario: Scenario, robot: Robot, endpoint: str = "") -> Driver:
        """Raises `ScenarioError` where the robot's parameters are not valid, with what would be."""
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
