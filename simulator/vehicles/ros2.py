"""A simulated body as a robot that speaks ROS 2: as with diff_drive_controller and a laser driver.

It takes velocities on `cmd_vel` and says `odom`, `scan`, `tf` and `tf_static`, all under its namespace.
"""

from collections import deque
from typing import Any

from maniple.control.limits import Velocity
from maniple.core.errors import MessageError, ScenarioError
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Robot, RobotModel, Scenario
from maniple.core.time import SECOND, Duration, Time
from maniple.transport.ros2 import Network, RosPublisher, RosSession, RosSubscription
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, TF, TWIST, TWIST_STAMPED
from maniple.transport.ros2_keys import LATCHED, SENSOR_DATA, Attachment, Qos, names_of
from maniple.transport.ros2_messages import (
    Velocity3,
    laser_scan,
    ns_of,
    odometry,
    transforms,
    velocity_of,
)

TIMEOUT: Duration = SECOND // 2
"""diff_drive_controller's `cmd_vel_timeout`: without another velocity it stands, and older ones count for
nothing."""

NODE = "diff_drive_controller"
ODOM, BASE, LASER, MAP = "odom", "base_link", "laser", "map"
"""Frames: where the odometry begins, the middle of the axle, the range finder, the world."""

_OPEN_S = 5.0
_VARIANCE = (1e-4, 1e-4, 1e-3)


class VelocityCommand:
    """The last velocity that counts, as diff_drive_controller sees it. Pure."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._said = Velocity()
        self._at: Time | None = None
        self.late = 0
        """Commands that were too old when they came."""

    def take(self, said: Velocity3, stamp_ns: Time, now: Time) -> None:
        """A command has come; `stamp_ns` is 0 where it has none. A stamp that is ahead counts as now."""
        at = min(stamp_ns, now) if stamp_ns else now
        if now - at > TIMEOUT:
            self.late += 1
            return
        model = self._model
        v_max = model.v_max_mps or 0.0
        u = min(max(said.u, -model.u_max_mps), model.u_max_mps)
        w = min(max(said.w, -model.w_max_radps), model.w_max_radps)
        self._said, self._at = Velocity(u, w, min(max(said.v, -v_max), v_max)), at

    def order(self, now: Time) -> Drive:
        """What the body is to do now."""
        if self._at is None or now - self._at > TIMEOUT:
            return Drive(u_mps=0.0, w_radps=0.0, active=False)
        u, w, v = self._said
        return Drive(u_mps=u, w_radps=w, v_mps=v, active=True)


class Ros2Vehicle:
    """The computer of a robot that speaks ROS 2. Zenoh's threads only enqueue."""

    def __init__(self, scenario: Scenario, robot: Robot, endpoint: str = "", /) -> None:
        """Raises `ScenarioError` where its topics have no names that ROS 2 knows, or its range finder is none
        that LaserScan can describe."""
        ros2, model = robot.ros2, scenario.model_of(robot)
        self._names = names_of(robot)
        if scenario.sensor_of(robot).transducers and robot.scans in ("", "ros2"):
            raise ScenarioError(
                f"robots: {robot.id}: sensor = {robot.sensor!r}: transducers in directions of their own "
                "are no sensor_msgs/LaserScan; choose a fan, or scans = 'simulator'"
            )
        self._ros2 = ros2
        self._endpoint = ros2.router or endpoint
        self._mount = Pose(*model.sensor_mount)
        self._scan_period_s = 1.0 / scenario.rates.scan_hz
        self._command = VelocityCommand(model)
        self._heard: deque[Any] = deque(maxlen=100)
        self._origin: Pose | None = Pose(0.0, 0.0, 0.0) if ros2.in_world else None
        self._ros: RosSession | None = None
        self._says: dict[str, RosPublisher] = {}
        self._hears: RosSubscription | None = None
        self._not_finite = 0

    @property
    def refused(self) -> int:
        """Commands that could not be used."""
        return self._not_finite + self._command.late + (self._hears.bad if self._hears else 0)

    def open(self, now: Time) -> None:
        """Join the ROS 2 network.

        Raises:
            TransportError: its router does not answer.
            MissingExtraError: what ROS 2 needs is not installed.
        """
        ros2 = self._ros2
        network = Network(ros2.layout, ros2.domain_id)
        self._ros = ros = RosSession.open(self._endpoint, NODE, self._names.namespace, network, _OPEN_S)
        self._says = {
            "odom": ros.advertise(self._names.odom, ODOMETRY),
            "scan": ros.advertise(self._names.scan, LASER_SCAN, SENSOR_DATA),
            "tf": ros.advertise("tf", TF, Qos(depth=100)),
            "tf_static": ros.advertise("tf_static", TF, LATCHED),
        }
        self._says["tf_static"].publish(transforms({LASER: (BASE, self._mount)}, now))
        kind = TWIST_STAMPED if ros2.stamped else TWIST
        self._hears = ros.subscribe(self._names.cmd_vel, kind, self._enqueue)

    def see(self, report: Motion | Scan, now: Time) -> None:
        """Say how the body moves, in a frame that begins where it stands first (or in the world frame, if the
        scenario wants it so), or what its range finder sees."""
        if not self._says:
            return
        if isinstance(report, Scan):
            self._says["scan"].publish(laser_scan(report, now, LASER, self._scan_period_s))
        elif report.pose is not None:
            truth = Pose(*report.pose)
            if self._origin is None:
                self._origin = truth
            frame = MAP if self._ros2.in_world else ODOM
            at = self._origin.inverse().compose(truth)
            self._says["odom"].publish(odometry(at, Velocity3(*report.twist), now, frame, BASE, _VARIANCE))
            self._says["tf"].publish(transforms({BASE: (frame, at)}, now))

    def step(self, now: Time) -> Drive:
        """Take in the commands, and tell the body what to do."""
        while self._heard:
            message = self._heard.popleft()
            try:
                said = velocity_of(message)
            except MessageError:
                self._not_finite += 1
                continue
            stamp = ns_of(message.header.stamp) if self._ros2.stamped else 0
            self._command.take(said, stamp, now)
        return self._command.order(now)

    def close(self, _: Time, /) -> None:
        """Leave the network."""
        self._says = {}
        if self._ros is not None:
            self._ros.close()
            self._ros = None

    def _enqueue(self, message: Any, _: Attachment) -> None:
        self._heard.append(message)
