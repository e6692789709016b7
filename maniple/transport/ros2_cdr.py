"""ROS 2 messages as bytes: CDR, and the hashes of their types, by rosbags, which is loaded at first use; and
the identities of publishers, by xxhash.

A message is an object of the class that rosbags has for its type, with the fields of its definition.
"""

import struct
from functools import cache
from typing import Any

from maniple.core.errors import MessageError, MissingExtraError

TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
TF = "tf2_msgs/msg/TFMessage"


def require() -> None:
    """Load what is needed.

    Raises:
        MissingExtraError: it is not installed.
    """
    _typestore()
    gid_of("")


def new(type_name: str, **fields: Any) -> Any:
    """A message of a type of ROS 2 Jazzy, as "geometry_msgs/msg/Twist"; every field has to be given.

    Raises:
        MessageError: ROS 2 has no such type.
    """
    kind = _typestore().types.get(type_name)
    if kind is None:
        raise MessageError(f"{type_name!r} is no message type of ROS 2 Jazzy, as geometry_msgs/msg/Twist is")
    return kind(**fields)


@cache
def type_hash(type_name: str) -> str:
    """The hash of a type as rmw_zenoh has it in keys: RIHS01_ and 64 digits (REP 2016).

    Raises:
        MessageError: ROS 2 has no such type.
    """
    store = _typestore()
    if type_name not in store.types:
        raise MessageError(f"{type_name!r} is no message type of ROS 2 Jazzy, as geometry_msgs/msg/Twist is")
    return str(store.hash_rihs01(type_name))


def encode(message: Any) -> bytes:
    """CDR, little-endian, with the four bytes of its header."""
    return bytes(_typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def decode(data: bytes, type_name: str) -> Any:
    """The message in some CDR of either byte order. Lengths that the bytes do not hold are not believed.

    Raises:
        MessageError: the bytes are no such message.
    """
    from rosbags.serde import SerdeError

    try:
        return _typestore().deserialize_cdr(data, type_name)
    except (SerdeError, struct.error, ValueError, IndexError) as error:
        raise MessageError(f"no {type_name}: {error}") from None


def gid_of(token: str) -> bytes:
    """The identity that rmw_zenoh gives to who has declared a liveliness token, 16 bytes: XXH3 of the token,
    the low half first."""
    try:
        from xxhash import xxh3_128_digest
    except ImportError:
        raise MissingExtraError("ROS 2 (xxhash)", "ros2") from None
    return xxh3_128_digest(token.encode())[::-1]


@cache
def _typestore() -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("ROS 2 (rosbags)", "ros2") from None
    return get_typestore(Stores.ROS2_JAZZY)
