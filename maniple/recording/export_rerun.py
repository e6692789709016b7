"""A recording as an .rrd file for the Rerun viewer: frames, bodies, triangles, points, trails, numbers,
states and the text log, with a layout. Needs rerun-sdk; importing this imports it.

The one timeline is `run`, the time since the first message of the recording. Frames are the entities of the
robots: `world/robots/r1`, its range finder below that, and `world/truth/r1`.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import msgspec
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.duration_pb2 import Duration as ProtoDuration
from google.protobuf.timestamp_pb2 import Timestamp

from maniple.core.errors import ManipleError
from maniple.core.palette import rgb
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Time
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection
from maniple.recording.viz.basics import WORLD, colour_of, sensor_frame
from maniple.recording.viz.channels import Drawn
from maniple.recording.viz.export import EVERYTHING, ExportedFile, Pictures, new_file

TIMELINE = "run"

_MAGIC = b"RRF"

_BATCH = 20_000
"""Messages whose columns are written at once."""

_LEVELS = {
    Log.INFO: rr.TextLogLevel.INFO,
    Log.WARNING: rr.TextLogLevel.WARN,
    Log.ERROR: rr.TextLogLevel.ERROR,
}


def export_rerun(
    recording: Recording, out: Path, selection: Selection = EVERYTHING, force: bool = False
) -> ExportedFile:
    """Write what viewers draw of a recording into the .rrd file `out`. It is there whole or not at all.

    Raises:
        ArgumentError: `out` exists, and is no .rrd file or not to be replaced.
        RecordingError: the recording is damaged, or its scenario can't be read.
        ManipleError: the file can't be written.
    """
    pictures = Pictures(recording, selection)
    identity = f"{recording.metadata} {recording.start_ns} {recording.end_ns}"
    with new_file(out, force, "Rerun", lambda first_bytes: first_bytes.startswith(_MAGIC)) as new:
        stream = rr.RecordingStream(
            recording.scenario.name, recording_id=uuid5(NAMESPACE_URL, identity), send_properties=False
        )
        if not rr.is_enabled(stream):
            raise ManipleError("Rerun is turned off by the environment variable RERUN; unset it")
        stream.set_log_time_enabled(False)  # the wall clock of the export
        stream.set_log_tick_enabled(False)
        stream.save(new, default_blueprint=layout(recording.scenario))
        _paint(stream, recording.scenario)
        sketch = _Sketch(stream, recording.start_ns)
        for number, picture in enumerate(pictures, 1):
            sketch.add(picture)
            if number % _BATCH == 0:
                sketch.send()
        sketch.send()
        try:
            stream.flush()
        except RuntimeError as error:  # what went wrong it has said on its own
            raise ManipleError(f"{out}: can't write the export: {error}") from None
        stream.disconnect()
    return pictures.exported(out, "rerun")


def layout(scenario: Scenario) -> rrb.Blueprint:
    """The platoon in 3D beside errors, speeds, ages, states and the text log."""
    robots = [robot.id for robot in scenario.robots]

    def plot(name: str, numbers: Iterable[str], legend: bool = False) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin="numbers",
            contents=[f"$origin/{one}" for one in numbers],
            name=name,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        )

    def of_robots(name: str, *fields: str) -> rrb.TimeSeriesView:
        return plot(name, (f"robot/{robot}/{field}" for robot in robots for field in fields))

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(origin="world", name="Platoon"),
                rrb.TextLogView(origin="log", name="Log"),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                plot("Errors", (f"formation/{one}" for one in _ERRORS), legend=True),
                of_robots("Speeds", "u_mps", "u_commanded_mps"),
                of_robots("Turning rates", "w_radps", "w_commanded_radps"),
                of_robots("Ages", "command_age_s", "odometry_age_s"),
                of_robots("Clearances", "clearance_m"),
                rrb.StateTimelineView(
                    origin="states",
                    contents=["$origin/formation/phase", *(f"$origin/robot/{one}/mode" for one in robots)],
                    name="States",
                ),
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


_ERRORS = ("position_m", "orientation_rad", "distance_m", "angle_rad")


def _paint(stream: rr.RecordingStream, scenario: Scenario) -> None:
    """What holds all the time: z is up, and what robots see and where they have been has their colours."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for index, robot in enumerate(scenario.robots):
        colours = [rgb(colour_of(index))]
        points = rr.Points3D.from_fields(colors=colours, radii=0.02)
        stream.log(f"{_path(sensor_frame(robot.id))}/points", points, static=True)
        trail = rr.LineStrips3D.from_fields(colors=colours, radii=0.01)
        stream.log(f"world/trajectory/{robot.id}", trail, static=True)


