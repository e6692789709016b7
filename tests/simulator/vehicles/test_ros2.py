"""A simulated body as a robot that speaks ROS 2: what it makes of velocities, and what it says."""

import math
import socket
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from maniple.cli.loading import loads, robot_models
from maniple.core.errors import ScenarioError, TransportError
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, Motion, Scan, pack_floats
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import MILLISECOND, SECOND
from maniple.transport.ros2 import Network, RosSession
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, TF, TWIST, TWIST_STAMPED
from maniple.transport.ros2_keys import LATCHED, Layout
from maniple.transport.ros2_messages import (
    Velocity3,
    ns_of,
    pose_of,
    twist,
    twist_stamped,
    yaw_of,
)
from maniple.transport.zenoh import ZenohSession
from simulator.vehicles import vehicle_of
from simulator.vehicles.ros2 import TIMEOUT, Ros2Vehicle, VelocityCommand
from tests.waiting import eventually

DEADLINE_S = 20.0
NOW = 1_700_000_000 * SECOND
STAND = Drive(u_mps=0.0, w_radps=0.0, active=False)
PIONEER = robot_models()["pioneer-3dx"]

SCENE = """
name = "ros"
task = {{ kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15 }}
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [
  {{ id = "r1" }},
  {{ id = "r2", driver = "ros2", presents = "ros2", {extra} }},
  {{ id = "r3" }},
]
"""


def scene(extra: str = "ros2 = {}") -> tuple[Scenario, Robot]:
    scenario = loads(SCENE.format(extra=extra).encode())
    return scenario, scenario.robots[1]


@pytest.fixture
def endpoint() -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with ZenohSession.router(address, "maniple"):
        yield address


def moved(x: float, y: float, psi: float, u: float = 0.0) -> Motion:
    return Motion(
        ticks=(), applied=(u, 0.0), state="active", controllable=True, pose=(x, y, psi), twist=(u, 0.1, 0.0)
    )


def test_a_velocity_counts_for_half_a_second() -> None:
    command = VelocityCommand(PIONEER)
    assert command.order(NOW) == STAND
    command.take(Velocity3(0.3, -0.2, 0.0), 0, NOW)
    assert command.order(NOW + TIMEOUT) == Drive(u_mps=0.3, w_radps=-0.2, active=True)
    assert command.order(NOW + TIMEOUT + 1) == STAND


def test_a_stamp_counts_instead_of_the_arrival() -> None:
    command = VelocityCommand(PIONEER)
    command.take(Velocity3(0.3, 0.0, 0.0), NOW - 400 * MILLISECOND, NOW)
    assert command.order(NOW + 100 * MILLISECOND).u_mps == 0.3
    assert command.order(NOW + 101 * MILLISECOND) == STAND


def test_what_comes_too_late_counts_for_nothing() -> None:
    command = VelocityCommand(PIONEER)
    command.take(Velocity3(0.3, 0.0, 0.0), NOW - TIMEOUT - 1, NOW)
    assert (command.order(NOW), command.late) == (STAND, 1)


def test_a_stamp_from_the_future_does_not_keep_it_going() -> None:
    command = VelocityCommand(PIONEER)
    command.take(Velocity3(0.3, 0.0, 0.0), NOW + 3600 * SECOND, NOW)
    assert command.order(NOW + TIMEOUT).u_mps == 0.3
    assert command.order(NOW + TIMEOUT + 1) == STAND


def test_it_goes_no_faster_than_its_model() -> None:
    command = VelocityCommand(PIONEER)
    command.take(Velocity3(9.0, -9.0, 9.0), 0, NOW)
    order = command.order(NOW)
    assert (order.u_mps, order.w_radps, order.v_mps) == (PIONEER.u_max_mps, -PIONEER.w_max_radps, 0.0)


@pytest.mark.parametrize("layout", ["rmw_zenoh", "ros2dds"])
def test_it_says_where_it_is_from_where_it_stood_first(endpoint: str, layout: Layout) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    frames: SimpleQueue[Any] = SimpleQueue()
    scenario, robot = scene(f"ros2 = {{ layout = '{layout}' }}")
    vehicle = vehicle_of(scenario, robot, endpoint)
    with RosSession.open(endpoint, "rviz", network=Network(layout)) as rviz:
        rviz.subscribe("/r2/odom", ODOMETRY, lambda message, _: heard.put(message))
        rviz.subscribe("/r2/tf", TF, lambda message, _: frames.put(message))
        rviz.zenoh.settle()
        vehicle.open(NOW)
        start = Pose(3.0, 2.0, math.pi / 2)
        vehicle.see(moved(*start), NOW)
        vehicle.see(moved(*start.advance(1.0, 0.5), u=0.4), NOW + 5)
        first, second = heard.get(timeout=DEADLINE_S), heard.get(timeout=DEADLINE_S)
        frames.get(timeout=DEADLINE_S)
        (base,) = frames.get(timeout=DEADLINE_S).transforms
        vehicle.close(NOW)
    assert pose_of(first)[0] == pytest.approx(Pose(0.0, 0.0, 0.0), abs=1e-9)
    at, velocity = pose_of(second)
    assert at == pytest.approx(Pose(0.0, 0.0, 0.0).advance(1.0, 0.5))
    assert velocity == Velocity3(0.4, 0.1, 0.0)
    assert (second.header.frame_id, second.child_frame_id) == ("odom", "base_link")
    assert ns_of(second.header.stamp) == NOW + 5
    assert (base.header.frame_id, base.child_frame_id) == ("odom", "base_link")
    assert yaw_of(base.transform.rotation) == pytest.approx(at.psi)


