"""How ROS 2 names things on Zenoh: pure functions of names, of both layouts that are in use.

- "rmw_zenoh": the ROS 2 middleware on Zenoh. Keys with domain, type and type hash, an attachment of 33
  bytes, liveliness tokens under `@ros2_lv` (github.com/ros2/rmw_zenoh, docs/design.md; Jazzy to Rolling).
- "ros2dds": zenoh-bridge-ros2dds in front of robots that speak DDS. The topic without its leading slash is
  the key, tokens lie under `@/ID/@ros2_lv` (github.com/eclipse-zenoh/zenoh-plugin-ros2dds,
  liveliness_mgt.rs).
"""

import re
import struct
from collections.abc import Mapping
from typing import Literal, NamedTuple, TypeAlias

from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.types import Robot

Layout: TypeAlias = Literal["rmw_zenoh", "ros2dds"]

EntityKind: TypeAlias = Literal["NN", "MP", "MS", "SS", "SC"]
"""Node, publisher, subscription, service server, service client."""

NO_HASH = "TypeHashNotSupported"
"""What distributions before Iron (Humble) have in the place of the type hash."""

ATTACHMENT_BYTES = 33
GID_BYTES = 16

_ATTACHMENT = struct.Struct("<qqB16s")
_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_KINDS: Mapping[str, EntityKind] = {"NN": "NN", "MP": "MP", "MS": "MS", "SS": "SS", "SC": "SC"}
_DEFAULT_DEPTH = 42
"""Of rmw_zenoh's QoS; left out of tokens."""


class Qos(NamedTuple):
    """Quality of service, as far as Zenoh knows any."""

    reliable: bool = True
    latched: bool = False
    """Transient local: who comes late gets the last `depth` messages."""
    depth: int = 10
    """Keep last so many; 0 to keep all."""


SENSOR_DATA = Qos(reliable=False, depth=5)
"""rclcpp's SensorDataQoS."""

LATCHED = Qos(latched=True, depth=1)
"""As for maps, robot descriptions and static transforms."""


class Entity(NamedTuple):
    """What a liveliness token says is there."""

    kind: EntityKind
    node: str
    """Its name; empty where the layout does not say."""
    namespace: str
    """Of the node, as "/r2"; "/" for none."""
    topic: str
    """Absolute; empty for a node."""
    type: str
    """As "nav_msgs/msg/Odometry"; empty for a node."""
    hash: str
    """Of the type; empty where the layout does not say."""
    qos: Qos | None
    zid: str
    """The Zenoh session it belongs to."""


class Attachment(NamedTuple):
    """What rmw_zenoh sends with every message."""

    sequence: int
    """From 1 for each publisher."""
    stamp_ns: int
    """When it was published, by the publisher's clock."""
    gid: bytes
    """The publisher: 16 bytes."""

    def pack(self) -> bytes:
        """As it is on the wire: 33 bytes, little-endian."""
        return _ATTACHMENT.pack(self.sequence, self.stamp_ns, GID_BYTES, self.gid)


def attachment_of(data: bytes | None) -> Attachment | None:
    """The inverse of `Attachment.pack`; None for what is none."""
    if data is None or len(data) != ATTACHMENT_BYTES:
        return None
    sequence, stamp_ns, length, gid = _ATTACHMENT.unpack(data)
    return Attachment(sequence, stamp_ns, gid) if length == GID_BYTES else None


class RobotNames(NamedTuple):
    """Full names of a robot's topics."""

    namespace: str
    cmd_vel: str
    odom: str
    scan: str


def names_of(robot: Robot) -> RobotNames:
    """The topics of a robot of a scenario.

    Raises:
        ScenarioError: they have names that ROS 2 does not know.
    """
    ros2, field = robot.ros2, ""
    names = {"namespace": f"/{(ros2.namespace or robot.id).lstrip('/')}"}
    names |= {name: getattr(ros2, name) for name in ("cmd_vel", "odom", "scan")}
    try:
        for field, name in names.items():
            names[field] = absolute(name, names["namespace"])
    except ArgumentError as error:
        default = "" if field != "namespace" or ros2.namespace else ", by default the robot's id"
        raise ScenarioError(f"robots: {robot.id}: ros2.{field}{default}: {error}") from None
    return RobotNames(**names)


def absolute(name: str, namespace: str = "/") -> str:
    """The full name of a topic or namespace: `name` under `namespace`, unless it begins with a slash.

    Raises:
        ArgumentError: not a ROS 2 name.
    """
    joined = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if name == "/" or (_NAME.fullmatch(joined) and "__" not in joined):
        return joined
    raise ArgumentError(
        f"{name!r} is no ROS 2 name: letters, digits and single underscores, none begins with a digit, "
        "with a slash between its parts"
    )