class _Sketch:
    """Draws messages for viewers with Rerun's own types. What comes often is sent in columns."""

    def __init__(self, stream: rr.RecordingStream, start_ns: Time) -> None:
        self._stream = stream
        self._start = start_ns
        self._transforms: defaultdict[str, list[tuple[Time, list[float], list[float]]]] = defaultdict(list)
        self._clouds: defaultdict[str, list[tuple[Time, np.ndarray]]] = defaultdict(list)
        self._numbers: defaultdict[str, list[tuple[Time, float]]] = defaultdict(list)
        self._states: defaultdict[str, list[tuple[Time, str]]] = defaultdict(list)
        self._frames: dict[str, tuple[Time, list[float]]] = {}
        self._shown: dict[str, bytes] = {}
        self._said: dict[str, str] = {}
        self._vanishing: dict[str, Time] = {}

    def add(self, picture: Drawn) -> None:
        """Draw a message, now or with the next `send`."""
        key, data, time = picture
        what, _, name = key.removeprefix("/viz/").partition("/")
        match what:
            case "tf":
                self._add_frames(FrameTransforms.FromString(data), time)
            case "points":
                cloud = PointCloud.FromString(data)
                points = np.frombuffer(cloud.data, dtype="<f4").reshape(-1, 3)
                self._clouds[f"{_path(cloud.frame_id)}/points"].append((time, points))
            case "trajectory":
                poses = PosesInFrame.FromString(data).poses
                way = [(one.position.x, one.position.y, 0.0) for one in poses]
                self._log(f"world/trajectory/{name}", rr.LineStrips3D.from_fields(strips=[way]), time)
            case "log":
                line = Log.FromString(data)
                self._log(f"log/{line.name}", rr.TextLog(line.message, level=_LEVELS[line.level]), time)
            case "scalars":
                self._add_numbers(name, msgspec.json.decode(data), time)
            case "scan":
                pass  # the same as its points
            case _:
                self._clear(time)
                for entity in SceneUpdate.FromString(data).entities:
                    self._add_entity(what, entity, time)

    def send(self) -> None:
        """Send what has been gathered."""
        for path, rows in self._transforms.items():
            times, places, turns = zip(*rows, strict=True)
            self._columns(path, times, rr.Transform3D.columns(translation=places, quaternion=turns))
        for path, clouds in self._clouds.items():
            counts = [len(points) for _, points in clouds]
            columns = rr.Points3D.columns(positions=np.concatenate([points for _, points in clouds]))
            self._columns(path, [time for time, _ in clouds], columns.partition(counts))
        for path, numbers in self._numbers.items():
            times, values = zip(*numbers, strict=True)
            self._columns(path, times, rr.Scalars.columns(scalars=values))
        for path, states in self._states.items():
            times, words = zip(*states, strict=True)
            self._columns(path, times, rr.StateChange.columns(state=words))
        for gathered in (self._transforms, self._clouds, self._numbers, self._states):
            gathered.clear()

    def _add_frames(self, message: FrameTransforms, time: Time) -> None:
        """Where frames are at the times that was heard of; a fixed one once."""
        for one in message.transforms:
            place = [one.translation.x, one.translation.y, one.translation.z]
            turn = [one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w]
            heard = _ns(one.timestamp)
            path, (before, where) = _path(one.child_frame_id), self._frames.get(one.child_frame_id, (-1, []))
            fixed = one.parent_frame_id != WORLD
            if heard > before and not (fixed and where == place + turn):
                self._frames[one.child_frame_id] = heard, place + turn
                self._transforms[path].append((heard, place, turn))
        self._clear(time)

    def _add_numbers(self, name: str, fields: dict[str, float | str], time: Time) -> None:
        for field, value in fields.items():
            if not isinstance(value, str):
                self._numbers[f"numbers/{name}/{field}"].append((time, value))
                continue
            path = f"states/{name}/{field}"
            if self._said.get(path) != value:
                self._said[path] = value
                self._states[path].append((time, value))

    def _add_entity(self, channel: str, entity: SceneEntity, time: Time) -> None:
        """Draw an entity where it is new."""
        path = _path(entity.frame_id) if entity.frame_id != WORLD else f"world/{channel}/{entity.id}"
        lifetime = _ns(entity.lifetime)
        if lifetime:
            self._vanishing[path] = time + lifetime
        entity.ClearField("timestamp")
        if self._shown.get(path) == (content := entity.SerializeToString(deterministic=True)):
            return
        self._shown[path] = content
        for part, archetype in _parts(entity):
            self._log(f"{path}/{part}", archetype, time)

    def _clear(self, now: Time) -> None:
        """Take away what nobody has told anew for too long."""
        for path, until in [*self._vanishing.items()]:
            if now > until:
                del self._vanishing[path], self._shown[path]
                self._log(path, rr.Clear(recursive=True), until)

    def _log(self, path: str, archetype: rr.AsComponents, time: Time) -> None:
        self._stream.set_time(TIMELINE, duration=np.timedelta64(time - self._start, "ns"))
        self._stream.log(path, archetype)

    def _columns(self, path: str, times: Sequence[Time], columns: Iterable[rr.ComponentColumn]) -> None:
        since = (np.array(times, dtype=np.int64) - self._start).astype("timedelta64[ns]")
        self._stream.send_columns(path, [rr.TimeColumn(TIMELINE, duration=since)], columns)


