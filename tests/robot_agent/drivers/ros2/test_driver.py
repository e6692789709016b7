"""The driver against a robot over a real router: what it tells, what it waits for, and what it never does."""

import math
import random
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from maniple.core.errors import ManipleError, ScenarioError
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, ExternalPose, Motion, Scan, unpack_floats
from maniple.core.time import SECOND
from maniple.transport.ros2 import Network, RosSession
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, TWIST, TWIST_STAMPED, encode, type_hash
from maniple.transport.ros2_keys import Attachment, Layout, data_key
from maniple.transport.ros2_messages import (
    Velocity3,
    ns_of,
    odometry,
    twist,
    velocity_of,
)
from maniple.transport.zenoh import ZenohSession
from robot_agent.drivers.interface import Step
from robot_agent.drivers.ros2.driver import Ros2Driver
from tests.robot_agent.drivers.ros2.peer import Peer, free_port, scene
from tests.transport.test_ros2_cdr import corrupted

DEADLINE_S = 15.0
STILL = Velocity3(0.0, 0.0, 0.0)
OPEN: list[Callable[[], None]] = []
"""What ends what a test has opened."""


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    """A session that is left open keeps the interpreter from ending."""
    yield
    while OPEN:
        OPEN.pop()()


class Robot:
    """A robot that says what it is told to, 50 times a second."""

    def __init__(self, endpoint: str, network: Network, stamped: bool = False, takes: bool = True) -> None:
        self.ros = RosSession.open(endpoint, "base", "/r2", network)
        OPEN.append(self.ros.close)
        self.heard: list[Any] = []
        self.pose: Pose | None = Pose(0.0, 0.0, 0.0)
        self.stamp = 1_000 * SECOND
        self._odom = self.ros.advertise("odom", ODOMETRY)
        if takes:
            kind = TWIST_STAMPED if stamped else TWIST
            self.ros.subscribe("cmd_vel", kind, lambda message, _: self.heard.append(message))

    def live(self) -> None:
        if self.pose is not None:
            self._odom.publish(odometry(self.pose, STILL, self.stamp, "odom", "base_link"))


class Bench:
    """A driver as its process calls it, and the robot beside it."""

    def __init__(self, endpoint: str, extra: str = "ros2 = {}") -> None:
        scenario, robot = scene(extra)
        self.driver = Ros2Driver(scenario, robot, endpoint)
        OPEN.append(lambda: self.take("close"))
        self.robot: Robot | None = None
        self.order: Drive | None = None
        self.motions: list[Motion] = []
        self.scans: list[Scan] = []
        self._turns = 0

    def turn(self) -> None:
        time.sleep(0.01)
        self._turns += 1
        if self.robot is not None and self._turns % 2 == 0:
            self.robot.live()
        for report in self.driver.read(time.monotonic_ns()):
            if isinstance(report, Motion):
                self.motions.append(report)
            else:
                self.scans.append(report)
        if self.order is not None:
            self.driver.write(self.order, time.monotonic_ns())

    def until(self, what: Callable[[], Any], within_s: float = DEADLINE_S) -> None:
        end = time.monotonic() + within_s
        while not what():
            assert time.monotonic() < end, f"{self.driver.state}: {self.driver.reason}"
            self.turn()

    def turns(self, count: int) -> None:
        for _ in range(count):
            self.turn()

    def take(self, step: Step) -> None:
        self.driver.take(step, time.monotonic_ns())

    def bring_up(self, *steps: Step) -> None:
        reached = {"connect": "connected", "configure": "configured", "activate": "active"}
        for step in steps or ("connect", "configure", "activate"):
            self.take(step)
            self.reach(reached[step])

    def reach(self, state: str) -> None:
        self.until(lambda: self.driver.state == state)

    def drive(self, u: float) -> None:
        self.order = Drive(u_mps=u, w_radps=0.0, active=True, controller_alive=True)

    def says(self, text: str) -> None:
        """Sooner or later this is its reason."""
        self.until(lambda: text in self.driver.reason)


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple"):
        yield address


@pytest.fixture
def bench(endpoint: str) -> Bench:
    bench = Bench(endpoint)
    bench.robot = Robot(endpoint, Network())
    return bench


def commanded(bench: Bench) -> list[float]:
    assert bench.robot is not None
    return [velocity_of(message).u for message in bench.robot.heard]


