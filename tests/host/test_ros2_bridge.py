"""A platoon as ROS 2 sees it, over real routers; the other end is an implementation of its own."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

import pytest
import zenoh_ros2_sdk
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.subscriber import ROS2Subscriber

from maniple.core import codec
from maniple.core.messages import Odometry
from maniple.core.scenario.types import Links, Scenario
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.ros2_bridge import NODE, Ros2Bridge, Told
from maniple.recording.ros2 import Names
from maniple.transport.ros2 import Network, RosSession
from maniple.transport.ros2_keys import LATCHED, Layout
from maniple.transport.zenoh import ZenohSession
from tests.host.test_router import router
from tests.recording.viz.pictures import Seen, run
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

TYPES = get_typestore(Stores.ROS2_JAZZY)
ODOMETRY, TF, SCAN = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/LaserScan"


def scenario() -> Scenario:
    return replace(run().scenario, network=Links(prefix="test"))


class Running:
    """A bridge that runs in a thread of its own."""

    def __init__(self, bridge: Ros2Bridge) -> None:
        self._bridge = bridge
        self._told: list[Told] = []
        self._thread = Thread(target=lambda: self._told.append(bridge.run()))
        self._thread.start()

    def end(self) -> Told:
        self._bridge.stop()
        self._thread.join(DEADLINE_S)
        return self._told[0]


@contextmanager
def bridge(
    fleet: str, ros: str, layout: Layout = "rmw_zenoh", said: list[str] | None = None
) -> Iterator[Running]:
    words: list[str] = [] if said is None else said
    with (
        ZenohSession.client(fleet, "test") as platoon,
        RosSession.open(ros, NODE, network=Network(layout, 7)) as session,
    ):
        running = Running(Ros2Bridge(platoon, session, scenario(), Names(scenario()), words.append))
        try:
            yield running
        finally:
            running._bridge.stop()
            running._thread.join(DEADLINE_S)


def say(session: ZenohSession, seen: Seen, **changes: Any) -> None:
    session.put(seen.topic, codec.encode(replace(seen.message, **changes)))


def words() -> Iterator[Seen]:
    """Odometry, scans and states of the run, from its beginning."""
    kinds = ("odometry", "ranges", "status", "state", "mission")
    return (one for one in run().seen if one.topic.endswith(kinds))


def words_of(robot: str, what: str) -> Iterator[Seen]:
    return (one for one in run().seen if one.topic == f"robot/{robot}/{what}")


def listen(endpoint: str, topic: str, kind: str, latched: bool = False) -> tuple[list[Any], ROS2Subscriber]:
    heard: list[Any] = []
    definition, _ = TYPES.generate_msgdef(kind, ros_version=2)
    subscriber = ROS2Subscriber(
        topic,
        kind,
        heard.append,
        msg_definition=definition,
        domain_id=7,
        router_port=int(endpoint.rsplit(":", 1)[1]),
        type_hash=TYPES.hash_rihs01(kind),
        qos=QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if latched else None,
    )
    return heard, subscriber


def test_an_independent_node_hears_the_platoon() -> None:
    """zenoh-ros2-sdk on a router of its own; stamps are of this computer's clock."""
    with router() as (fleet, _), router() as (ros, _), ZenohSession.client(fleet, "test") as robots:
        odometry, first = listen(ros, "/maniple/r1/odom", ODOMETRY)
        frames, second = listen(ros, "/tf", TF)
        with bridge(fleet, ros) as running:
            came = words()

            def heard() -> bool:
                say(robots, next(came))
                return len(odometry) > 5 and len(frames) > 5

            eventually(heard, DEADLINE_S)
            fixed, third = listen(ros, "/tf_static", TF, latched=True)
            eventually(lambda: fixed, DEADLINE_S)
            told = running.end()
        for subscriber in (first, second, third):
            subscriber.close()
        zenoh_ros2_sdk.ZenohSession.get_instance().close()  # it keeps one session a process
    said = {one.x_m for _, one in run().of(Odometry, "robot/r1/odometry")}
    assert {one.pose.pose.position.x for one in odometry} <= said
    assert (odometry[0].header.frame_id, odometry[0].child_frame_id) == ("r1/odom", "r1/base_link")
    assert abs(odometry[-1].header.stamp.sec - time.time()) < DEADLINE_S
    assert any(one.child_frame_id == "r1/odom" for one in fixed[-1].transforms)
    assert told.topics["/maniple/r1/odom"] >= len(odometry)
    assert told.told == sum(told.topics.values())