def _path(frame: str) -> str:
    """The entity of a frame."""
    name, _, part = frame.partition("/")
    if part == "true":
        return f"world/truth/{name}"
    return f"world/robots/{name}/{part}" if part else f"world/robots/{name}"


def _parts(entity: SceneEntity) -> Iterable[tuple[str, rr.AsComponents]]:
    """The primitives of an entity."""
    if entity.cubes:
        yield (
            "boxes",
            rr.Boxes3D(
                centers=[_xyz(one.pose.position) for one in entity.cubes],
                sizes=[_xyz(one.size) for one in entity.cubes],
                quaternions=[_xyzw(one.pose.orientation) for one in entity.cubes],
                colors=[_rgba(one.color) for one in entity.cubes],
                fill_mode="solid",
            ),
        )
    if entity.cylinders:
        yield (
            "cylinders",
            rr.Cylinders3D(
                centers=[_xyz(one.pose.position) for one in entity.cylinders],
                lengths=[one.size.z for one in entity.cylinders],
                radii=[0.5 * one.size.x for one in entity.cylinders],
                colors=[_rgba(one.color) for one in entity.cylinders],
                fill_mode="solid",
            ),
        )
    if entity.lines:
        strips = [(strip, line) for line in entity.lines for strip in _strips(line)]
        yield (
            "lines",
            rr.LineStrips3D(
                [strip for strip, _ in strips],
                radii=[0.5 * line.thickness for _, line in strips],
                colors=[_rgba(line.color) for _, line in strips],
            ),
        )
    for number, one in enumerate(entity.triangles):
        yield (
            f"triangles/{number}",
            rr.Mesh3D(
                vertex_positions=[_xyz(point) for point in one.points],
                triangle_indices=np.reshape(one.indices, (-1, 3)),
                albedo_factor=_rgba(one.color),
            ),
        )
    if entity.texts:
        yield (
            "label",
            rr.Points3D(
                [_xyz(one.pose.position) for one in entity.texts],
                labels=[one.text for one in entity.texts],
                colors=[_rgba(one.color) for one in entity.texts],
                radii=0.0,
                show_labels=True,
            ),
        )


def _strips(line: LinePrimitive) -> list[list[tuple[float, float, float]]]:
    """The strips of a line."""
    points = [_xyz(point) for point in line.points]
    if line.type == LinePrimitive.LINE_LIST:
        return [points[k : k + 2] for k in range(0, len(points), 2)]
    return [[*points, points[0]] if line.type == LinePrimitive.LINE_LOOP else points]


def _xyz(of: Any) -> tuple[float, float, float]:
    return of.x, of.y, of.z


def _xyzw(of: Any) -> tuple[float, float, float, float]:
    return of.x, of.y, of.z, of.w


def _rgba(colour: Color) -> tuple[float, float, float, float]:
    return colour.r, colour.g, colour.b, colour.a


def _ns(time: Timestamp | ProtoDuration) -> Time:
    return int(time.seconds * SECOND + time.nanos)
