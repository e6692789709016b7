"""What stands and moves in the 3D view, as `foxglove.SceneUpdate`."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration as ProtoDuration

from maniple.core.geometry import Pose
from maniple.core.palette import COLOURS, RED, STONE, YELLOW
from maniple.core.scenario import outline
from maniple.core.scenario.types import Box, Circle, Obstacle, Point, Polygon, RobotModel, Scenario, Wall
from maniple.core.time import SECOND, Duration, Time
from maniple.recording.viz.basics import (
    WORLD,
    colour,
    colour_of,
    point,
    pose,
    timestamp,
    true_frame,
    wire,
)

BODY_M, OBSTACLE_M, WALL_M = 0.2, 0.4, 0.02
"""Height of robots and of obstacles, and how thick a wall is drawn."""

LINE_M = 0.025

_HELD = ("age", "clearance", "blind", "fence")
"""What the guard does that its robot would not."""

_STANDS = ("emergency", "fault")

_BLUE, _GREEN = COLOURS[0], COLOURS[2]

_AT_ORIGIN = pose(0.0, 0.0)


class Bearing(NamedTuple):
    """What shows of a robot's state."""

    mode: str = ""
    guard: str = "none"
    state: str = "present"
    """What the controller takes it for."""

    @property
    def words(self) -> str:
        """What is not as usual; empty where all is."""
        told = [] if self.state in ("present", "absent") else [self.state]
        told += [] if self.mode in ("", "tracking") else [self.mode]
        told += [self.guard] if self.guard in _HELD else []
        return ", ".join(told)

    @property
    def halo(self) -> str:
        """The colour of the ring around it; empty for none."""
        if self.mode in _STANDS or self.state == "lost":
            return RED
        return YELLOW if self.guard in _HELD or self.mode == "holding" else ""


def robots(scenario: Scenario, bearings: Mapping[str, Bearing], ghosts: Sequence[str], time: Time) -> bytes:
    """The robots whose bearings are given, in their frames, with which they move; and the outlines of
    `ghosts` where they really are."""
    entities = []
    for index, robot in enumerate(scenario.robots):
        model = scenario.model_of(robot)
        if robot.id in bearings:
            entities.append(
                _robot(robot.id, model, robot.control_point_m, bearings[robot.id], colour_of(index), time)
            )
        if robot.id in ghosts:
            entities.append(_ghost(robot.id, model, time))
    return wire(SceneUpdate(entities=entities))


def obstacles(things: Sequence[Obstacle], fence: Sequence[Point], time: Time) -> bytes:
    """The obstacles of a scenario, and the fence that its guards keep the robots inside; they stay."""
    entity = SceneEntity(timestamp=timestamp(time), frame_id=WORLD, id="obstacles")
    for thing in things:
        _add_obstacle(entity, thing)
    if fence:
        entity.lines.append(_line(fence, 0.02, LinePrimitive.LINE_LOOP, colour(RED)))
    return wire(SceneUpdate(entities=[entity]))


