"""MAVSDK, a MAVLink stack that shares no code with ours or with pymavlink, drives a presented robot."""

import math
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from maniple.core import codec, topics
from maniple.core.messages import Truth, unpack_floats
from maniple.transport.zenoh import ZenohSession
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

ORIGIN = (47.3977, 8.5456, 488.0)
SCENARIO = """
name = "shown"
formation.points = [[0.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]]
task = {{ kind = "line", start = [0.0, 0.0], end = [5.0, 0.0], speed_mps = 0.1 }}

[[robots]]
id = "r1"
driver = "mavlink"
presents = "mavlink"
pose = [3.0, -2.0, 0.5]
mavlink = {{ connection = "tcp:127.0.0.1:{port}", origin = [47.3977, 8.5456, 488.0] }}

[[robots]]
id = "r2"

[[robots]]
id = "r3"
"""


@pytest.fixture
def presented(tmp_path: Path) -> Iterator[tuple[int, list[Truth]]]:
    """The port of a presented robot, and the ground truth as it comes."""
    port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
    scenario = tmp_path / "shown.toml"
    scenario.write_text(SCENARIO.format(port=port))
    truths: list[Truth] = []

    def heard(topic: str, data: bytes) -> None:
        truth = codec.decode(topic, data)
        assert isinstance(truth, Truth)
        truths.append(truth)

    with ExitStack() as stack:

        def start(*arguments: str) -> None:
            command = [sys.executable, "-m", "maniple", *arguments, "--scenario", str(scenario)]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            stack.callback(lambda: process.wait(20.0) == 0 or pytest.fail(f"{arguments} failed"))
            stack.callback(process.terminate)

        start("router", "--listen", endpoint)
        start("simulator", "--connect", endpoint)
        start("vehicle", "r1", "--connect", endpoint)
        with ZenohSession.client(endpoint, "maniple", 20.0) as ear:
            ear.subscribe(topics.TRUTH, heard)
            eventually(lambda: ear.lives("r1-vehicle") and truths)
            yield port, truths


@pytest.mark.slow
def test_mavsdk_drives_a_presented_robot(presented: tuple[int, list[Truth]]) -> None:
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.action import Action, ActionError
    from mavsdk.plugins.offboard import Offboard, VelocityBodyYawspeed
    from mavsdk.plugins.param import Param
    from mavsdk.plugins.telemetry import FlightMode, Telemetry

    port, truths = presented
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    try:
        assert sdk.add_any_connection(f"tcpout://127.0.0.1:{port}") == 0
        vehicle = sdk.first_autopilot(20.0)
        assert vehicle is not None
        telemetry, action, offboard = Telemetry(vehicle), Action(vehicle), Offboard(vehicle)
        telemetry.set_rate_position_velocity_ned(20.0)
        telemetry.set_rate_attitude_euler(20.0)

        action.set_gps_global_origin(*ORIGIN)
        eventually(lambda: telemetry.health().is_local_position_ok, 20.0)
        eventually(lambda: telemetry.health_all_ok(), 20.0)
        assert not telemetry.armed()
        eventually(lambda: abs(telemetry.position_velocity_ned().position.north_m + 2.0) < 0.05, 5.0)
        assert telemetry.position_velocity_ned().position.east_m == pytest.approx(3.0, abs=0.05)
        assert telemetry.attitude_euler().yaw_deg == pytest.approx(90.0 - math.degrees(0.5), abs=1.0)

        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        action.arm()
        offboard.start()
        eventually(lambda: telemetry.armed() and telemetry.flight_mode() == FlightMode.OFFBOARD, 5.0)

        offboard.set_velocity_body(VelocityBodyYawspeed(0.4, 0.0, 0.0, -12.0))

        def follows() -> bool:
            velocity = telemetry.position_velocity_ned().velocity
            told = math.hypot(velocity.north_m_s, velocity.east_m_s)
            u, w = map(float, unpack_floats(truths[-1].velocities, 2)[0])
            return bool(max(abs(told - 0.4), abs(u - 0.4), abs(w - math.radians(12.0))) < 0.01)

        eventually(follows, 10.0)
        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        eventually(lambda: abs(unpack_floats(truths[-1].velocities, 2)[0]).max() < 1e-3, 10.0)
        x, y, psi = unpack_floats(truths[-1].poses, 3)[0].tolist()

        def agrees() -> bool:
            here = telemetry.position_velocity_ned().position
            yaw = math.radians(telemetry.attitude_euler().yaw_deg)
            off = here.east_m - x, here.north_m - y, math.remainder(math.pi / 2 - yaw - psi, 2 * math.pi)
            return bool(max(map(abs, off)) < 0.02)

        eventually(agrees, 5.0)
        assert Param(vehicle).get_param_float("WP_SPEED") == 2.0
        offboard.stop()
        action.disarm()
        eventually(lambda: not telemetry.armed(), 5.0)
        with pytest.raises(ActionError):
            action.takeoff()
    finally:
        sdk.destroy()
