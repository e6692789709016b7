"""A session and a rover of the simulator, with real frames between them, in virtual time."""

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from maniple.control.limits import Velocity
from maniple.core.messages import Drive, ExternalPose, Motion, Scan
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH, Time, to_seconds
from maniple.transport.mavlink import load_dialect
from maniple.transport.mavlink_framing import Framer
from robot_agent.drivers.keeper import Standing
from robot_agent.drivers.mavlink.frames import Origin
from robot_agent.drivers.mavlink.session import Session, Setup
from simulator.vehicles.rover import Rover, Spec
from simulator.vehicles.rover_estimate import Geo

MAV = load_dialect()
GCS, PILOT, ROVER = 255, 254, 1
PLACE = (48.1, 11.5, 500.0)
STEP = 10 * MILLISECOND

SETUP = Setup(
    system_id=ROVER,
    component_id=1,
    gcs_system_id=GCS,
    u_max_mps=0.75,
    w_max_radps=1.7,
    brake_mps2=0.6,
    arm=True,
    disarm=True,
    origin=Origin.of(*PLACE),
    external_pose=False,
    motion_hz=20.0,
    scan_hz=10.0,
    ranges=True,
)


class Pipe:
    """Messages as frames of one sender."""

    def __init__(self, system: int, component: int = 1) -> None:
        self._codec = MAV.MAVLink(None, system, component)
        self._framer = Framer(MAV)

    def through(self, messages: list[Any]) -> list[Any]:
        found = []
        for message in messages:
            frame = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) % 256
            found += self._framer.feed(bytes(frame))
        return found


class Bench:
    """Turns of 10 ms: the rover's body, the rover every second turn, the session."""

    def __init__(self, setup: Setup = SETUP, site: tuple[float, float, float] = PLACE) -> None:
        self.now: Time = VIRTUAL_EPOCH
        self.setup = setup
        self.session = Session(MAV, setup)
        self.pose = (2.0, -1.0, 0.5)
        """True, in the world, whose (0, 0) is at `site`."""
        self.velocity = Velocity()
        self.motions: list[Motion] = []
        self.scans: list[Scan] = []
        self.sent: Counter[str] = Counter()
        self.log: list[tuple[Time, Any]] = []
        """What the session sent, with when."""
        self.cut = False
        self.order: Drive | None = None
        self.surroundings: Scan | None = None
        self.sees = False
        self.blocked = False
        self.signs = (1.0, 1.0)
        """What its motors make of what they are told, forward and turning."""
        self.between: Callable[[list[Any]], list[Any]] = lambda messages: messages
        """What becomes of the rover's messages on their way;"""
        self.upward: Callable[[list[Any]], list[Any]] = lambda messages: messages
        """and of the session's."""
        self.standing = Standing()
        self._site = site
        self._up = Pipe(setup.gcs_system_id, 190)
        self.down = Pipe(setup.system_id, setup.component_id)
        self._pilot = Pipe(PILOT)
        self._waiting: list[Any] = []
        self._turns = 0
        self.switch_on()

    def switch_on(self) -> None:
        setup = self.setup
        site, external = Geo.of(*self._site), setup.external_pose
        theta = (0.3, 0.065, 0.0, 1.0, 0.0, 1.0)
        self.rover = Rover(
            Spec(setup.system_id, setup.component_id, GCS, site, external, 0.75, 1.7, theta), MAV, self.now
        )

    def pilot(self, *messages: Any) -> None:
        """From another ground station."""
        self._waiting += self._pilot.through(list(messages))

    def pilot_sets(self, mode: int) -> None:
        self.pilot(MAV.MAVLink_command_long_message(ROVER, 1, 176, 0, 1, mode, 0, 0, 0, 0, 0))

    def pilot_arms(self, armed: bool) -> None:
        self.pilot(MAV.MAVLink_command_long_message(ROVER, 1, 400, 0, float(armed), 0, 0, 0, 0, 0, 0))

    def set(self, name: str, value: float) -> None:
        self.pilot(MAV.MAVLink_param_set_message(ROVER, 1, name.encode(), value, 9))

    def turn(self) -> None:
        self.now += STEP
        self._turns += 1
        (x, y, psi), (u, w, _) = self.pose, self.velocity
        dt_s = to_seconds(STEP)
        self.pose = x + u * math.cos(psi) * dt_s, y + u * math.sin(psi) * dt_s, psi + w * dt_s
        arrived: list[Any] = []
        if self._turns % 2 == 0:
            self.rover.see(
                Motion(
                    ticks=(), applied=(u, w), state="active", controllable=True,
                    pose=self.pose, twist=(u, w, 0.0),
                ),
                self.now,
            )  # fmt: skip
            if self.surroundings is not None and self._turns % 10 == 0:
                self.rover.see(self.surroundings, self.now)
            received, self._waiting = self._waiting, []
            said, drive = self.rover.step(self.now, received)
            mine = [message for message, to in said if to in (0, self.setup.gcs_system_id)]
            arrived = self.down.through(mine)
            if not self.blocked:
                self.velocity = Velocity(self.signs[0] * drive.u_mps, self.signs[1] * drive.w_radps)
        if self.sees and self._turns % 10 == 0:
            self.session.see(ExternalPose(pose=self.pose), self.now)
        if not self.cut:
            self.session.receive(self.between(arrived), self.now)
        self.session.advance(self.now)
        if self.order is not None and self._turns % 5 == 0:
            self.session.write(self.order, self.now)
        motion, scan = self.session.motion(self.now), self.session.scan(self.now)
        if motion is not None:
            self.motions.append(motion)
            self.standing.take(motion, self.now)
        if scan is not None:
            self.scans.append(scan)
        self.flush()

    def flush(self) -> None:
        out, self.session.outbox = self.session.outbox, []
        self.sent.update(message.get_type() for message in out)
        self.log += [(self.now, message) for message in out]
        if not self.cut:
            self._waiting += self._up.through(self.upward(out))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * SECOND / STEP)):
            self.turn()

    def until(self, what: Callable[[], object], within_s: float = 30.0) -> float:
        """How long it took, s."""
        began = self.now
        while not what():
            assert self.now - began < within_s * SECOND, (self.session.state, self.session.reason)
            self.turn()
        return to_seconds(self.now - began)

    def take(self, step: Any) -> None:
        self.session.take(step, self.now)
        self.flush()

    def reach(self, state: str) -> None:
        """Up to a state, step by step."""
        steps = {"closed": "connect", "connected": "configure", "configured": "activate", "fault": "close"}
        while self.session.state != state:
            before = self.session.state
            self.take(steps[before])
            self.until(partial(self._has_left, before))

    def _has_left(self, before: str) -> bool:
        return self.session.state != before

    def velocities(self, since: Time = 0) -> list[tuple[float, float]]:
        """(u, w) of every set-point the session sent."""
        return [
            (round(m.vx, 6), round(-m.yaw_rate, 6))
            for at, m in self.log
            if at >= since and m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
        ]


def drive(u: float = 0.3, w: float = 0.0, active: bool = True, alive: bool = True) -> Drive:
    return Drive(u_mps=u, w_radps=w, active=active, controller_alive=alive)