def formation(desired: Sequence[Point], actual: Sequence[Point], lifetime_ns: Duration, time: Time) -> bytes:
    """The triangles over the control points of a chain, as they are to be and as they are believed to be, m
    in the world; either may be empty. They vanish after `lifetime_ns` without the next."""
    edges = LinePrimitive.LINE_LIST
    stamp, lifetime = (
        timestamp(time),
        ProtoDuration(seconds=lifetime_ns // SECOND, nanos=lifetime_ns % SECOND),
    )
    entities = []
    if desired:
        fill = TriangleListPrimitive(
            pose=_AT_ORIGIN,
            points=[point(one) for one in desired],
            indices=[index for j in range(len(desired) - 2) for index in (j, j + 1, j + 2)],
            color=colour(_GREEN, 0.18),
        )
        line = _line(_chain_edges(desired), 0.01, edges, colour(_GREEN, 0.8))
        entities.append(
            SceneEntity(
                timestamp=stamp,
                frame_id=WORLD,
                id="desired",
                lifetime=lifetime,
                triangles=[fill],
                lines=[line],
            )
        )
    if actual:
        line = _line(_chain_edges(actual), 0.02, edges, colour(_BLUE))
        entities.append(
            SceneEntity(timestamp=stamp, frame_id=WORLD, id="actual", lifetime=lifetime, lines=[line])
        )
    return wire(SceneUpdate(entities=entities))


def _robot(
    name: str, model: RobotModel, control_point_m: float, bearing: Bearing, paint: str, time: Time
) -> SceneEntity:
    """Its body, a line to its control point, its name, and a ring while something is wrong."""
    solid = 0.35 if bearing.state == "lost" else 0.85
    top = BODY_M + 0.005
    body = CubePrimitive(
        pose=pose(model.body_offset_m, 0.0, 0.5 * BODY_M),
        size=Vector3(x=model.length_m, y=model.width_m, z=BODY_M),
        color=colour(paint, solid),
    )
    ahead = _line([(0.0, 0.0), (control_point_m, 0.0)], top, LinePrimitive.LINE_STRIP, colour("#FFFFFF"))
    halo = bearing.halo
    lines = [ahead]
    if halo:
        ring = _ring(model.body_offset_m, outline.radius(model, model.body_offset_m) + 0.1)
        lines.append(_line(ring, 0.01, LinePrimitive.LINE_LOOP, colour(halo)))
    words = bearing.words
    label = TextPrimitive(
        pose=pose(0.0, 0.0, BODY_M + 0.25),
        billboard=True,
        font_size=0.3,
        color=colour(halo or paint),
        text=f"{name}: {words}" if words else name,
    )
    return SceneEntity(
        timestamp=timestamp(time),
        frame_id=name,
        id=name,
        frame_locked=True,
        cubes=[body],
        lines=lines,
        texts=[label],
    )


def _ghost(name: str, model: RobotModel, time: Time) -> SceneEntity:
    corners = outline.body((0.0, 0.0, 0.0), model)
    loop = _line(corners, 0.5 * BODY_M, LinePrimitive.LINE_LOOP, colour(STONE))
    frame = true_frame(name)
    return SceneEntity(timestamp=timestamp(time), frame_id=frame, id=frame, frame_locked=True, lines=[loop])


def _add_obstacle(entity: SceneEntity, thing: Obstacle) -> None:
    paint, half = colour(STONE), 0.5 * OBSTACLE_M
    match thing:
        case Circle(centre=(x, y), radius_m=r):
            size = Vector3(x=2 * r, y=2 * r, z=OBSTACLE_M)
            entity.cylinders.append(
                CylinderPrimitive(pose=pose(x, y, half), size=size, bottom_scale=1, top_scale=1, color=paint)
            )
        case Box(centre=(x, y), size=(length, width), angle_rad=angle):
            size = Vector3(x=length, y=width, z=OBSTACLE_M)
            entity.cubes.append(CubePrimitive(pose=pose(x, y, half, angle), size=size, color=paint))
        case Wall(start=(x1, y1), end=(x2, y2)):
            size = Vector3(x=math.hypot(x2 - x1, y2 - y1), y=WALL_M, z=OBSTACLE_M)
            middle = pose(0.5 * (x1 + x2), 0.5 * (y1 + y2), half, math.atan2(y2 - y1, x2 - x1))
            entity.cubes.append(CubePrimitive(pose=middle, size=size, color=paint))
        case Polygon(points=points):
            entity.triangles.append(_prism(points))


def _prism(corners: Sequence[Point]) -> TriangleListPrimitive:
    """A polygon with sides: corners at the top, then the same on the ground."""
    n = len(corners)
    indices = [index for triangle in outline.triangulated(corners) for index in triangle]
    for here in range(n):
        there = (here + 1) % n
        indices += (here, here + n, there, there, here + n, there + n)
    return TriangleListPrimitive(
        pose=_AT_ORIGIN,
        points=[*(point(one, OBSTACLE_M) for one in corners), *(point(one) for one in corners)],
        indices=indices,
        color=colour(STONE),
    )


def _chain_edges(points: Sequence[Point]) -> list[Point]:
    """The sides of the triangles of a chain, each once, as the two ends of every one. (Not as indices into
    the points: Foxglove then draws no more sides than half of these.)"""
    count = len(points)
    sides = [(j, j + 1) for j in range(count - 1)] + [(j, j + 2) for j in range(count - 2)]
    return [points[index] for side in sides for index in side]


def _line(
    points: Sequence[Sequence[float]], z: float, kind: LinePrimitive.Type.ValueType, paint: Color
) -> LinePrimitive:
    return LinePrimitive(
        type=kind,
        pose=_AT_ORIGIN,
        thickness=LINE_M,
        points=[point(one, z) for one in points],
        color=paint,
    )


def _ring(ahead: float, radius: float, corners: int = 24) -> list[Point]:
    turn = 2 * math.pi / corners
    return [Pose(ahead, 0.0, k * turn).compose(Pose(radius, 0.0, 0.0))[:2] for k in range(corners)]