def test_it_drives_reports_and_ends_with_zeros(bench: Bench) -> None:
    robot = bench.robot
    assert robot is not None
    bench.bring_up()
    bench.drive(0.3)
    bench.until(lambda: 0.3 in commanded(bench))
    robot.pose = Pose(0.05, 0.0, 0.1)
    bench.until(lambda: bench.motions[-1].pose is not None and bench.motions[-1].pose[0] == 0.05)
    assert bench.motions[-1].pose == pytest.approx((0.05, 0.0, 0.1))
    assert bench.motions[-1].controllable
    assert bench.motions[-1].applied == (0.3, 0.0)
    bench.order = None
    bench.driver.stop(time.monotonic_ns())
    bench.until(lambda: commanded(bench)[-1] == 0.0)
    told = len(robot.heard)
    bench.driver.stop(time.monotonic_ns())
    bench.turns(10)
    assert len(robot.heard) == told  # it was told once, and stands


def test_nothing_is_published_before_it_is_active_nor_after(bench: Bench) -> None:
    bench.drive(0.3)
    bench.bring_up("connect", "configure")
    bench.turns(20)
    assert commanded(bench) == []
    bench.bring_up("activate")
    bench.until(lambda: 0.3 in commanded(bench))
    bench.take("deactivate")
    bench.turns(10)
    told = commanded(bench)
    assert told[-1] == 0.0
    bench.turns(20)
    assert commanded(bench) == told


def test_an_order_that_does_not_want_it_active_is_a_zero(bench: Bench) -> None:
    bench.bring_up()
    bench.order = Drive(u_mps=0.3, w_radps=0.0, active=False)
    bench.until(lambda: len(commanded(bench)) > 3)
    assert set(commanded(bench)) == {0.0}


def test_too_much_is_clipped_and_a_robot_that_can_not_goes_not_sideways(bench: Bench) -> None:
    bench.bring_up()
    bench.order = Drive(u_mps=9.0, w_radps=-9.0, v_mps=1.0, active=True)
    bench.until(lambda: commanded(bench))
    assert bench.robot is not None
    able = bench.driver.capabilities
    assert velocity_of(bench.robot.heard[-1]) == (able.u_max_mps, -able.w_max_radps, 0.0)


@pytest.mark.slow
def test_no_router_is_told_and_tried_again(endpoint: str) -> None:
    bench = Bench(f"tcp/127.0.0.1:{free_port()}")
    bench.take("connect")
    bench.says("can't reach a router")
    assert bench.driver.state == "closed"
    bench.take("connect")
    bench.turn()
    assert "can't reach a router" in bench.driver.reason


def test_a_robot_whose_id_ros_2_does_not_know_needs_a_namespace() -> None:
    scenario, robot = scene()
    with pytest.raises(ScenarioError, match=r"r-2: ros2\.namespace, by default the robot's id: '/r-2' is no"):
        Ros2Driver(scenario, msgspec.structs.replace(robot, id="r-2"))


def test_without_any_router_to_connect_to_it_says_where_to_name_it() -> None:
    with pytest.raises(ManipleError, match=r"ros2\.router: no router is known; must be as"):
        Bench("").take("connect")


def test_a_robot_that_is_not_there_is_told_of_with_what_is(endpoint: str) -> None:
    bench = Bench(endpoint)
    bench.take("connect")
    bench.says("there is no ROS 2 topic at all")
    with RosSession.open(endpoint, "other") as other:
        other.advertise("/r7/odom", ODOMETRY)
        bench.says("nobody shows /r2/odom or /r2/cmd_vel")
        bench.says("there is /r7/odom")


def test_odometry_that_does_not_come_is_told_and_of_another_type_too(endpoint: str) -> None:
    bench = Bench(endpoint)
    bench.robot = Robot(endpoint, Network())
    bench.robot.pose = None
    bench.bring_up("connect")
    bench.take("configure")
    bench.says(f"no {ODOMETRY} on /r2/odom")
    bench.robot.ros.advertise("odom", TWIST)
    bench.says("but geometry_msgs/msg/Twist")


