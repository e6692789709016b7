"""Foxglove's small types."""

import math
from collections.abc import Sequence

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose as FoxglovePose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message as Proto
from google.protobuf.timestamp_pb2 import Timestamp

from maniple.core.palette import COLOURS, rgb
from maniple.core.time import SECOND, Time

WORLD = "world"


def true_frame(robot: str) -> str:
    """The frame of a robot as it really is; its name alone is the one it is believed to have."""
    return f"{robot}/true"


def sensor_frame(robot: str) -> str:
    """The frame of a robot's range finder."""
    return f"{robot}/sensor"


def timestamp(time: Time) -> Timestamp:
    """A moment."""
    seconds, nanos = divmod(time, SECOND)
    return Timestamp(seconds=seconds, nanos=nanos)


def quaternion(psi: float) -> Quaternion:
    """A turn about z, rad."""
    return Quaternion(z=math.sin(0.5 * psi), w=math.cos(0.5 * psi))


def pose(x: float, y: float, z: float = 0.0, psi: float = 0.0) -> FoxglovePose:
    """A pose in the plane, or `z` (m) above it."""
    return FoxglovePose(position=Vector3(x=x, y=y, z=z), orientation=quaternion(psi))


def point(xy: Sequence[float], z: float = 0.0) -> Point3:
    """A point in the plane, or `z` (m) above it."""
    return Point3(x=xy[0], y=xy[1], z=z)


def colour(name: str, alpha: float = 1.0) -> Color:
    """A colour "#RRGGBB" and how solid it is."""
    red, green, blue = rgb(name)
    return Color(r=red, g=green, b=blue, a=alpha)


def colour_of(index: int) -> str:
    """The colour of the robot `index`."""
    return COLOURS[index % len(COLOURS)]


def wire(message: Proto) -> bytes:
    """The bytes of a message: the same for the same."""
    return message.SerializeToString(deterministic=True)
