"""MAVSDK, a MAVLink stack that shares no code with ours or with pymavlink, drives a presented robot, and a
real ArduPilot Rover where there is one."""

import math

import pytest

from maniple.core.messages import unpack_floats
from tests.ardurover import HOME
from tests.simulator.vehicles.peers import POSE, Peer
from tests.waiting import eventually


@pytest.mark.slow
def test_mavsdk_drives_it(peer: Peer) -> None:
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.action import Action, ActionError
    from mavsdk.plugins.offboard import Offboard, VelocityBodyYawspeed
    from mavsdk.plugins.param import Param
    from mavsdk.plugins.telemetry import FlightMode, Telemetry

    port, truths = peer
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    try:
        assert sdk.add_any_connection(f"tcpout://127.0.0.1:{port}") == 0
        vehicle = sdk.first_autopilot(30.0)
        assert vehicle is not None
        telemetry, action, offboard = Telemetry(vehicle), Action(vehicle), Offboard(vehicle)
        telemetry.set_rate_position_velocity_ned(20.0)
        telemetry.set_rate_attitude_euler(20.0)

        def told() -> tuple[float, float, float, float]:
            """(east, north, heading counter-clockwise from east, speed)."""
            seen = telemetry.position_velocity_ned()
            heading = 0.5 * math.pi - math.radians(telemetry.attitude_euler().yaw_deg)
            speed = math.hypot(seen.velocity.north_m_s, seen.velocity.east_m_s)
            return seen.position.east_m, seen.position.north_m, heading, speed

        def is_at(x: float, y: float, psi: float) -> bool:
            east, north, heading, _ = told()
            off = east - x, north - y, math.remainder(heading - psi, 2.0 * math.pi)
            return max(map(abs, off)) < 0.02

        action.set_gps_global_origin(*HOME)
        eventually(lambda: telemetry.health().is_local_position_ok, 60.0)
        eventually(lambda: telemetry.health_all_ok(), 60.0)
        assert not telemetry.armed()
        if truths:
            eventually(lambda: is_at(*POSE), 5.0)

        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        action.arm()
        offboard.start()
        eventually(lambda: telemetry.armed() and telemetry.flight_mode() == FlightMode.OFFBOARD, 5.0)

        start = told()
        offboard.set_velocity_body(VelocityBodyYawspeed(0.4, 0.0, 0.0, -12.0))

        def follows() -> bool:
            errors = [told()[3] - 0.4]
            if truths:
                u, w = map(float, unpack_floats(truths[-1].velocities, 2)[0])
                errors += [u - 0.4, w - math.radians(12.0)]
            return max(map(abs, errors)) < 0.01

        eventually(follows, 15.0)
        eventually(lambda: math.remainder(told()[2] - start[2], 2.0 * math.pi) > 0.4, 15.0)  # to the left
        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        eventually(lambda: told()[3] < 0.01, 10.0)
        assert math.dist(told()[:2], start[:2]) > 0.5
        if truths:
            eventually(lambda: abs(unpack_floats(truths[-1].velocities, 2)[0]).max() < 1e-3, 10.0)
            eventually(lambda: is_at(*unpack_floats(truths[-1].poses, 3)[0].tolist()), 5.0)

        assert Param(vehicle).get_param_float("WP_SPEED") > 0.0
        offboard.stop()
        action.disarm()
        eventually(lambda: not telemetry.armed(), 5.0)
        with pytest.raises(ActionError):
            action.takeoff()
    finally:
        sdk.destroy()
