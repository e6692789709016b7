"""ROS 2 sessions over a real router: among themselves, and with an independent implementation of rmw_zenoh's
wire format, message by message in both directions."""

import math
import random
import socket
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh_ros2_sdk
from zenoh_ros2_sdk.attachment import Attachment as TheirAttachment
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.utils import get_type_hash

from maniple.core.errors import ArgumentError, MessageError, TransportError
from maniple.core.geometry import Pose
from maniple.core.messages import Scan, pack_floats
from maniple.transport.ros2 import Network, RosSession
from maniple.transport.ros2_cdr import (
    LASER_SCAN,
    ODOMETRY,
    TF,
    TWIST,
    TWIST_STAMPED,
    encode,
    gid_of,
    type_hash,
)
from maniple.transport.ros2_keys import LATCHED, NO_HASH, Attachment, Qos, data_key
from maniple.transport.ros2_messages import (
    Velocity3,
    laser_scan,
    odometry,
    transforms,
    twist,
    twist_stamped,
    velocity_of,
)
from maniple.transport.zenoh import ZenohSession
from tests.transport.ros2_definitions import DEFINITIONS, whole
from tests.waiting import eventually

DEADLINE_S = 20.0
AT, VELOCITY = Pose(1.0, 2.0, 0.5), Velocity3(0.5, -0.25, 0.125)
# Numbers that float32 has.
SCAN = Scan(
    first_angle_rad=-1.0,
    increment_rad=0.0078125,
    range_min_m=0.125,
    range_max_m=8.0,
    mount=(0.0, 0.0, 0.0),
    ranges=pack_floats(np.linspace(0.0, 8.0, 360)),
)
MESSAGES = {
    TWIST: twist(VELOCITY),
    TWIST_STAMPED: twist_stamped(VELOCITY, 3_000_000_007, "base_link"),
    ODOMETRY: odometry(AT, VELOCITY, 3_000_000_007, "odom", "base_link", (0.1, 0.2, 0.3)),
    LASER_SCAN: laser_scan(SCAN, 3_000_000_007, "laser", 0.125),
    TF: transforms({"base_link": ("odom", AT), "laser": ("base_link", AT)}, 3_000_000_007),
}