def mangled_type(type_name: str) -> str:
    """A type as DDS has it: "geometry_msgs/msg/Twist" is "geometry_msgs::msg::dds_::Twist_"."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def demangled_type(mangled: str) -> str:
    """The inverse of `mangled_type`; empty for what is none."""
    parts = mangled.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return ""
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def data_key(layout: Layout, domain_id: int, topic: str, type_name: str, type_hash: str) -> str:
    """The key that the messages of a topic (absolute) are put on; with `*` for the hash, of all hashes."""
    if layout == "ros2dds":
        return topic.lstrip("/")
    return f"{domain_id}{topic}/{mangled_type(type_name)}/{type_hash}"


def hash_in(key: str) -> str:
    """The type hash in a data key of rmw_zenoh."""
    return key.rsplit("/", 1)[-1]


def node_token(domain_id: int, zid: str, node: str, namespace: str, enclave: str = "/") -> str:
    """The liveliness token of a node, the first of its session, in rmw_zenoh."""
    return "/".join(
        (
            f"@ros2_lv/{domain_id}/{zid}/0/0/NN",
            _percent(enclave),
            _percent(namespace),
            _percent(node),
        )
    )


def endpoint_token(layout: Layout, domain_id: int, number: int, entity: Entity, enclave: str = "/") -> str:
    """The liveliness token of a publisher or subscription of that node, the `number`-th of its session."""
    qos = entity.qos or Qos()
    if layout == "ros2dds":
        topic, kind = entity.topic.lstrip("/").replace("/", "§"), entity.type.replace("/", "§")
        return f"@/{entity.zid}/@ros2_lv/{entity.kind}/{topic}/{kind}/{_dds_qos(qos)}"
    return "/".join(
        (
            f"@ros2_lv/{domain_id}/{entity.zid}/0/{number}/{entity.kind}",
            _percent(enclave),
            _percent(entity.namespace),
            _percent(entity.node),
            _percent(entity.topic),
            mangled_type(entity.type),
            entity.hash,
            _rmw_qos(qos),
        )
    )


def bridge_token(zid: str) -> str:
    """The liveliness token of a participant in the layout "ros2dds" itself; others listen to it first."""
    return f"@/{zid}/@ros2_lv"


def all_tokens(layout: Layout, domain_id: int) -> str:
    """The expression of all liveliness tokens."""
    return "@/*/@ros2_lv/**" if layout == "ros2dds" else f"@ros2_lv/{domain_id}/**"


def entity_of(layout: Layout, token: str) -> Entity | None:
    """What a liveliness token says; None for what is none, or of a kind that is of no interest here."""
    return _entity_of_dds(token) if layout == "ros2dds" else _entity_of_rmw(token)


def cache_key(zid: str, key: str) -> str:
    """Where the layout "ros2dds" asks a session for the last messages of a latched topic."""
    return f"@/{zid}/@ros2_pub_cache/{key}"


def _entity_of_rmw(token: str) -> Entity | None:
    parts = token.split("/")
    if len(parts) < 9 or parts[0] != "@ros2_lv":
        return None
    zid, kind, namespace, node = parts[2], _KINDS.get(parts[5]), _slashes(parts[7]), _slashes(parts[8])
    if kind == "NN":
        return Entity("NN", node, namespace, "", "", "", None, zid)
    if kind is None or len(parts) < 13:
        return None
    topic, type_name = _slashes(parts[9]), demangled_type(parts[10])
    return Entity(kind, node, namespace, topic, type_name, parts[11], _qos_of_rmw(parts[12]), zid)


def _entity_of_dds(token: str) -> Entity | None:
    parts = token.split("/")
    if len(parts) < 6 or parts[0] != "@" or parts[2] != "@ros2_lv":
        return None
    zid, kind = parts[1], _KINDS.get(parts[3])
    if kind is None or kind == "NN":
        return None
    topic, type_name = "/" + parts[4].replace("§", "/"), parts[5].replace("§", "/")
    qos = _qos_of_dds(parts[6]) if len(parts) > 6 else None
    return Entity(kind, "", "/", topic, type_name, "", qos, zid)


def _percent(name: str) -> str:
    return name.replace("/", "%")


def _slashes(name: str) -> str:
    return name.replace("%", "/")


def _rmw_qos(qos: Qos) -> str:
    """Reliability, durability, history and depth, deadline, lifespan, liveliness and lease: numbers of the
    enumerations of rmw/types.h, empty where they are rmw_zenoh's defaults."""
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.latched else ""
    history = "" if qos.depth else "2"
    depth = "" if qos.depth in (0, _DEFAULT_DEPTH) else str(qos.depth)
    return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


def _qos_of_rmw(text: str) -> Qos | None:
    parts = text.split(":")
    if len(parts) < 3 or parts[2].count(",") != 1:
        return None
    history, depth = parts[2].split(",")
    keep = 0 if history == "2" else _number(depth, _DEFAULT_DEPTH)
    return None if keep is None else Qos(parts[0] != "2", parts[1] == "1", keep)


def _dds_qos(qos: Qos) -> str:
    """Keyless, reliability, durability, history and depth: numbers of the enumerations of CycloneDDS."""
    return f":{int(qos.reliable)}:{int(qos.latched)}:{int(not qos.depth)},{qos.depth or -1}"


def _qos_of_dds(text: str) -> Qos | None:
    parts = text.split(":")
    if len(parts) < 4:
        return None
    kind, _, depth = parts[3].partition(",")
    keep = 0 if kind == "1" else _number(depth, 1)
    # DDS's own default is reliable for writers and best effort for readers.
    return None if keep is None else Qos(parts[1] != "0", parts[2] == "1", keep)


def _number(text: str, default: int) -> int | None:
    """A count; the default where there is none, None for what is no number."""
    if not text:
        return default
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
