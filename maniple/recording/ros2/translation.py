"""Messages in, ROS 2's out."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
import rosbags.typesys.stores.ros2_jazzy as ros
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from maniple.core import topics
from maniple.core.edges import WORLD
from maniple.core.geometry import Pose
from maniple.core.messages import (
    Drive,
    EmergencyStop,
    FormationState,
    Message,
    Mission,
    Odometry,
    Scan,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.places import legs_of
from maniple.core.scenario.types import Scenario, Task
from maniple.core.scenario.ways import way_of
from maniple.core.time import MILLISECOND, Duration, Time
from maniple.recording.ros2.basics import (
    FLOAT32,
    diagnosis,
    header,
    matrix,
    odometry,
    path,
    pose_stamped,
    stamp,
    transform,
    twist,
)
from maniple.recording.ros2.markers import Scene
from maniple.recording.ros2.names import Names, Said, Topic
from maniple.recording.viz.channels import FORMATION, LOG, OBSTACLES, ROBOTS
from maniple.recording.viz.scalars import largest
from maniple.recording.viz.sensed import STRIDE, points_of
from maniple.recording.viz.viewer import Viewer

DIAGNOSIS_GAP: Duration = 500 * MILLISECOND
"""How the formation is is told this often."""

STEP_M = 0.1
"""Between two poses of the formation's way."""
MOST_POSES = 1000
"""Of a way; longer ones have larger steps."""

_LEVELS = {Log.INFO: 20, Log.WARNING: 30, Log.ERROR: 40}
"""`rcl_interfaces/Log` levels."""

_WELL, _WARNING, _ERROR = 0, 1, 2

_MODE_LEVELS = {"tracking": _WELL, "emergency": _ERROR, "fault": _ERROR}

_SCENES: Mapping[str, str] = {FORMATION: "formation", ROBOTS: "robots", OBSTACLES: "obstacles"}
_TRAILS = "/viz/trajectory/"


