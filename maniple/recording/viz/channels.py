"""The viewer channels of a scenario: known before the first message, each with a schema."""

from functools import cache
from typing import NamedTuple

import msgspec
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Proto

from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.recording.viz.scalars import FormationScalars, RobotScalars, TriangleScalars, schema_of

TF = "/viz/tf"
ROBOTS = "/viz/robots"
FORMATION = "/viz/formation"
OBSTACLES = "/viz/obstacles"
LOG = "/viz/log"
FORMATION_SCALARS = "/viz/scalars/formation"


class Channel(NamedTuple):
    """One channel of an MCAP file that viewers draw."""

    key: str
    """Its topic in the file."""
    encoding: str
    """Of the messages: "protobuf" or "json"."""
    schema_name: str
    """What viewers choose their drawing by."""
    schema_encoding: str
    schema: bytes


class Drawn(NamedTuple):
    """One message for viewers."""

    key: str
    """Of its channel."""
    data: bytes
    time_ns: Time
    """Log time of the message it comes from."""


def scan_key(robot: str) -> str:
    """Channel of a robot's scans."""
    return f"/viz/scan/{robot}"


def points_key(robot: str) -> str:
    """Channel of a robot's scans as points."""
    return f"/viz/points/{robot}"


def trajectory_key(robot: str) -> str:
    """Channel of where a robot has been."""
    return f"/viz/trajectory/{robot}"


def robot_scalars_key(robot: str) -> str:
    """Channel of a robot's numbers."""
    return f"/viz/scalars/robot/{robot}"


def triangle_scalars_key(number: int) -> str:
    """Channel of the errors of triangle `number` of the chain, from 1."""
    return f"/viz/scalars/triangle/{number}"


def channels_of(scenario: Scenario) -> tuple[Channel, ...]:
    """All channels that a run of a scenario can have."""
    robots = [robot.id for robot in scenario.robots]
    return (
        _protobuf(TF, FrameTransforms),
        _protobuf(ROBOTS, SceneUpdate),
        _protobuf(FORMATION, SceneUpdate),
        _protobuf(OBSTACLES, SceneUpdate),
        _protobuf(LOG, Log),
        *(_protobuf(scan_key(name), LaserScan) for name in robots),
        *(_protobuf(points_key(name), PointCloud) for name in robots),
        *(_protobuf(trajectory_key(name), PosesInFrame) for name in robots),
        _json(FORMATION_SCALARS, FormationScalars),
        *(_json(triangle_scalars_key(number), TriangleScalars) for number in range(1, len(robots) - 1)),
        *(_json(robot_scalars_key(name), RobotScalars) for name in robots),
    )


def _protobuf(key: str, kind: type[Proto]) -> Channel:
    descriptor = kind.DESCRIPTOR
    return Channel(key, "protobuf", descriptor.full_name, "protobuf", _file_set(descriptor.file))


def _json(key: str, kind: type[msgspec.Struct]) -> Channel:
    return Channel(key, "json", f"maniple.{kind.__name__}", "jsonschema", schema_of(kind))


@cache
def _file_set(file: FileDescriptor) -> bytes:
    """A protobuf file with all that it imports, those first."""
    files: dict[str, FileDescriptor] = {}

    def add(one: FileDescriptor) -> None:
        if one.name not in files:
            for imported in one.dependencies:
                add(imported)
            files[one.name] = one

    add(file)
    found = FileDescriptorSet()
    for one in files.values():
        one.CopyToProto(found.file.add())
    return found.SerializeToString(deterministic=True)
