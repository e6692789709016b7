"""What is asked of a rover over its socket: the presented one, and the real one where there is one."""

import math
import time
from collections.abc import Callable
from typing import Any

import pytest

from maniple.transport.mavlink import MavlinkLink
from simulator.vehicles.rover import ACCEPTED, DENIED, GUIDED, HOLD
from tests.ardurover import HOME
from tests.simulator.vehicles.bench import dialect
from tests.simulator.vehicles.peers import Peer
from tests.waiting import eventually


class Station:
    """A ground station. It notes what it hears with the vehicle's own time."""

    def __init__(self, port: int) -> None:
        self.link = MavlinkLink.open(f"tcp:127.0.0.1:{port}", 255, 190, 30.0)
        self.newest: dict[str, Any] = {}
        self.speeds: list[tuple[float, float]] = []
        self.velocity: tuple[float, float] | None = None
        self._beat = self._sent = 0.0

    def live(self) -> None:
        """Hear, and say what is due: heartbeats, and the velocity at 20 Hz."""
        now = time.monotonic()
        if now - self._beat >= 1.0:
            self._beat = now
            self.link.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        if self.velocity is not None and now - self._sent >= 0.05:
            self._sent = now
            u, rate = self.velocity
            zeros = [0.0] * 3
            self.link.send(
                dialect.MAVLink_set_position_target_local_ned_message(
                    0, 1, 1, 8, 0x5E7, *zeros, u, 0.0, 0.0, *zeros, 0.0, rate
                )
            )
        for message in self.link.receive():
            self.newest[message.get_type()] = message
            if message.get_type() == "LOCAL_POSITION_NED":
                at = 1e-3 * message.time_boot_ms
                self.speeds.append((at, math.hypot(message.vx, message.vy)))

    def until(self, holds: Callable[[], object], within_s: float) -> None:
        def asked() -> object:
            self.live()
            return holds()

        eventually(asked, within_s)

    def command(self, command: int, *params: float) -> int:
        """The result of a command."""
        self.newest.pop("COMMAND_ACK", None)
        given = [*params, *[0.0] * (7 - len(params))]
        self.link.send(dialect.MAVLink_command_long_message(1, 1, command, 0, *given))
        self.until(lambda: getattr(self.newest.get("COMMAND_ACK"), "command", None) == command, 10.0)
        return int(self.newest["COMMAND_ACK"].result)

    def speed(self) -> float:
        return self.speeds[-1][1]

    def since(self, mark: int, passes: Callable[[float], bool]) -> float:
        """From sample `mark` to the first that passes, s."""
        return next(at for at, speed in self.speeds[mark:] if passes(speed)) - self.speeds[mark][0]


@pytest.mark.slow
def test_a_rover_is_asked_for_all_that_a_driver_relies_on(peer: Peer) -> None:
    port, _ = peer
    station = Station(port)
    set_mode, arm = dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_COMPONENT_ARM_DISARM
    interval = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    try:
        station.until(lambda: "HEARTBEAT" in station.newest, 30.0)
        beat = station.newest["HEARTBEAT"]
        assert (beat.type, beat.autopilot) == (10, 3)
        for kind in ("LOCAL_POSITION_NED", "EKF_STATUS_REPORT", "SYS_STATUS"):
            assert station.command(interval, getattr(dialect, f"MAVLINK_MSG_ID_{kind}"), 25_000) == ACCEPTED
        assert station.command(interval, 65_000, 25_000) == DENIED
        assert station.command(set_mode, 0, GUIDED) == DENIED

        lat, lon, alt = HOME
        origin = dialect.MAVLink_set_gps_global_origin_message(
            1, round(lat * 1e7), round(lon * 1e7), round(alt * 1e3)
        )
        station.link.send(origin)
        wanted = 1 | 2 | 8 | 16  # attitude, velocity, position relative and absolute
        station.until(lambda: station.newest["EKF_STATUS_REPORT"].flags & wanted == wanted, 60.0)
        ready = dialect.MAV_SYS_STATUS_PREARM_CHECK
        station.until(lambda: station.newest["SYS_STATUS"].onboard_control_sensors_health & ready, 60.0)

        station.velocity = 0.5, 0.0
        assert station.command(set_mode, 1, HOLD) == ACCEPTED
        assert station.command(arm, 1) == ACCEPTED
        mark = len(station.speeds)
        station.until(lambda: len(station.speeds) > mark + 30, 10.0)
        assert station.speed() < 0.05  # in HOLD no velocity counts

        station.velocity = None
        assert station.command(set_mode, 1, GUIDED) == ACCEPTED
        station.until(lambda: station.newest["HEARTBEAT"].custom_mode == GUIDED, 5.0)
        station.velocity = 0.5, 0.0
        mark = len(station.speeds) - 1
        station.until(lambda: station.speed() > 0.495, 10.0)
        assert station.since(mark, lambda speed: speed > 0.45) == pytest.approx(0.7, abs=0.25)

        station.velocity = None
        mark = len(station.speeds) - 1
        station.until(lambda: station.speed() < 0.02, 10.0)
        assert station.since(mark, lambda speed: speed < 0.45) == pytest.approx(3.2, abs=0.3)

        station.link.send(dialect.MAVLink_param_set_message(1, 1, b"WP_SPEED", 0.25, 9))
        station.until(lambda: getattr(station.newest.get("PARAM_VALUE"), "param_id", "") == "WP_SPEED", 10.0)
        station.velocity = 0.5, 0.0
        station.until(lambda: station.speed() > 0.24, 10.0)
        mark = len(station.speeds)
        station.until(lambda: len(station.speeds) > mark + 40, 10.0)
        assert max(speed for _, speed in station.speeds[mark:]) < 0.28

        assert station.command(set_mode, 1, HOLD) == ACCEPTED
        station.until(lambda: station.speed() < 0.02, 10.0)
        assert station.command(arm, 0) == ACCEPTED
        station.until(lambda: not station.newest["HEARTBEAT"].base_mode & 128, 5.0)
    finally:
        station.link.close()
