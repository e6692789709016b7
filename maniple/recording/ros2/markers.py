"""What stands and moves in the 3D view, as `visualization_msgs/MarkerArray`: made of the viewers' scenes, so
that RViz shows what Foxglove does."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import rosbags.typesys.stores.ros2_jazzy as ros
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose as FoxglovePose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from maniple.core.time import Time
from maniple.recording.ros2.basics import header

Marker = ros.visualization_msgs__msg__Marker

_NO_BYTES = np.zeros(0, dtype=np.uint8)
_AT_ORIGIN = FoxglovePose()
_AT_ORIGIN.orientation.w = 1.0


class Scene:
    """The markers of one topic. An entity is a namespace; what it no longer has is deleted."""

    def __init__(self, frame: Callable[[str], str]) -> None:
        self._frame = frame
        self._shown: dict[str, int] = {}

    def markers(self, update: SceneUpdate, time: Time) -> ros.visualization_msgs__msg__MarkerArray:
        """A scene as markers, with `frame` telling what each frame is called here."""
        found: list[Any] = []  # rosbags has several types of that name
        for entity in update.entities:
            frame = self._frame(entity.frame_id)
            made = [*_primitives(entity)]
            for number, marker in enumerate(made):
                marker.header = header(frame, time)
                marker.ns, marker.id = entity.id, number
                marker.frame_locked = entity.frame_locked
                marker.lifetime = ros.builtin_interfaces__msg__Duration(
                    entity.lifetime.seconds, entity.lifetime.nanos
                )
            before = self._shown.get(entity.id, 0)
            self._shown[entity.id] = len(made)
            found += made
            found += (_gone(entity.id, number, frame, time) for number in range(len(made), before))
        return ros.visualization_msgs__msg__MarkerArray(found)


def _primitives(entity: SceneEntity) -> Iterator[Marker]:
    for cube in entity.cubes:
        yield _marker(Marker.CUBE, cube.pose, _xyz(cube.size), cube.color)
    for cylinder in entity.cylinders:
        yield _marker(Marker.CYLINDER, cylinder.pose, _xyz(cylinder.size), cylinder.color)
    for line in entity.lines:
        points = [_point(one) for one in line.points]
        if line.type == LinePrimitive.LINE_LOOP:
            points.append(points[0])
        kind = Marker.LINE_LIST if line.type == LinePrimitive.LINE_LIST else Marker.LINE_STRIP
        yield _marker(kind, line.pose, (line.thickness, 0.0, 0.0), line.color, points)
    for faces in entity.triangles:
        points = [_point(faces.points[index]) for index in faces.indices]
        yield _marker(Marker.TRIANGLE_LIST, faces.pose, (1.0, 1.0, 1.0), faces.color, points)
    for text in entity.texts:
        size = (0.0, 0.0, text.font_size)
        yield _marker(Marker.TEXT_VIEW_FACING, text.pose, size, text.color, text=text.text)


def _gone(name: str, number: int, frame: str, time: Time) -> Marker:
    marker = _marker(Marker.CUBE, _AT_ORIGIN, (0.0, 0.0, 0.0), Color())
    marker.header, marker.ns, marker.id, marker.action = header(frame, time), name, number, Marker.DELETE
    return marker


def _marker(
    kind: int,
    pose: FoxglovePose,
    scale: tuple[float, float, float],
    colour: Color,
    points: Sequence[ros.geometry_msgs__msg__Point] = (),
    text: str = "",
) -> Marker:
    """All but who and where it is."""
    nowhen = ros.builtin_interfaces__msg__Time(0, 0)
    turn = pose.orientation
    return Marker(
        header=ros.std_msgs__msg__Header(nowhen, ""),
        ns="",
        id=0,
        type=kind,
        action=Marker.ADD,
        pose=ros.geometry_msgs__msg__Pose(
            _point(pose.position), ros.geometry_msgs__msg__Quaternion(turn.x, turn.y, turn.z, turn.w)
        ),
        scale=ros.geometry_msgs__msg__Vector3(*scale),
        color=ros.std_msgs__msg__ColorRGBA(colour.r, colour.g, colour.b, colour.a),
        lifetime=ros.builtin_interfaces__msg__Duration(0, 0),
        frame_locked=False,
        points=list(points),
        colors=[],
        texture_resource="",
        texture=ros.sensor_msgs__msg__CompressedImage(ros.std_msgs__msg__Header(nowhen, ""), "", _NO_BYTES),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=ros.visualization_msgs__msg__MeshFile("", _NO_BYTES),
        mesh_use_embedded_materials=False,
    )


def _point(of: Any) -> ros.geometry_msgs__msg__Point:
    return ros.geometry_msgs__msg__Point(of.x, of.y, of.z)


def _xyz(of: Any) -> tuple[float, float, float]:
    return of.x, of.y, of.z
