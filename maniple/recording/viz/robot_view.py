"""What is known of one robot, as viewers are told it."""

import math
from collections.abc import Mapping
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from maniple.core import edges, topics
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, Odometry, RobotReport, Scan, Status
from maniple.core.scenario.types import Point, Robot, RobotModel
from maniple.core.time import Duration, Time, from_seconds
from maniple.recording.viz.basics import WORLD, quaternion, sensor_frame, timestamp, true_frame
from maniple.recording.viz.channels import points_key, robot_scalars_key, scan_key, trajectory_key
from maniple.recording.viz.scalars import Known, RobotScalars, Told, measured
from maniple.recording.viz.scene import Bearing
from maniple.recording.viz.trail import Trail

_NOWHERE = Pose(0.0, 0.0, 0.0)

_LASTS: Mapping[str, Duration] = {
    kind: from_seconds(topics.topic(name).stale_after_s or 1.0)
    for kind, name in (
        ("odometry", topics.odometry("x")),
        ("status", topics.status("x")),
        ("drive", topics.drive("x")),
        ("report", topics.FORMATION_STATE),
        ("truth", topics.TRUTH),
    )
}
"""For how long what a kind of message says is plotted."""


class RobotView:
    """Takes in what was said of one robot of a resolved scenario, and its log time."""

    def __init__(self, robot: Robot, model: RobotModel) -> None:
        self.name = robot.id
        self.scan, self.points = scan_key(robot.id), points_key(robot.id)
        self.trajectory, self.numbers = trajectory_key(robot.id), robot_scalars_key(robot.id)
        self.origin = _NOWHERE if robot.pose is None else Pose(*robot.pose)
        """Of its own odometry frame in the world: its initial pose."""
        self.believed: Pose | None = None
        """Middle of the axle in the world, by dead reckoning."""
        self.true: Pose | None = None
        self.bearing = Bearing()
        self.news = False
        """Whether there was a word of it since its numbers were last told."""
        self.trail = Trail()
        self.trail_grown = False
        self.trail_due: Time = 0
        self.scan_due: Time = 0
        self._arm = robot.control_point_m
        self._sideways = model.v_max_mps is not None
        self._mount = _NOWHERE
        self._believed_at: Time = 0
        self._true_at: Time = 0
        self._frame = ""
        self._localised = True
        self._fields: dict[str, tuple[Time, Mapping[str, Known | Told]]] = {}
        """What each kind of message said for plots, and until when that says something about now."""

    @property
    def control_point(self) -> Point | None:
        """Where its control point is believed to be, m in the world; None where nobody knows."""
        if self.believed is None:
            return None
        x, y, psi = self.believed
        return x + self._arm * math.cos(psi), y + self._arm * math.sin(psi)

    def trust(self, frame_id: str) -> None:
        """The controller says which odometry frame begins at the initial pose."""
        self._frame = frame_id or self._frame

    def frame_of(self, odometry: Odometry) -> Pose | None:
        """Where the frame of its odometry is in the world; None where nobody knows."""
        if not self._localised or odometry.frame_id != self._frame:
            return None
        return _NOWHERE if odometry.frame_id == edges.WORLD else self.origin

    def on_odometry(self, odometry: Odometry, time: Time) -> None:
        """Its pose, if it is in the frame that is known, and its velocities."""
        self._frame = self._frame or odometry.frame_id
        if (frame := self.frame_of(odometry)) is not None:
            self.believed = frame.compose(Pose(odometry.x_m, odometry.y_m, odometry.psi_rad))
            self._believed_at = time
            self.trail_grown |= self.trail.add(self.believed)
        said = {"u_mps": odometry.u_mps, "w_radps": odometry.w_radps}
        self._plot("odometry", said | ({"v_mps": odometry.v_mps} if self._sideways else {}), time)

    def on_status(self, status: Status, time: Time) -> None:
        """How it is."""
        self._localised = status.localised
        self.bearing = self.bearing._replace(mode=status.mode, guard=status.guard)
        said: dict[str, Known | Told] = {
            "mode": status.mode,
            "guard": status.guard,
            "command_age_s": measured(status.command_age_s),
            "command_age_max_s": measured(status.command_age_max_s),
        }
        self._plot("status", said, time)

    def on_drive(self, drive: Drive, time: Time) -> None:
        """What its drive was told."""
        said = {"u_commanded_mps": drive.u_mps, "w_commanded_radps": drive.w_radps}
        self._plot("drive", said | ({"v_commanded_mps": drive.v_mps} if self._sideways else {}), time)

    def on_report(self, report: RobotReport, time: Time) -> None:
        """What the controller knows of it."""
        if self.bearing.state != report.state:
            self.bearing = self.bearing._replace(state=report.state)
        said: dict[str, Known | Told] = {
            "state": report.state,
            "odometry_age_s": measured(report.odometry_age_s),
            "round_trip_s": measured(report.round_trip_s),
        }
        self._plot("report", said, time)

    def on_truth(self, pose: Pose, clearance_m: float, time: Time) -> None:
        """Where it really is, and how near to anything."""
        self.true, self._true_at = pose, time
        self._plot("truth", {"clearance_m": clearance_m}, time)

    def on_scan(self, scan: Scan) -> None:
        """Where its range finder sits."""
        self._mount = Pose(*scan.mount)

    def scalars(self, time: Time) -> RobotScalars:
        """Its numbers, as far as they were said lately."""
        fields: dict[str, Any] = {}
        for until, said in self._fields.values():
            if time <= until:
                fields |= said
        return RobotScalars(**fields)

    def _plot(self, kind: str, said: Mapping[str, Known | Told], time: Time) -> None:
        self._fields[kind] = time + _LASTS[kind], said
        self.news = True

    def transforms(self, time: Time) -> list[FrameTransform]:
        """Its frames: as of when its pose was heard; that of its range finder, which is fixed, as of now."""
        found = []
        if self.believed is not None:
            found.append(_transform(WORLD, self.name, self.believed, self._believed_at))
            found.append(_transform(self.name, sensor_frame(self.name), self._mount, time))
        if self.true is not None:
            found.append(_transform(WORLD, true_frame(self.name), self.true, self._true_at))
        return found


def _transform(parent: str, child: str, at: Pose, time: Time) -> FrameTransform:
    return FrameTransform(
        timestamp=timestamp(time),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=at.x, y=at.y),
        rotation=quaternion(at.psi),
    )
