"""A presented rover on a bench: the simulated world, the vehicle, and ground stations that speak to it."""

from collections.abc import Callable
from typing import Any

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as dialect

from maniple.core.messages import Drive, Motion, Scan, Truth, unpack_floats
from maniple.core.node import Received
from maniple.core.scenario.types import Mavlink, Scenario
from maniple.core.time import MILLISECOND, SECOND, Time
from simulator.node import Simulator
from simulator.vehicles.interface import STEP
from simulator.vehicles.rover import ACCEPTED, GUIDED, Rover, Said, spec_of

BOOT: Time = 10**18
SITE = (47.3977, 8.5456, 488.0)
BODY_VELOCITY = 0x5C7
"""Type mask: velocity and yaw rate."""
MakeScenario = Callable[..., Scenario]


def scenario_of(
    make_scenario: MakeScenario, *args: Any, link: Mavlink | None = None, **changes: Any
) -> Scenario:
    """A scenario whose first robot is presented."""
    scenario = make_scenario(*args, **changes)
    link = link or Mavlink(connection="tcp:127.0.0.1:5799", origin=SITE)
    first = msgspec.structs.replace(scenario.robots[0], driver="mavlink", presents="mavlink", mavlink=link)
    return msgspec.structs.replace(scenario, robots=(first, *scenario.robots[1:]))


class Bench:
    """Virtual time; the world, its rover and the stations advance together, 10 ms at a time."""

    def __init__(self, scenario: Scenario) -> None:
        self.robot = scenario.robots[0]
        self.simulator = Simulator(scenario)
        self.simulator.on_start(BOOT)
        self.rover = Rover(spec_of(scenario, self.robot), dialect, BOOT)
        self.now = BOOT
        self.said: list[Said] = []
        self.order = Drive(u_mps=0.0, w_radps=0.0, active=False)
        self.inbox: list[Any] = []
        self.keep: Callable[[Bench], None] = lambda _: None
        """What the stations do every 100 ms."""

    def tell(self, message: Any, system: int = 255) -> None:
        """A station sends a message."""
        self.inbox.append(over_the_wire(message, system))

    def command(self, command: int, *params: float, system: int = 255) -> int:
        """The result in the acknowledgement of a command."""
        given = [*params, *[0.0] * (7 - len(params))]
        self.tell(dialect.MAVLink_command_long_message(1, 1, command, 0, *given), system)
        mark = len(self.said)
        self.run(0.02)
        acks = [m for m, to in self.said[mark:] if m.get_type() == "COMMAND_ACK" and to == system]
        assert [ack.command for ack in acks] == [command]
        return int(acks[0].result)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds * 100)):
            self._tick()
            self.now += 10 * MILLISECOND

    def _tick(self) -> None:
        since = self.now - BOOT
        if since % (50 * MILLISECOND) == 0:
            for topic, message in self.simulator.on_timer("motion", self.now):
                if topic == f"sim/{self.robot.id}/motion" and isinstance(message, Motion):
                    self.rover.see(message, self.now)
        if since % (100 * MILLISECOND) == 0:
            for topic, message in self.simulator.on_timer("scan", self.now):
                if topic == f"sim/{self.robot.id}/scan" and isinstance(message, Scan):
                    self.rover.see(message, self.now)
            self.keep(self)
        if since % STEP == 0:
            received, self.inbox = self.inbox, []
            said, self.order = self.rover.step(self.now, received)
            self.said += [Said(over_the_wire(message, 1), to) for message, to in said]
            drive = Received(f"sim/{self.robot.id}/drive", self.order)
            self.simulator.on_message(drive, self.now)

    def heard(self, kind: str, system: int = 255) -> list[Any]:
        """All messages of a kind that a system was sent."""
        return [m for m, to in self.said if m.get_type() == kind and to in (0, system)]

    def texts(self) -> list[str]:
        return [str(m.text) for m in self.heard("STATUSTEXT")]

    def truth(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """True (x, y, psi) and (u, w)."""
        truth = self.simulator.on_timer("truth", self.now)[0].message
        assert isinstance(truth, Truth)
        return (
            tuple(unpack_floats(truth.poses, 3)[0].tolist()),
            tuple(unpack_floats(truth.velocities, 2)[0].tolist()),
        )

    def go(self, u: float, yaw_rate: float, frame: int = 8, mask: int = BODY_VELOCITY, **more: float) -> None:
        """Send a velocity."""
        fields = {"x": 0.0, "y": 0.0, "z": 0.0, "vx": u, "vy": 0.0, "vz": 0.0, "afx": 0.0, "afy": 0.0}
        fields |= {"afz": 0.0, "yaw": 0.0, "yaw_rate": yaw_rate} | more
        self.tell(dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, **fields))

    def origin(self) -> None:
        """Give it the origin of the scenario."""
        lat, lon, alt = SITE
        self.tell(
            dialect.MAVLink_set_gps_global_origin_message(
                1, round(lat * 1e7), round(lon * 1e7), round(alt * 1e3)
            )
        )

    def start(self) -> None:
        """Bring it to GUIDED, armed."""
        self.run(1.5)
        self.origin()
        self.run(4.0)
        assert self.command(dialect.MAV_CMD_DO_SET_MODE, 1, GUIDED) == ACCEPTED
        assert self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED


def over_the_wire(message: Any, system: int) -> Any:
    """The message as it arrives: packed and parsed again."""
    data = message.pack(dialect.MAVLink(None, system, 1))
    [arrived] = dialect.MAVLink(None).parse_buffer(data)
    return arrived


__all__ = ["BOOT", "SECOND", "Bench", "dialect", "over_the_wire", "scenario_of"]