@pytest.mark.parametrize("layout", ["rmw_zenoh", "ros2dds"])
def test_who_comes_late_is_given_what_is_latched(layout: Layout) -> None:
    """What the router of the platoon kept is told at once, and again to who comes later."""
    with router() as (endpoint, _), ZenohSession.client(endpoint, "test") as robots:
        first = [next(words_of(robot, "odometry")) for robot in ("r1", "r2", "r3")]
        for seen in first:
            robots.announce(seen.message.source, 1)

        def kept() -> bool:
            for seen in first:
                say(robots, seen)
            return all(robots.ask(seen.topic) for seen in first)

        eventually(kept, DEADLINE_S)
        with bridge(endpoint, endpoint, layout) as running:
            with RosSession.open(endpoint, "late", network=Network(layout, 7)) as late:
                if layout == "rmw_zenoh":
                    found: list[Any] = []
                    late.subscribe("/tf_static", TF, lambda message, _: found.append(message), LATCHED)
                    eventually(lambda: found and len(found[-1].transforms) == 3, DEADLINE_S)
                else:
                    eventually(lambda: late.entities("MP", "/tf_static"), DEADLINE_S)
            assert running.end().topics["/tf_static"] == 3


def test_what_is_no_message_of_the_platoon_is_counted() -> None:
    with (
        router() as (endpoint, _),
        ZenohSession.client(endpoint, "test") as robots,
        bridge(endpoint, endpoint) as running,
    ):
        good = next(words())

        def arrived() -> bool:
            say(robots, good)
            return running._bridge._heard > 0

        eventually(arrived, DEADLINE_S)
        robots.put("robot/r1/status", b"nonsense")
        robots.put_raw("robot/r1/status", b"other bytes", b"abcd")
        say(robots, next(words_of("r1", "odometry")), source="r2")
        robots.put("robot/r9/odometry", b"of a robot that is none")
        eventually(lambda: running._bridge._refused.total() >= 3, DEADLINE_S)
        told = running.end()
    assert told.refused == {"corrupted": 1, "malformed": 1, "sender": 1}


@pytest.mark.slow
def test_it_says_who_runs_another_scenario_and_when_a_router_is_gone() -> None:
    said: list[str] = []
    ros = f"tcp/127.0.0.1:{free_port()}"
    with router() as (fleet, _), ZenohSession.client(fleet, "test") as robots:
        status = next(words_of("r1", "status"))
        other = ZenohSession.router(ros, "ros")
        with bridge(fleet, ros, said=said) as running:

            def warned() -> bool:
                say(robots, status, scenario="0123456789abcdef")
                return bool(said)

            eventually(warned, DEADLINE_S)
            other.close()
            eventually(lambda: len(said) == 2, DEADLINE_S)
            with ZenohSession.router(ros, "ros"):
                eventually(lambda: len(said) == 3, DEADLINE_S)
                running.end()
    assert "runs another scenario" in said[0]
    assert said[1:] == ["the router of ROS 2 is gone: waiting for it", "the router of ROS 2 is back"]


def test_stamps_are_of_the_wall_clock_whatever_the_speed_of_the_run() -> None:
    with router(clock=Anchor.here(speed=2.0)) as (endpoint, _), bridge(endpoint, endpoint) as running:
        clock = running._bridge._clock
        assert clock.speed == 2.0
        ago = running._bridge._wall(clock.now() - 2 * SECOND)
        assert ago == pytest.approx(time.time_ns() - SECOND, abs=SECOND // 5)
