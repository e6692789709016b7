"""One robot's agent behind the real host logic, with a clock of its own, and what its network delivers."""

from typing import Any

from maniple.control.limits import limits_of
from maniple.core import codec, topics
from maniple.core.clocks import NodeClock
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.messages import Drive, DriverState, Motion, Odometry, Stamp, Status
from maniple.core.scenario.types import Avoidance, Formation, Guard, Line, Placement, Robot, Scenario
from maniple.core.time import MILLISECOND, SECOND, to_seconds
from maniple.host.runner import NodeRunner
from robot_agent.node import DRIVE, STATUS, RobotAgent
from tests.pioneer import PIONEER

T0 = 1000 * SECOND
TICK = 50 * MILLISECOND
STOP_S, HOLD_S = 1.0, 0.5

SCENARIO = Scenario(
    name="test",
    robots=(Robot(id="r1", control_point_m=0.3, pose=(0.0, 0.0, 0.0)),),
    formation=Formation(points=((0.0, 0.0),)),
    task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
    placement=Placement(robot_from="drive"),
    avoidance=Avoidance(enabled=False),
    guard=Guard(clearance=False, hold_after_s=HOLD_S, stop_after_s=STOP_S),
    models={"pioneer-3dx": PIONEER},
)
LIMITS = limits_of(SCENARIO, SCENARIO.robots[0])


class HostedAgent:
    """One agent and what its network delivers, tick by tick."""

    def __init__(self, clock: NodeClock) -> None:
        self.runner = NodeRunner(RobotAgent(SCENARIO, "r1"), 1, SCENARIO.rates)
        self.runner.announced("controller", 1)
        self.clock = clock
        self.stamps: list[Stamp] = []
        self.now = clock.shown(T0)
        self.drive = Drive(u_mps=0.0, w_radps=0.0, active=True)
        self.runner.start(self.now)

    def hear(self, envelope: Envelope) -> list[Any]:
        """What the agent says to it."""
        return self._said(self.runner.receive(envelope, self.now))

    def moves(self, tick: int, state: DriverState = "active") -> Odometry:
        """The drive reports, and odometry follows."""
        self.now = self.clock.shown(T0 + tick * TICK)
        motion = Motion(
            source="simulator",
            incarnation=1,
            seq=tick,
            stamp_ns=T0 + tick * TICK,
            ticks=(0, 0),
            applied=(0.0, 0.0),
            state=state,
            controllable=True,
        )
        (odometry,) = self.hear(enveloped(topics.motion("r1"), motion))
        assert isinstance(odometry, Odometry)
        return odometry

    def tick(self) -> tuple[float, float, float]:
        """Speeds before and after a tick of the agent, and how long after the one before it was."""
        before = self.drive
        self._said(self.runner.timer(DRIVE, self.now))
        return before.u_mps, self.drive.u_mps, to_seconds(TICK) * (1 + self.clock.skew * 1e-6)

    def status(self) -> Status:
        """What the agent says of itself."""
        (status,) = self._said(self.runner.timer(STATUS, self.now))
        assert isinstance(status, Status)
        return status

    def _said(self, envelopes: list[Envelope]) -> list[Any]:
        messages = [codec.decode(one.topic, one.data) for one in envelopes]
        for message in messages:
            if isinstance(message, Drive):
                self.drive = message
            elif isinstance(message, Odometry):
                self.stamps.append(Stamp(message.incarnation, message.seq, message.stamp_ns))
        return messages


def enveloped(topic: str, message: Any) -> Envelope:
    return envelope_of(topic, codec.encode(message))
