"""Keys, tokens and attachments against what others have published of the wire formats."""

import pytest

from maniple.core.errors import ArgumentError
from maniple.transport.ros2_keys import (
    LATCHED,
    SENSOR_DATA,
    Attachment,
    Entity,
    EntityKind,
    Layout,
    Qos,
    absolute,
    all_tokens,
    attachment_of,
    bridge_token,
    cache_key,
    data_key,
    demangled_type,
    endpoint_token,
    entity_of,
    mangled_type,
    node_token,
)

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"

# The examples of github.com/ros2/rmw_zenoh, docs/design.md ("Graph Cache" and "Topic and Service name
# mapping to Zenoh key expressions").
LISTENER = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
HEARS = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
)
TALKS = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
)
TALKER_ZID = "8b20917502ee955ac4476e0266340d5c"


def chatter(kind: EntityKind, node: str, zid: str, qos: Qos) -> Entity:
    return Entity(kind, node, "/", "/chatter", STRING, STRING_HASH, qos, zid)


def test_tokens_are_those_of_the_design_document() -> None:
    zid = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert node_token(2, zid, "listener", "/") == LISTENER
    assert endpoint_token("rmw_zenoh", 2, 10, chatter("MS", "listener", zid, Qos(depth=10))) == HEARS
    assert endpoint_token("rmw_zenoh", 2, 10, chatter("MP", "talker", TALKER_ZID, Qos(depth=7))) == TALKS


def test_tokens_of_the_design_document_are_understood() -> None:
    assert entity_of("rmw_zenoh", TALKS) == chatter("MP", "talker", TALKER_ZID, Qos(depth=7))
    node = entity_of("rmw_zenoh", LISTENER)
    assert node is not None
    assert (node.kind, node.node, node.namespace) == ("NN", "listener", "/")


def test_keys_are_those_of_the_design_document() -> None:
    mangled = f"std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert data_key("rmw_zenoh", 0, "/chatter", STRING, STRING_HASH) == f"0/chatter/{mangled}"
    assert data_key("rmw_zenoh", 0, "/robot1/chatter", STRING, STRING_HASH) == f"0/robot1/chatter/{mangled}"
    assert all_tokens("rmw_zenoh", 2) == "@ros2_lv/2/**"


def test_a_humble_token_as_a_real_node_declared_it() -> None:
    # As a program printed it that runs beside ROS 2 Humble: its type hash, and every default written out.
    token = (
        "@ros2_lv/0/c40c0137f1e48f6cfee1f90b51ffd9aa/0/5/MP/%/%/mrm_handler/%system%fail_safe%mrm_state/"
        "std_msgs::msg::dds_::Int32_/TypeHashNotSupported/1:2:1,10:,:,:,,"
    )
    entity = entity_of("rmw_zenoh", token)
    assert entity is not None
    assert (entity.topic, entity.type) == ("/system/fail_safe/mrm_state", "std_msgs/msg/Int32")
    assert (entity.hash, entity.qos) == ("TypeHashNotSupported", Qos(depth=10))


@pytest.mark.parametrize("layout", ["rmw_zenoh", "ros2dds"])
@pytest.mark.parametrize("qos", [Qos(), SENSOR_DATA, LATCHED, Qos(depth=42), Qos(depth=0), Qos(depth=100)])
def test_what_a_token_says_is_what_was_declared(layout: Layout, qos: Qos) -> None:
    entity = Entity("MP", "driver", "/a/b", "/a/b/odom", "nav_msgs/msg/Odometry", "RIHS01_0", qos, "abc123")
    said = entity_of(layout, endpoint_token(layout, 0, 3, entity))
    untold = entity._replace(node="", namespace="/", hash="") if layout == "ros2dds" else entity
    assert said == untold