@pytest.mark.slow
def test_odometry_that_comes_too_seldom_is_told(bench: Bench) -> None:
    bench.bring_up("connect")
    robot, bench.robot = bench.robot, None
    assert robot is not None
    bench.take("configure")
    for _ in range(14):
        robot.live()
        bench.turns(14)
    assert "times a second; rates.motion_hz needs 10 or more" in bench.driver.reason
    assert bench.driver.state == "connected"
    bench.robot = robot


@pytest.mark.parametrize(("stamped", "taken"), [(True, TWIST), (False, TWIST_STAMPED)])
def test_a_robot_that_takes_the_other_velocities_is_told_of(endpoint: str, stamped: bool, taken: str) -> None:
    bench = Bench(endpoint, f"ros2 = {{ stamped = {str(stamped).lower()} }}")
    bench.robot = Robot(endpoint, Network(), stamped=not stamped)
    bench.bring_up("connect", "configure")
    bench.take("activate")
    bench.says(f"/r2/cmd_vel takes {taken}")
    bench.says("see robots.ros2.stamped")
    assert bench.driver.state == "configured"
    assert not bench.motions[-1].controllable


def test_nobody_who_takes_velocities_is_told(endpoint: str) -> None:
    bench = Bench(endpoint)
    bench.robot = Robot(endpoint, Network(), takes=False)
    bench.bring_up("connect", "configure")
    bench.says("nobody takes /r2/cmd_vel")


def test_stamps_are_by_the_clock_of_the_robot(endpoint: str) -> None:
    bench = Bench(endpoint, "ros2 = { stamped = true }")
    bench.robot = robot = Robot(endpoint, Network(), stamped=True)
    bench.bring_up()
    bench.drive(0.1)
    bench.until(lambda: len(robot.heard) > 5)
    for message in robot.heard[:5]:
        assert 0 <= ns_of(message.header.stamp) - robot.stamp < SECOND // 2
        assert message.header.frame_id == "base_link"
    robot.stamp = 0  # it does not say
    bench.until(lambda: ns_of(robot.heard[-1].header.stamp) == 0)


def test_somebody_else_who_commands_the_robot_is_told_of_and_not_fought(bench: Bench, endpoint: str) -> None:
    bench.bring_up()
    bench.drive(0.3)
    bench.until(lambda: 0.3 in commanded(bench))
    with RosSession.open(endpoint, "teleop") as pilot:
        hand = pilot.advertise("/r2/cmd_vel", TWIST)
        pilot.zenoh.settle()
        hand.publish(twist(Velocity3(0.1, 0.0, 0.0)))
        bench.until(lambda: "somebody else commands" in bench.driver.reason)
        assert bench.driver.state == "active"
        told = len(commanded(bench))
        for _ in range(5):
            hand.publish(twist(Velocity3(0.1, 0.0, 0.0)))
            bench.driver.stop(time.monotonic_ns())
            bench.turns(5)
        assert not bench.motions[-1].controllable
        assert set(commanded(bench)[told:]) == {0.1}
    bench.until(lambda: bench.motions[-1].controllable)
    bench.until(lambda: commanded(bench)[-1] == 0.3)


def test_two_who_say_where_the_robot_is_are_one_too_many(bench: Bench, endpoint: str) -> None:
    bench.bring_up()
    with RosSession.open(endpoint, "filter") as second:
        other = second.advertise("/r2/odom", ODOMETRY)
        second.zenoh.settle()

        def both() -> bool:
            other.publish(odometry(Pose(5.0, 5.0, 0.0), STILL, 1, "odom", "base_link"))
            return "two programs publish on /r2/odom" in bench.driver.reason

        bench.until(both)
    bench.until(lambda: bench.motions[-1].controllable)
    assert all(motion.pose in (None, (0.0, 0.0, 0.0)) for motion in bench.motions)


def test_a_robot_that_is_silent_is_told_to_stand_and_comes_back(bench: Bench) -> None:
    robot = bench.robot
    assert robot is not None
    bench.bring_up()
    bench.drive(0.3)
    bench.until(lambda: 0.3 in commanded(bench))
    robot.pose = None
    bench.says(f"no {ODOMETRY} on /r2/odom")
    assert not bench.motions[-1].controllable
    assert bench.motions[-1].pose is None
    bench.until(lambda: commanded(bench)[-1] == 0.0)
    assert bench.driver.state == "active"
    robot.pose = Pose(0.1, 0.0, 0.0)
    bench.until(lambda: bench.motions[-1].controllable)
    bench.until(lambda: commanded(bench)[-1] == 0.3)


