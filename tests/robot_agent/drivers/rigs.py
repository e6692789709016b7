"""Rigs for the suite of drivers: the simulated world with one robot, and how it is driven."""

import time
from collections.abc import Collection, Sequence
from typing import Any

from maniple.control.limits import Velocity
from maniple.core import topics
from maniple.core.connections import other_end
from maniple.core.errors import ManipleError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan, Truth, unpack_floats
from maniple.core.node import Received
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND, SECOND, Duration, Time, period, to_seconds
from maniple.transport.mavlink import MavlinkLink
from maniple.transport.ros2 import Network, RosPublisher, RosSession
from maniple.transport.ros2_cdr import TWIST
from maniple.transport.ros2_messages import Velocity3, twist
from maniple.transport.zenoh import ZenohSession
from robot_agent.drivers.conformance import Act
from robot_agent.drivers.interface import LIFE_CYCLE, Capabilities, Step
from robot_agent.drivers.keeper import clipped
from simulator.node import Simulator
from simulator.vehicles.interface import STEP
from simulator.vehicles.ros2 import Ros2Vehicle
from simulator.vehicles.rover import Rover, spec_of

TICK: Duration = 10 * MILLISECOND


class World:
    """The simulated world in virtual time, with the first robot of a scenario; others may act in it."""

    def __init__(self, scenario: Scenario, now: Time = SECOND) -> None:
        self.robot = scenario.robots[0]
        self.simulator = Simulator(scenario)
        self.simulator.on_start(now)
        self._timers = dict.fromkeys(self.simulator.timers, now)
        self._now = now
        self.linked = True

    def now(self) -> Time:
        return self._now

    def wait(self, duration: Duration) -> None:
        until = self._now + duration
        while self._now < until:
            self._now += min(TICK, until - self._now)
            for name in self._timers:
                if self._now >= self._timers[name]:
                    self._timers[name] += self.simulator.timers[name]
                    for _, message in self.simulator.on_timer(name, self._now):
                        if isinstance(message, Motion | Scan):
                            self.reported(message)
            self.live()

    def reported(self, report: Motion | Scan) -> None:
        """The body says something."""

    def live(self) -> None:
        """Once every tick."""

    def tell(self, order: Drive, topic: str) -> None:
        self.simulator.on_message(Received(topic, order), self._now)

    def velocity(self) -> Velocity:
        ((_, truth),) = self.simulator.on_timer("truth", self._now)
        assert isinstance(truth, Truth)
        u, w = unpack_floats(truth.velocities, 2)[0].tolist()
        return Velocity(u, w)

    def taken(self) -> bool:
        return False


class SimulatorRig(World):
    """The simulator as it is, with a cable that can be cut."""

    acts: Collection[Act] = ("cut", "restore")

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.heard: list[Motion | Scan] = []

    def reported(self, report: Motion | Scan) -> None:
        if self.linked:
            self.heard.append(report)

    def act(self, act: Act) -> None:
        self.linked = act == "restore"


class SimulatorDriver:
    """The simulated drive, which is a node, as a driver: connected once it is heard."""

    def __init__(self, rig: SimulatorRig, capabilities: Capabilities) -> None:
        self.capabilities = capabilities
        self._rig = rig
        self._heard_at: Time = 0
        self._asked: Step | None = None
        self.state: DriverState = "closed"
        self.reason = ""

    def take(self, step: Step, now: Time) -> None:
        if step == "fail" or (self.state, step) not in LIFE_CYCLE:
            raise ManipleError(f"the simulated drive can't {step} while {self.state}")
        if step == "connect":
            self._rig.heard.clear()
            self._asked, self.reason = step, "the simulator is not heard"
            return
        if step in ("deactivate", "close"):
            self.stop(now)
        self._asked, self.reason = None, ""
        self.state = LIFE_CYCLE[self.state, step]

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        heard, self._rig.heard = self._rig.heard, []
        if self.state == "closed":
            if heard and self._asked == "connect":
                self.state, self.reason, self._asked, self._heard_at = "connected", "", None, now
            return ()
        if heard:
            self._heard_at = now
        elif now - self._heard_at > SECOND and self.state != "fault":
            self.state, self.reason = "fault", "the simulator has not been heard for 1 s"
        if self.state == "fault":
            return ()
        return [report if isinstance(report, Scan) else _with_state(report, self.state) for report in heard]

    def write(self, drive: Drive, now: Time) -> Velocity:
        if self.state != "active":
            return Velocity()
        order = clipped(drive, self.capabilities)
        self._say(order)
        return Velocity(order.u_mps, order.w_radps, order.v_mps) if order.active else Velocity()

    def see(self, pose: ExternalPose, now: Time) -> None:
        pass

    def stop(self, now: Time) -> None:
        if self.state == "active":
            self._say(Drive(u_mps=0.0, w_radps=0.0, active=False))

    def _say(self, order: Drive) -> None:
        if self._rig.linked:
            self._rig.tell(order, topics.drive(self._rig.robot.id))