def test_the_tokens_of_the_bridge_for_dds() -> None:
    # liveliness_mgt.rs of github.com/eclipse-zenoh/zenoh-plugin-ros2dds: `ke_liveliness_pub`,
    # `ke_liveliness_plugin` and `qos_to_key_expr`, with CycloneDDS's RELIABLE = 1, TRANSIENT_LOCAL = 1,
    # KEEP_LAST = 0; routes_mgr.rs for the cache.
    entity = Entity("MS", "", "/", "/r2/map", "nav_msgs/msg/OccupancyGrid", "", Qos(True, True, 3), "abc")
    token = "@/abc/@ros2_lv/MS/r2§map/nav_msgs§msg§OccupancyGrid/:1:1:0,3"
    assert endpoint_token("ros2dds", 7, 1, entity) == token
    assert entity_of("ros2dds", token) == entity
    assert entity_of("ros2dds", token + ":typehash=RIHS01_ab;") == entity  # user data, since Iron
    assert bridge_token("abc") == "@/abc/@ros2_lv"
    assert data_key("ros2dds", 7, "/r2/map", "nav_msgs/msg/OccupancyGrid", "*") == "r2/map"
    assert cache_key("abc", "r2/map") == "@/abc/@ros2_pub_cache/r2/map"


@pytest.mark.parametrize(
    "token",
    [
        "",
        "/",
        "@ros2_lv",
        "@ros2_lv/0/abc/0/0/NN",
        "@ros2_lv/0/abc/0/0/XX/%/%/n",
        "@ros2_lv/0/abc/0/1/MP/%/%/n/%t",
        "@/abc/@ros2_lv",
        "@/abc/@ros2_lv/MP/x",
        "@/abc/@ros2_lv/NN/x/y/z",
        "robot/r1/odometry",
    ],
)
def test_what_is_no_token_says_nothing(token: str) -> None:
    assert entity_of("rmw_zenoh", token) is None
    assert entity_of("ros2dds", token) is None


@pytest.mark.parametrize("qos", ["", ":", "::", "::,x:,:,:,,", "::,99999999999:", "::,,,:", "::,-1:"])
def test_a_quality_of_service_that_is_none_hides_no_publisher(qos: str) -> None:
    entity = entity_of("rmw_zenoh", TALKS.rsplit("/", 1)[0] + "/" + qos)
    assert entity is None or (entity.topic == "/chatter" and entity.qos is None)


def test_types_are_mangled_as_dds_does() -> None:
    assert mangled_type("geometry_msgs/msg/Twist") == "geometry_msgs::msg::dds_::Twist_"
    assert demangled_type("geometry_msgs::msg::dds_::Twist_") == "geometry_msgs/msg/Twist"
    assert demangled_type("geometry_msgs::msg::Twist") == demangled_type("x") == ""


def test_an_attachment_is_33_bytes_little_endian_with_the_length_before_the_identity() -> None:
    # attachment_helpers.cpp of github.com/ros2/rmw_zenoh: int64, int64, and an array of 16 bytes, which
    # Zenoh's serializer precedes with its length.
    gid = bytes(range(16))
    packed = Attachment(1, 2, gid).pack()
    assert packed == b"\x01" + bytes(7) + b"\x02" + bytes(7) + b"\x10" + gid
    assert attachment_of(packed) == (1, 2, gid)


@pytest.mark.parametrize("data", [None, b"", bytes(32), bytes(33), bytes(34)])
def test_what_is_no_attachment_is_none(data: bytes | None) -> None:
    assert attachment_of(data) is None


@pytest.mark.parametrize(
    ("name", "namespace", "full"),
    [
        ("odom", "/", "/odom"),
        ("odom", "/r2", "/r2/odom"),
        ("/odom", "/r2", "/odom"),
        ("base/odom", "/fleet/r2", "/fleet/r2/base/odom"),
        ("/", "/r2", "/"),
    ],
)
def test_names_are_resolved_under_their_namespace(name: str, namespace: str, full: str) -> None:
    assert absolute(name, namespace) == full


@pytest.mark.parametrize(
    "name", ["", "1r", "a-b", "a b", "a//b", "a/", "**", "/a/*", "a$", "a__b", "ä", "a%b"]
)
def test_what_ros_2_would_not_take_for_a_name_is_refused(name: str) -> None:
    with pytest.raises(ArgumentError, match="is no ROS 2 name"):
        absolute(name)