def test_in_the_world_it_says_where_in_the_world_it_is(endpoint: str) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    vehicle = Ros2Vehicle(*scene("ros2 = { in_world = true }"), endpoint)
    with RosSession.open(endpoint, "rviz") as rviz:
        rviz.subscribe("/r2/odom", ODOMETRY, lambda message, _: heard.put(message))
        rviz.zenoh.settle()
        vehicle.open(NOW)
        vehicle.see(moved(3.0, 2.0, 1.0), NOW)
        message = heard.get(timeout=DEADLINE_S)
        vehicle.close(NOW)
    assert pose_of(message)[0] == pytest.approx(Pose(3.0, 2.0, 1.0))
    assert message.header.frame_id == "map"


def test_its_scans_are_rep_117_and_its_laser_has_a_place(endpoint: str) -> None:
    scans: SimpleQueue[Any] = SimpleQueue()
    places: SimpleQueue[Any] = SimpleQueue()
    scenario, robot = scene()
    vehicle = Ros2Vehicle(scenario, robot, endpoint)
    vehicle.open(NOW)
    with RosSession.open(endpoint, "rviz") as rviz:
        rviz.subscribe("/r2/scan", LASER_SCAN, lambda message, _: scans.put(message))
        rviz.subscribe("/r2/tf_static", TF, lambda message, _: places.put(message), LATCHED)
        rviz.zenoh.settle()
        scan = Scan(
            first_angle_rad=-0.5,
            increment_rad=0.5,
            range_min_m=0.1,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=pack_floats([0.0, 2.0, 8.0]),
        )
        vehicle.see(scan, NOW)
        said = scans.get(timeout=DEADLINE_S)
        (place,) = places.get(timeout=DEADLINE_S).transforms
        vehicle.close(NOW)
    assert np.array_equal(said.ranges, [-np.inf, 2.0, np.inf])
    assert said.header.frame_id == place.child_frame_id == "laser"
    assert place.header.frame_id == "base_link"
    assert place.transform.translation.x == scenario.model_of(robot).sensor_mount[0]


@pytest.mark.parametrize("stamped", [False, True])
def test_it_drives_as_it_is_told_and_refuses_what_is_not_finite(endpoint: str, stamped: bool) -> None:
    vehicle = Ros2Vehicle(*scene(f"ros2 = {{ stamped = {str(stamped).lower()} }}"), endpoint)
    vehicle.open(NOW)
    with RosSession.open(endpoint, "teleop") as teleop:
        hand = teleop.advertise("/r2/cmd_vel", TWIST_STAMPED if stamped else TWIST)
        eventually(lambda: hand.subscriptions, DEADLINE_S)

        def say(u: float, stamp: int = NOW) -> None:
            velocity = Velocity3(u, 0.0, 0.0)
            hand.publish(twist_stamped(velocity, stamp, "base_link") if stamped else twist(velocity))

        say(math.nan)
        say(0.2)
        eventually(lambda: vehicle.step(NOW) == Drive(u_mps=0.2, w_radps=0.0, active=True), DEADLINE_S)
        assert vehicle.refused == 1
        if stamped:
            say(0.3, NOW - SECOND)
            eventually(lambda: vehicle.step(NOW) and vehicle.refused == 2, DEADLINE_S)
            assert vehicle.step(NOW).u_mps == 0.2
    assert vehicle.step(NOW + SECOND) == STAND
    vehicle.close(NOW)
    vehicle.close(NOW)


def test_before_it_is_switched_on_it_says_nothing_and_stands() -> None:
    vehicle = Ros2Vehicle(*scene(), "tcp/127.0.0.1:1")
    vehicle.see(moved(0.0, 0.0, 0.0), NOW)
    assert vehicle.step(NOW) == STAND
    vehicle.close(NOW)


def test_transducers_are_no_laser_scan() -> None:
    with pytest.raises(ScenarioError, match=r"robots: r2: sensor = 'pioneer-3dx-sonar': .* choose a fan"):
        Ros2Vehicle(*scene("sensor = 'pioneer-3dx-sonar'"))


def test_without_a_router_it_can_not_be_switched_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.vehicles.ros2._OPEN_S", 0.2)
    with pytest.raises(TransportError, match="can't reach a router"):
        Ros2Vehicle(*scene(), "tcp/127.0.0.1:1").open(NOW)