def _with_state(motion: Motion, state: DriverState) -> Motion:
    applied = motion.applied if state == "active" else (0.0, 0.0)
    return Motion(ticks=motion.ticks, applied=applied, state=state, controllable=True)


class RoverRig(World):
    """A presented rover at its end of a real connection, its radio, and a pilot."""

    acts: Collection[Act] = ("cut", "restore", "take", "give")

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        link = self.robot.mavlink
        self._link = MavlinkLink.open(other_end(link.connection), link.system_id, link.component_id)
        self._rover = Rover(spec_of(scenario, self.robot), self._link.dialect, self._now)
        self._order = Drive(u_mps=0.0, w_radps=0.0, active=False)
        self._pilot: list[Any] = []
        self._step = self._now
        self.mode = 0
        self.received: list[Any] = []

    def reported(self, report: Motion | Scan) -> None:
        self._rover.see(report, self._now)

    def live(self) -> None:
        if self._now < self._step:
            return
        self._step += STEP
        received = self._link.receive()
        self.received += received if self.linked else []
        said, order = self._rover.step(self._now, [*(received if self.linked else []), *self._pilot])
        self._pilot.clear()
        for message, to in said:
            if message.get_type() == "HEARTBEAT":
                self.mode = message.custom_mode
            if self.linked and to != PILOT:
                self._link.send(message, to)
        self.tell(order, topics.simulated_drive(self.robot.id))

    def act(self, act: Act) -> None:
        if act in ("cut", "restore"):
            self.linked = act == "restore"
            return
        mode = MANUAL if act == "take" else GUIDED
        dialect = self._link.dialect
        message = dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, mode, 0, 0, 0, 0, 0)
        packer = dialect.MAVLink(None, srcSystem=PILOT, srcComponent=190)
        self._pilot += dialect.MAVLink(None).parse_buffer(message.pack(packer))
        self.wait(2 * SECOND)

    def taken(self) -> bool:
        return self.mode == MANUAL

    def close(self) -> None:
        self._link.close()


PILOT, MANUAL, GUIDED = 250, 0, 15


class RosRig(World):
    """A simulated body that speaks ROS 2, by the wall clock; its router, and somebody else who drives it."""

    acts: Collection[Act] = ("cut", "restore", "take", "give")

    def __init__(self, scenario: Scenario, endpoint: str) -> None:
        super().__init__(scenario, time.monotonic_ns())
        self._endpoint = endpoint
        self._router = ZenohSession.router(endpoint, "test")
        self._vehicle = Ros2Vehicle(scenario, self.robot, endpoint)
        self._vehicle.open(self._now)
        self._other: tuple[RosSession, RosPublisher] | None = None
        self._due = self._now

    def wait(self, duration: Duration) -> None:
        time.sleep(max(to_seconds(self._now + duration - time.monotonic_ns()), 0.0))
        super().wait(max(time.monotonic_ns() - self._now, TICK))

    def reported(self, report: Motion | Scan) -> None:
        self._vehicle.see(report, time.time_ns())

    def live(self) -> None:
        if self._other is not None and self._now >= self._due:
            self._due = self._now + period(20.0)
            self._other[1].publish(twist(Velocity3(0.0, 0.0, 0.0)))
        self.tell(self._vehicle.step(time.time_ns()), topics.simulated_drive(self.robot.id))

    def act(self, act: Act) -> None:
        match act:
            case "cut":
                self._router.close()
            case "restore":
                self._router = ZenohSession.router(self._endpoint, "test")
            case "take":
                ros = RosSession.open(self._endpoint, "teleop", "/", Network(), 2.0)
                self._other = ros, ros.advertise(f"/{self.robot.id}/cmd_vel", TWIST)
            case "give":
                assert self._other is not None
                self._other[0].close()
                self._other = None

    def taken(self) -> bool:
        return abs(self.velocity().u) < 0.02

    def close(self) -> None:
        self._vehicle.close(self._now)
        self._router.close()