class Translation:
    """Makes of the messages of a run, in order of their log times, what ROS 2 is told. The same messages make
    the same.

    What is drawn is what viewers draw (`maniple.recording.viz`), with their paces. Poses, frames, scans and
    states come as often as the platoon says them. `stamp_of` makes of a log time what headers say.
    """

    def __init__(
        self,
        scenario: Scenario,
        names: Names,
        epoch_ns: Time | None = None,
        stamp_of: Callable[[Time], Time] = lambda time: time,
    ) -> None:
        self._scenario = scenario
        self._names = names
        self._viewer = Viewer(scenario, epoch_ns)
        self._stamp_of = stamp_of
        self._scenes = {channel: Scene(names.frame) for channel in _SCENES}
        self._origins: dict[str, Pose] = {}
        self._mounts: dict[str, Pose] = {}
        self._task: Task | None = None
        self._stopped = False
        self._diagnosis_due: Time = 0

    def wants(self, topic: str) -> bool:
        """Whether messages of a topic matter."""
        return self._viewer.wants(topic)

    def begin(self) -> None:
        """Tell all anew that has not changed: whoever looks, looks from here on."""
        self._viewer.begin()
        self._origins.clear()
        self._mounts.clear()
        self._task = None

    def see(self, topic: str, message: Message, time: Time) -> Iterator[Said]:
        """What a message of a topic that it `wants` says in ROS 2; nothing where another node sent it than
        may send on that topic."""
        if not topics.may_send(topic, message.source):
            return
        if isinstance(message, Scan):  # viewers are given fewer, and other bytes
            yield from self._on_scan(message, time)
            return
        pictures = self._viewer.see(topic, message, time)
        yield from self._translated(message, time)
        for picture in pictures:
            yield from self._drawn(picture.key, picture.data, time)

    def _translated(self, message: Message, time: Time) -> Iterable[Said]:
        match message:
            case Odometry():
                return self._on_odometry(message, time)
            case FormationState():
                return self._on_state(message, time)
            case Status():
                return self._on_status(message, time)
            case Drive():
                return self._on_drive(message, time)
            case Truth():
                return self._on_truth(message, time)
            case Mission():
                return self._on_task(message.task or self._scenario.task, time)
            case EmergencyStop():
                self._stopped = message.stopped
        return ()

    def _on_odometry(self, said: Odometry, time: Time) -> Iterator[Said]:
        names, robot, now = self._names, said.source, self._stamp_of(time)
        own = Pose(said.x_m, said.y_m, said.psi_rad)
        frame, base = names.odom_frame(robot), names.base_frame(robot)
        velocity = said.u_mps, said.v_mps, said.w_radps
        yield Said(names.odometry[robot], odometry(frame, base, own, velocity, now), time)
        origin = self._viewer.frame_of(said)
        if origin is None:
            return
        if self._origins.get(robot) != origin:
            self._origins[robot] = origin
            yield self._fixed(time)
        yield self._frames(names.tf, [transform(frame, base, own, now)], time)
        yield Said(names.pose[robot], pose_stamped(WORLD, origin.compose(own), now), time)

    def _on_scan(self, scan: Scan, time: Time) -> Iterator[Said]:
        names, robot = self._names, scan.source
        mount = Pose(*scan.mount)
        if self._mounts.get(robot) != mount:
            self._mounts[robot] = mount
            yield self._fixed(time)
        head = header(names.sensor_frame(robot), self._stamp_of(time))
        ranges = np.frombuffer(scan.ranges, dtype="<f4")
        if scan.beams or len(ranges) < 2:
            yield Said(names.points[robot], _cloud(head, scan), time)
            return
        # REP 117: beyond the reach it saw nothing, +inf; what is too near to measure is -inf.
        told = np.where(ranges < scan.range_max_m, ranges, np.float32(np.inf))
        fan = ros.sensor_msgs__msg__LaserScan(
            header=head,
            angle_min=scan.first_angle_rad,
            angle_max=scan.first_angle_rad + scan.increment_rad * (len(ranges) - 1),
            angle_increment=scan.increment_rad,
            time_increment=0.0,
            scan_time=1.0 / self._scenario.rates.scan_hz,
            range_min=scan.range_min_m,
            range_max=scan.range_max_m,
            ranges=np.where(ranges < scan.range_min_m, np.float32(-np.inf), told).astype(np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )
        yield Said(names.scan[robot], fan, time)

    def _on_drive(self, drive: Drive, time: Time) -> Iterator[Said]:
        head = header(self._names.base_frame(drive.source), self._stamp_of(time))
        told = ros.geometry_msgs__msg__TwistStamped(head, twist(drive.u_mps, drive.v_mps, drive.w_radps))
        yield Said(self._names.drive[drive.source], told, time)

    def _on_truth(self, truth: Truth, time: Time) -> Iterator[Said]:
        now, frames = self._stamp_of(time), []
        for robot, row in zip(truth.robots, unpack_floats(truth.poses, 3).tolist(), strict=False):
            if robot in self._names.true_pose:
                at = Pose(*row)
                frames.append(transform(WORLD, self._names.true_frame(robot), at, now))
                yield Said(self._names.true_pose[robot], pose_stamped(WORLD, at, now), time)
        if frames:
            yield self._frames(self._names.tf, frames, time)

    def _on_status(self, status: Status, time: Time) -> Iterator[Said]:
        robot = status.source
        values = {
            "mode": status.mode,
            "guard": status.guard,
            "driver": status.driver,
            "controllable": status.controllable,
            "localised": status.localised,
            "emergency stop tested": status.estop_tested,
            "command age (s)": status.command_age_s,
            "largest command age (s)": status.command_age_max_s,
            **status.counters,
        }
        level = _MODE_LEVELS.get(status.mode, _WARNING)
        told = f"{status.mode}: {status.reason}" if status.reason else status.mode
        yield self._diagnosed(diagnosis(level, f"maniple: {robot}", robot, told, values), time)

    def _on_state(self, state: FormationState, time: Time) -> Iterator[Said]:
        names, now = self._names, self._stamp_of(time)
        if self._task is None:
            yield from self._on_task(self._scenario.task, time)
        reference = self._viewer.reference_of(state)
        yield Said(names.reference, pose_stamped(WORLD, reference, now), time)
        errors = unpack_floats(state.errors, 6)
        if len(errors):
            yield Said(names.errors, matrix(errors, ("triangle", "x y psi p q beta")), time)
        if time < self._diagnosis_due:
            return
        self._diagnosis_due = time + DIAGNOSIS_GAP
        values: dict[str, object] = {
            "phase": state.phase,
            "task time (s)": state.task_time_s,
            "task duration (s)": state.task_duration_s,
            "rate": state.rate,
            "chain": " ".join(state.chain),
            "waits for": " ".join(state.waits_for),
            "supervisor": "; ".join(state.supervisor),
            "emergency stop": self._stopped,
            **{f"{report.id} is": report.state for report in state.roster},
        }
        if len(errors):
            kinds = ("position (m)", "orientation (rad)", "distance (m)", "angle (rad)")
            for kind, error in zip(kinds, largest(errors), strict=True):
                values[f"largest error of {kind}"] = error
        gone = any(report.state not in ("present", "absent") for report in state.roster)
        level = _ERROR if self._stopped else _WARNING if gone or state.reason else _WELL
        words = "emergency stop" if self._stopped else state.phase
        told = f"{words}: {state.reason}" if state.reason else words
        yield self._diagnosed(diagnosis(level, "maniple: formation", "maniple", told, values), time)

    def _on_task(self, task: Task, time: Time) -> Iterator[Said]:
        """The way of the formation's origin, where it is new."""
        if task != self._task:
            self._task = task
            yield Said(self._names.way, path(WORLD, way_poses(task), self._stamp_of(time)), time)

    def _drawn(self, key: str, data: bytes, time: Time) -> Iterator[Said]:
        """What viewers are given, for RViz."""
        names, now = self._names, self._stamp_of(time)
        if key in _SCENES:
            markers = self._scenes[key].markers(SceneUpdate.FromString(data), now)
            yield Said(names.markers[_SCENES[key]], markers, time)
        elif key == LOG:
            line = Log.FromString(data)
            told = ros.rcl_interfaces__msg__Log(
                stamp(now), _LEVELS[line.level], f"maniple.{line.name}", line.message, "", "", 0
            )
            yield Said(names.log, told, time)
        elif key.startswith(_TRAILS):
            trail = PosesInFrame.FromString(data).poses
            poses = [
                Pose(one.position.x, one.position.y, 2 * math.atan2(one.orientation.z, one.orientation.w))
                for one in trail
            ]
            yield Said(names.path[key.removeprefix(_TRAILS)], path(WORLD, poses, now), time)

    def _fixed(self, time: Time) -> Said:
        """All frames that do not move, as who comes later is given the last message only."""
        names, now = self._names, self._stamp_of(time)
        frames = [transform(WORLD, names.odom_frame(one), at, now) for one, at in self._origins.items()]
        frames += (
            transform(names.base_frame(one), names.sensor_frame(one), at, now)
            for one, at in self._mounts.items()
        )
        return self._frames(names.tf_static, frames, time)

    def _frames(
        self, topic: Topic, frames: list[ros.geometry_msgs__msg__TransformStamped], time: Time
    ) -> Said:
        return Said(topic, ros.tf2_msgs__msg__TFMessage(frames), time)

    def _diagnosed(self, status: ros.diagnostic_msgs__msg__DiagnosticStatus, time: Time) -> Said:
        told = ros.diagnostic_msgs__msg__DiagnosticArray(header("", self._stamp_of(time)), [status])
        return Said(self._names.diagnostics, told, time)


def way_poses(task: Task) -> list[Pose]:
    """Where the formation's frame goes, in the world, in steps of about `STEP_M`; of a leg that is only a
    place to reach, that place."""
    found: list[Pose] = []
    for leg in legs_of(task):
        way = way_of(leg)
        steps = min(max(math.ceil(way.length_m / STEP_M), 1), MOST_POSES)
        found += (way.at(way.travel_s * k / steps)[0] for k in range(steps + 1 if way.travel_s else 1))
    return found


def _cloud(head: ros.std_msgs__msg__Header, scan: Scan) -> ros.sensor_msgs__msg__PointCloud2:
    """What an array of sonars saw, on the axis of each cone."""
    points = points_of(scan)
    spatial = np.zeros((len(points), 3), dtype="<f4")
    spatial[:, :2] = points
    fields = [
        ros.sensor_msgs__msg__PointField(name, 4 * index, FLOAT32, 1) for index, name in enumerate("xyz")
    ]
    return ros.sensor_msgs__msg__PointCloud2(
        header=head,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=STRIDE,
        row_step=STRIDE * len(points),
        data=np.frombuffer(spatial.tobytes(), dtype=np.uint8),
        is_dense=True,
    )