def test_odometry_that_jumps_began_anew_and_so_does_the_driver(bench: Bench) -> None:
    robot = bench.robot
    assert robot is not None
    bench.bring_up()
    bench.drive(0.3)
    robot.pose = Pose(7.0, 0.0, 0.0)
    bench.until(lambda: bench.driver.state == "fault")
    assert bench.driver.reason == "the odometry on /r2/odom began anew"
    bench.turn()
    assert not bench.motions[-1].controllable
    assert all(motion.pose != (7.0, 0.0, 0.0) for motion in bench.motions)
    bench.order = None
    bench.take("close")
    bench.bring_up()
    bench.until(lambda: bench.motions[-1].pose == (7.0, 0.0, 0.0))


def test_another_life_of_the_robot_is_another_frame(bench: Bench, endpoint: str) -> None:
    bench.bring_up()
    assert bench.robot is not None
    bench.robot.ros.close()
    bench.robot = None
    bench.says("/r2/odom")
    bench.robot = Robot(endpoint, Network())
    bench.until(lambda: bench.driver.state == "fault")


def test_a_robot_in_the_world_frame_may_jump(endpoint: str) -> None:
    bench = Bench(endpoint, "ros2 = { in_world = true }")
    bench.robot = Robot(endpoint, Network())
    assert bench.driver.capabilities.frame == "world"
    bench.bring_up()
    bench.robot.pose = Pose(7.0, 0.0, 0.0)
    bench.until(lambda: bench.motions[-1].pose == (7.0, 0.0, 0.0))


def test_odometry_that_is_none_is_refused_and_told(bench: Bench) -> None:
    bench.bring_up()
    assert bench.robot is not None
    bench.robot.pose = Pose(math.nan, 0.0, 0.0)
    bench.says("the position (nan, 0) is none")
    assert not bench.motions[-1].controllable
    assert "on /r2/odom (the position (nan, 0) is none)" in bench.driver.answers()["refused"]


def test_it_tells_what_the_robot_shows(bench: Bench, endpoint: str) -> None:
    bench.bring_up("connect", "configure")
    answers = bench.driver.answers()
    assert answers["router"] == endpoint
    assert answers["nodes"] == "/r2/base"
    assert answers["cmd_vel"] == "/r2/cmd_vel: geometry_msgs/msg/Twist (/r2/base)"
    assert answers["odom"].startswith("/r2/odom: ")
    assert "Hz, nav_msgs/msg/Odometry (/r2/base)" in answers["odom"]
    assert answers["frames"] == "odom -> base_link"
    assert answers["scan"] == "/r2/scan: nothing heard"
    bench.driver.see(ExternalPose(pose=(0.0, 0.0, 0.0)), 0)
    assert Bench(endpoint).driver.answers() == {}


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ("ros2 = { cmd_vel = 'cmd vel' }", "cmd_vel: 'cmd vel' is no ROS 2 name"),
        ("ros2 = { namespace = 'robot-2' }", "namespace: '/robot-2' is no ROS 2 name"),
        ("ros2 = { odom = '' }", "odom: '' is no ROS 2 name"),
    ],
)
def test_names_that_ros_2_does_not_know_are_refused(extra: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=rf"robots: r2: ros2\.{said}"):
        Bench("", extra)


def test_another_driver_may_have_its_scans_from_here(endpoint: str) -> None:
    scenario, robot = scene()
    robot = msgspec.structs.replace(robot, driver="mavlink", scans="ros2", presents="nothing")
    bench = Bench(endpoint)
    bench.driver = Ros2Driver(scenario, robot, endpoint)
    assert bench.driver.capabilities.scan_hz == 10.0
    with RosSession.open(endpoint, "laser", "/r2") as laser:
        says = laser.advertise("scan", LASER_SCAN)
        bench.take("connect")
        bench.until(lambda: bench.driver.state == "connected")
        bench.take("configure")
        bench.says(f"no {LASER_SCAN} on /r2/scan")
        while not bench.scans:
            says.publish(a_scan())
            bench.turn()
        assert not laser.entities("MP", "/r2/cmd_vel")
    assert unpack_floats(bench.scans[0].ranges).tolist() == [1.0, 8.0, 0.0]
    assert bench.scans[0].mount == scenario.model_of(robot).sensor_mount
    assert bench.motions == []