class Router(NamedTuple):
    endpoint: str
    port: int


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    """One for all tests: the independent implementation keeps one session a process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    endpoint = f"tcp/127.0.0.1:{port}"
    with ZenohSession.router(endpoint, "test"):
        yield Router(endpoint, port)
        if zenoh_ros2_sdk.ZenohSession._instance is not None:
            zenoh_ros2_sdk.ZenohSession._instance.close()


def said(message: Any) -> Any:
    """A message as plain values, whichever store its class is from."""
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [said(one) for one in message]
    fields = getattr(message, "__dataclass_fields__", None)
    if fields is None:
        return message
    return {name: said(getattr(message, name)) for name in fields if name != "__msgtype__"}


def theirs(message: Any) -> Any:
    """A message with the classes of their store."""
    if isinstance(message, list):
        return [theirs(one) for one in message]
    fields = getattr(message, "__dataclass_fields__", None)
    if fields is None:
        return message
    kind = zenoh_ros2_sdk.ZenohSession._instance.store.types[message.__msgtype__]
    return kind(**{name: theirs(getattr(message, name)) for name in fields if name != "__msgtype__"})


def their_hash(type_name: str) -> str:
    others = {name: text for name, text in DEFINITIONS.items() if name != type_name}
    return str(get_type_hash(type_name, DEFINITIONS[type_name], others))


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_an_independent_implementation_computes_the_same_hashes(type_name: str) -> None:
    assert type_hash(type_name) == their_hash(type_name)


@pytest.mark.parametrize("type_name", MESSAGES)
def test_an_independent_implementation_hears_what_is_published(router: Router, type_name: str) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    topic = f"/there/{type_name.rsplit('/', 1)[1].lower()}"
    with RosSession.open(router.endpoint, "here") as session:
        publisher = session.advertise(topic, type_name)
        listener = zenoh_ros2_sdk.ROS2Subscriber(
            topic,
            type_name,
            heard.put,
            msg_definition=whole(type_name),
            domain_id=0,
            router_port=router.port,
            type_hash=their_hash(type_name),
        )
        eventually(lambda: publisher.subscriptions, DEADLINE_S)
        publisher.publish(MESSAGES[type_name])
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[type_name])
        listener.close()


@pytest.mark.parametrize("type_name", MESSAGES)
def test_what_an_independent_implementation_publishes_is_heard(router: Router, type_name: str) -> None:
    heard: SimpleQueue[tuple[Any, Attachment]] = SimpleQueue()
    topic = f"/back/{type_name.rsplit('/', 1)[1].lower()}"
    with RosSession.open(router.endpoint, "here") as session:
        subscription = session.subscribe(
            topic, type_name, lambda message, origin: heard.put((message, origin))
        )
        session.zenoh.settle()
        speaker = zenoh_ros2_sdk.ROS2Publisher(
            topic,
            type_name,
            msg_definition=whole(type_name),
            domain_id=0,
            router_port=router.port,
            type_hash=their_hash(type_name),
        )
        eventually(lambda: session.entities("MP", topic), DEADLINE_S)
        message = theirs(MESSAGES[type_name])
        fields = [name for name in message.__dataclass_fields__ if name != "__msgtype__"]

        def publish() -> bool:
            speaker.publish(**{name: getattr(message, name) for name in fields})
            return not heard.empty()

        eventually(publish, DEADLINE_S)
        got, origin = heard.get(timeout=DEADLINE_S)
        speaker.close()
    assert said(got) == said(MESSAGES[type_name])
    assert origin.gid == speaker.publisher_gid
    assert subscription.bad == subscription.other == 0


def test_an_independent_implementation_sees_who_publishes_what_and_how(router: Router) -> None:
    with RosSession.open(router.endpoint, "laser_driver", "/r2") as session:
        session.advertise("scan", LASER_SCAN, Qos(reliable=False, depth=5))
        session.advertise("/map", TF, LATCHED)
        session.subscribe("cmd_vel", TWIST, lambda *_: None)
        session.zenoh.settle()
        topics = dict(zenoh_ros2_sdk.get_topic_names_and_types(0, router_port=router.port))
        info = zenoh_ros2_sdk.get_topic_info("/r2/scan", 0, router_port=router.port, verbose=True)
        latched = zenoh_ros2_sdk.get_topic_info("/map", 0, router_port=router.port, verbose=True)
    assert topics["/r2/scan"] == [LASER_SCAN]
    assert topics["/r2/cmd_vel"] == [TWIST]
    assert (info.publisher_count, info.subscriber_count) == (1, 0)
    (publisher,) = info.publishers
    assert (publisher.node_name, publisher.node_namespace) == ("laser_driver", "/r2")
    assert publisher.type_hash == type_hash(LASER_SCAN)
    assert QosProfile.decode(publisher.qos).history_depth == 5
    assert QosProfile.decode(publisher.qos).reliability.name == "BEST_EFFORT"
    assert QosProfile.decode(latched.publishers[0].qos).durability.name == "TRANSIENT_LOCAL"


def test_an_independent_implementation_that_comes_late_gets_what_is_latched(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    with RosSession.open(router.endpoint, "early") as session:
        publisher = session.advertise("/tf_static", TF, LATCHED)
        publisher.publish(transforms({}, 0))
        publisher.publish(MESSAGES[TF])
        session.zenoh.settle()
        listener = zenoh_ros2_sdk.ROS2Subscriber(
            "/tf_static",
            TF,
            heard.put,
            msg_definition=whole(TF),
            domain_id=0,
            router_port=router.port,
            type_hash=their_hash(TF),
            qos=QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1),
        )
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[TF])
        listener.close()


def test_late_comers_here_get_what_is_latched_too(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    with RosSession.open(router.endpoint, "early") as early, RosSession.open(router.endpoint, "late") as late:
        publisher = early.advertise("/latched/tf_static", TF, LATCHED)
        publisher.publish(MESSAGES[TF])
        early.zenoh.settle()
        late.subscribe("/latched/tf_static", TF, lambda message, _: heard.put(message), LATCHED)
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[TF])


def test_the_attachment_is_what_an_independent_implementation_reads(router: Router) -> None:
    seen: SimpleQueue[tuple[str, bytes, bytes | None]] = SimpleQueue()
    with (
        RosSession.open(router.endpoint, "speaker", "/r9", Network(domain_id=7)) as session,
        ZenohSession.client(router.endpoint, "") as ear,
    ):
        ear.subscribe_raw("7/r9/cmd_vel/**", lambda *sample: seen.put(sample))
        ear.settle()
        publisher = session.advertise("cmd_vel", TWIST)
        for _ in range(2):
            publisher.publish(MESSAGES[TWIST])
        (key, data, attachment), (_, _, second) = (seen.get(timeout=DEADLINE_S) for _ in range(2))
        (token,) = {
            reply.ok.key_expr
            for reply in ear._session.liveliness().get("@ros2_lv/7/*/*/*/MP/**")
            if reply.ok is not None
        }
    assert key == f"7/r9/cmd_vel/geometry_msgs::msg::dds_::Twist_/{type_hash(TWIST)}"
    assert data == encode(MESSAGES[TWIST])
    first = TheirAttachment.from_bytes(attachment)
    assert (first.sequence_id, TheirAttachment.from_bytes(second).sequence_id) == (1, 2)
    assert first.gid == gid_of(str(token))


def test_domains_do_not_hear_each_other(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    with (
        RosSession.open(router.endpoint, "one", network=Network(domain_id=1)) as one,
        RosSession.open(router.endpoint, "two", network=Network(domain_id=2)) as two,
        RosSession.open(router.endpoint, "same", network=Network(domain_id=1)) as same,
    ):
        one.subscribe("/apart", TWIST, lambda message, _: heard.put(velocity_of(message)))
        one.zenoh.settle()
        two.advertise("/apart", TWIST).publish(twist(Velocity3(2.0, 0.0, 0.0)))
        same.advertise("/apart", TWIST).publish(twist(Velocity3(1.0, 0.0, 0.0)))
        assert heard.get(timeout=DEADLINE_S).u == 1.0
        assert not two.entities("MS", "/apart")
    assert heard.empty()


def test_through_the_bridge_for_dds_a_topic_is_its_name_and_bare_cdr(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    seen: SimpleQueue[tuple[str, bytes, bytes | None]] = SimpleQueue()
    network = Network("ros2dds")
    with (
        RosSession.open(router.endpoint, "here", network=network) as session,
        ZenohSession.client(router.endpoint, "") as bridge,
    ):
        subscription = session.subscribe("/r5/odom", ODOMETRY, lambda message, _: heard.put(message))
        publisher = session.advertise("/r5/cmd_vel", TWIST)
        bridge.subscribe_raw("r5/cmd_vel", lambda *sample: seen.put(sample))
        bridge.declare_token(f"@/{bridge.zid}/@ros2_lv/MS/r5§cmd_vel/geometry_msgs§msg§Twist/:1:0:0,10")
        for both in (session.zenoh, bridge):
            both.settle()
        bridge.put_raw("r5/odom", encode(MESSAGES[ODOMETRY]))
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[ODOMETRY])
        publisher.publish(MESSAGES[TWIST])
        assert seen.get(timeout=DEADLINE_S) == ("r5/cmd_vel", encode(MESSAGES[TWIST]), None)
        eventually(lambda: publisher.subscriptions, DEADLINE_S)
    assert subscription.bad == 0


def test_the_bridge_for_dds_gets_what_is_latched_when_it_asks(router: Router) -> None:
    with (
        RosSession.open(router.endpoint, "here", network=Network("ros2dds")) as session,
        ZenohSession.client(router.endpoint, "") as bridge,
    ):
        publisher = session.advertise("/r6/tf_static", TF, LATCHED)
        publisher.publish(MESSAGES[TF])
        session.zenoh.settle()
        # As RouteSubscriber of zenoh-plugin-ros2dds does.
        import zenoh

        replies = bridge._session.get(
            "@/*/@ros2_pub_cache/r6/tf_static",
            target=zenoh.QueryTarget.ALL,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
        )
        got = [(str(one.ok.key_expr), one.ok.payload.to_bytes()) for one in replies if one.ok is not None]
    assert got == [("r6/tf_static", encode(MESSAGES[TF]))]


def test_robots_that_know_no_type_hashes_hear_and_are_heard(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    seen: SimpleQueue[tuple[str, bytes, bytes | None]] = SimpleQueue()
    attachment = Attachment(1, 2, bytes(16)).pack()
    with (
        RosSession.open(router.endpoint, "here") as session,
        ZenohSession.client(router.endpoint, "") as humble,
    ):
        session.subscribe("/humble/odom", ODOMETRY, lambda message, _: heard.put(message))
        publisher = session.advertise("/humble/cmd_vel", TWIST)
        key = data_key("rmw_zenoh", 0, "/humble/cmd_vel", TWIST, NO_HASH)
        humble.subscribe_raw(key, lambda *sample: seen.put(sample))
        end = humble.declare_token(
            f"@ros2_lv/0/{humble.zid}/0/1/MS/%/%/base/%humble%cmd_vel/geometry_msgs::msg::dds_::Twist_/{NO_HASH}"
            "/1:2:1,10:,:,:,,"
        )
        for both in (session.zenoh, humble):
            both.settle()
        odometry_key = data_key("rmw_zenoh", 0, "/humble/odom", ODOMETRY, NO_HASH)
        humble.put_raw(odometry_key, encode(MESSAGES[ODOMETRY]), attachment)
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[ODOMETRY])
        eventually(lambda: session.is_unhashed("/humble/cmd_vel"), DEADLINE_S)
        publisher.publish(MESSAGES[TWIST])
        assert seen.get(timeout=DEADLINE_S)[:2] == (key, encode(MESSAGES[TWIST]))
        end()
        eventually(lambda: not session.is_unhashed("/humble/cmd_vel"), DEADLINE_S)


def test_what_is_no_message_is_counted_and_passed_on_to_nobody(router: Router) -> None:
    heard: SimpleQueue[Any] = SimpleQueue()
    chance = random.Random(7)
    good, attachment = encode(MESSAGES[ODOMETRY]), Attachment(1, 2, bytes(16)).pack()
    key = data_key("rmw_zenoh", 0, "/bad/odom", ODOMETRY, type_hash(ODOMETRY))
    with (
        RosSession.open(router.endpoint, "here") as session,
        ZenohSession.client(router.endpoint, "") as stranger,
    ):
        subscription = session.subscribe("/bad/odom", ODOMETRY, lambda message, _: heard.put(message))
        session.zenoh.settle()
        for tail in (None, b"", attachment[:-1], attachment + b"x", b"\xff" * 33):
            stranger.put_raw(key, good, tail)
        for _ in range(200):
            stranger.put_raw(key, good[: chance.randrange(len(good) - 4)], attachment)
        stranger.put_raw(key.rsplit("/", 1)[0] + "/RIHS01_another", good, attachment)
        stranger.put_raw(key, good, attachment)
        assert said(heard.get(timeout=DEADLINE_S)) == said(MESSAGES[ODOMETRY])
    assert (subscription.received, subscription.bad, subscription.other) == (1, 205, 1)
    assert heard.empty()


def test_forged_tokens_are_no_entities(router: Router) -> None:
    with (
        RosSession.open(router.endpoint, "here") as session,
        ZenohSession.client(router.endpoint, "") as stranger,
    ):
        for number, token in enumerate(("@ros2_lv/0/x/0/0/XX/%/%/n", "@ros2_lv/0/x", "@ros2_lv/0/%/%/%/MP")):
            stranger.declare_token(f"{token}/{number}")
        stranger.declare_token(f"@ros2_lv/0/{stranger.zid}/0/0/NN/%/%forged/end")
        eventually(lambda: [node for node in session.entities("NN") if node.node == "end"], DEADLINE_S)
        assert not [one for one in session.entities("MP") if one.node == "n"]


def test_what_goes_is_seen_to_go_and_one_does_not_see_oneself(router: Router) -> None:
    with RosSession.open(router.endpoint, "stays") as stays:
        with RosSession.open(router.endpoint, "goes") as goes:
            goes.advertise("/goes", TWIST)
            eventually(lambda: stays.entities("MP", "/goes"), DEADLINE_S)
            assert [node.node for node in goes.entities("NN") if node.node == "goes"] == []
        eventually(lambda: not stays.entities("MP", "/goes"), DEADLINE_S)


def test_who_only_looks_on_is_not_seen(router: Router) -> None:
    with RosSession.open(router.endpoint, "looks") as looks, RosSession.open(router.endpoint, "sees") as sees:
        looks.subscribe("/looked", TWIST, lambda *_: None, announced=False)
        looks.subscribe("/heard", TWIST, lambda *_: None)
        eventually(lambda: sees.entities("MS", "/heard"), DEADLINE_S)
        assert not sees.entities("MS", "/looked")


def test_mistakes_are_one_clear_message(router: Router) -> None:
    with RosSession.open(router.endpoint, "here") as session:
        publisher = session.advertise("/typed", TWIST)
        with pytest.raises(MessageError, match=r"/typed takes geometry_msgs/msg/Twist, not nav_msgs"):
            publisher.publish(MESSAGES[ODOMETRY])
        with pytest.raises(MessageError, match="is no message type of ROS 2"):
            session.advertise("/typed", "my_msgs/msg/Robot")
        with pytest.raises(ArgumentError, match="is no ROS 2 name"):
            session.subscribe("a topic", TWIST, lambda *_: None)
    with pytest.raises(ArgumentError, match="is no ROS 2 name"):
        RosSession.open(router.endpoint, "a node")
    with pytest.raises(TransportError, match="can't reach a router"):
        RosSession.open("tcp/127.0.0.1:1", "here", timeout_s=0.2)


def test_infinite_ranges_arrive_as_they_were_sent() -> None:
    ranges = MESSAGES[LASER_SCAN].ranges
    assert ranges[0] == -math.inf
    assert ranges[-1] == math.inf