def a_scan() -> Any:
    from maniple.transport.ros2_cdr import new
    from maniple.transport.ros2_messages import header

    return new(
        LASER_SCAN,
        header=header(0, "laser"),
        angle_min=0.0,
        angle_max=0.2,
        angle_increment=0.1,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.25,
        range_max=8.0,
        ranges=np.array([1.0, np.inf, np.nan], dtype=np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def test_the_router_may_go_and_come_back() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohSession.router(address, "maniple")
    bench = Bench(address)
    bench.robot = robot = Robot(address, Network())
    bench.bring_up()
    bench.drive(0.3)
    bench.until(lambda: 0.3 in commanded(bench))
    router.close()
    bench.says("is gone")
    assert not bench.motions[-1].controllable
    router = ZenohSession.router(address, "maniple")
    robot.heard.clear()
    bench.until(lambda: bench.motions[-1].controllable)
    bench.until(lambda: 0.3 in commanded(bench))
    assert bench.driver.state == "active"
    OPEN.insert(0, router.close)


def test_while_its_cable_is_cut_the_robot_stands_and_afterwards_is_where_it_rolled_to() -> None:
    """Nobody is told of the cut: bytes just do not come."""
    with Peer(*scene()) as peer:
        bench, start = Bench(peer.endpoint), peer.pose
        bench.bring_up()
        bench.drive(0.3)
        bench.until(lambda: peer.moves.u > 0.25)
        peer.cable.cut()
        bench.says(f"no {ODOMETRY} on /r2/odom")
        bench.until(lambda: abs(peer.moves.u) < 0.01)
        assert not peer.order.active
        bench.drive(0.0)
        peer.cable.restore()
        bench.until(lambda: bench.motions[-1].controllable and abs(peer.moves.u) < 0.001)
        rolled = start.inverse().compose(peer.pose)
        bench.until(lambda: bench.motions[-1].pose == pytest.approx(tuple(rolled), abs=1e-3))
        assert {motion.state for motion in bench.motions if motion.controllable} == {"active", "configured"}
        bench.take("close")


@pytest.mark.parametrize("layout", ["rmw_zenoh", pytest.param("ros2dds", marks=pytest.mark.slow)])
def test_ten_thousand_corrupted_messages_are_counted_and_move_nothing(layout: Layout) -> None:
    """Into a driver that is configured and into the robot, from which nobody wants anything."""
    extra = f"ros2 = {{ layout = '{layout}' }}"
    good = {
        "odom": (ODOMETRY, encode(odometry(Pose(9.0, 9.0, 1.0), STILL, 1, "odom", "base_link"))),
        "scan": (LASER_SCAN, encode(a_scan())),
        "cmd_vel": (TWIST, encode(twist(Velocity3(0.5, 0.3, 0.0)))),
    }
    chance, attachment = random.Random(11), Attachment(1, 1, bytes(16)).pack()
    with Peer(*scene(extra)) as peer, ZenohSession.client(peer.local, "") as stranger:
        bench, where = Bench(peer.local, extra), peer.pose
        bench.bring_up("connect", "configure")
        for number in range(10_000):
            topic = list(good)[number % 3]
            kind, data = good[topic]
            # What can be decoded is a velocity: those are cut short.
            bad = data[: chance.randrange(len(data) - 8)] if topic == "cmd_vel" else corrupted(data, chance)
            tail = corrupted(attachment, chance) if number % 2 and layout == "rmw_zenoh" else attachment
            stranger.put_raw(data_key(layout, 0, f"/r2/{topic}", kind, type_hash(kind)), bad, tail)
            if number % 100 == 0:
                bench.turn()
        bench.until(lambda: peer.vehicle.refused > 1_000)
        bench.turns(80)
        refused = {
            topic: int(count)
            for count, topic in re.findall(r"(\d+) on ([^\s;]+)", bench.driver.answers()["refused"])
        }
        assert refused.keys() == {f"/r2/{topic}" for topic in good}
        assert min(refused.values()) > 500
        assert peer.pose == where
        assert peer.order == Drive(u_mps=0.0, w_radps=0.0, active=False)
        # Forged odometry that could be decoded is a reason to begin anew.
        bench.take("close")
        bench.bring_up()
        bench.until(lambda: bench.motions[-1].controllable)
        bench.take("close")
