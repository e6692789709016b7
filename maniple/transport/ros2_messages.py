"""Between ROS 2 messages and what this program speaks: pure, SI units, REP 103 (x forward, y left), REP 105.

Everything moves on a plane: height, roll and pitch are left out, covariances are not read.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from maniple.core.errors import MessageError
from maniple.core.geometry import Floats, Pose
from maniple.core.messages import Scan, pack_floats, unpack_floats
from maniple.core.time import SECOND, Time
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, TF, TWIST, TWIST_STAMPED, new

MOST_BEAMS = 20_000
"""No range finder has more."""

_LAST_S = 2**31 - 86_400
"""A day before ROS 2 can't tell the time any more."""

_FAR_AWAY_M = 1e7
"""No pose is farther from its origin."""


class Velocity3(NamedTuple):
    """A velocity in the robot's own frame: ahead (m/s), turning (rad/s), to the left (m/s)."""

    u: float
    w: float
    v: float


def time_of(stamp_ns: Time) -> Any:
    """A builtin_interfaces/Time."""
    return new("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)


def ns_of(stamp: Any) -> Time:
    """The inverse of `time_of`; 0 for what is no time."""
    seconds, rest = int(stamp.sec), int(stamp.nanosec)
    return seconds * SECOND + rest if 0 <= seconds < _LAST_S and 0 <= rest < SECOND else 0


def header(stamp_ns: Time, frame_id: str) -> Any:
    """A std_msgs/Header."""
    return new("std_msgs/msg/Header", stamp=time_of(stamp_ns), frame_id=frame_id)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    """A geometry_msgs/Vector3."""
    return new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def point(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    """A geometry_msgs/Point."""
    return new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))


def quaternion(yaw: float) -> Any:
    """A geometry_msgs/Quaternion that turns by `yaw` (rad) about z."""
    return new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def yaw_of(turn: Any) -> float:
    """The heading of a quaternion: where it turns the x axis to, seen from above, in (-pi, pi].

    Raises:
        MessageError: it is not finite, or of another length than 1.
    """
    x, y, z, w = float(turn.x), float(turn.y), float(turn.z), float(turn.w)
    norm = x * x + y * y + z * z + w * w
    if not 0.9 < norm < 1.1:  # neither is NaN
        raise MessageError(f"the orientation ({x:g}, {y:g}, {z:g}, {w:g}) is no unit quaternion")
    return math.atan2(2 * (w * z + x * y), norm - 2 * (y * y + z * z))


def pose(at: Pose) -> Any:
    """A geometry_msgs/Pose."""
    return new("geometry_msgs/msg/Pose", position=point(at.x, at.y), orientation=quaternion(at.psi))


def twist(velocity: Velocity3) -> Any:
    """A geometry_msgs/Twist."""
    u, w, v = velocity
    return new(TWIST, linear=vector(u, v), angular=vector(z=w))


def twist_stamped(velocity: Velocity3, stamp_ns: Time, frame_id: str) -> Any:
    """A geometry_msgs/TwistStamped."""
    return new(TWIST_STAMPED, header=header(stamp_ns, frame_id), twist=twist(velocity))


def velocity_of(message: Any) -> Velocity3:
    """What a Twist or a TwistStamped says.

    Raises:
        MessageError: it is not finite.
    """
    said = message.twist if message.__msgtype__ == TWIST_STAMPED else message
    values = Velocity3(float(said.linear.x), float(said.angular.z), float(said.linear.y))
    if not math.isfinite(sum(values)):
        raise MessageError(f"the velocity {tuple(values)} is not finite")
    return values


def odometry(
    at: Pose,
    velocity: Velocity3,
    stamp_ns: Time,
    frame_id: str,
    child_frame_id: str,
    pose_variance: Sequence[float] = (0.0, 0.0, 0.0),
) -> Any:
    """A nav_msgs/Odometry: the pose in the frame `frame_id`, the velocity in that of the robot."""
    spread = np.zeros(36)
    spread[[0, 7, 35]] = pose_variance
    still = np.zeros(36)
    return new(
        ODOMETRY,
        header=header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose(at), covariance=spread),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist(velocity), covariance=still),
    )


def pose_of(message: Any) -> tuple[Pose, Velocity3]:
    """What a nav_msgs/Odometry says.

    Raises:
        MessageError: it is not finite, no orientation, or farther away than anything is.
    """
    where = message.pose.pose.position
    x, y, psi = float(where.x), float(where.y), yaw_of(message.pose.pose.orientation)
    if not (abs(x) < _FAR_AWAY_M and abs(y) < _FAR_AWAY_M):  # neither is NaN
        raise MessageError(f"the position ({x:g}, {y:g}) is none")
    return Pose(x, y, psi), velocity_of(message.twist.twist)


def laser_scan(scan: Scan, stamp_ns: Time, frame_id: str, period_s: float) -> Any:
    """A sensor_msgs/LaserScan of an even fan, as REP 117 has it: infinite where nothing was seen, minus
    infinity where something was too near.

    Raises:
        MessageError: the beams are no even fan; LaserScan can't say that.
    """
    if scan.beams:
        raise MessageError("beams that are no even fan are no sensor_msgs/LaserScan")
    ranges = unpack_floats(scan.ranges)
    seen = np.where(ranges >= scan.range_max_m, np.inf, np.where(ranges < scan.range_min_m, -np.inf, ranges))
    return new(
        LASER_SCAN,
        header=header(stamp_ns, frame_id),
        angle_min=float(scan.first_angle_rad),
        angle_max=float(scan.first_angle_rad + scan.increment_rad * max(len(ranges) - 1, 0)),
        angle_increment=float(scan.increment_rad),
        time_increment=0.0,
        scan_time=float(period_s),
        range_min=float(scan.range_min_m),
        range_max=float(scan.range_max_m),
        ranges=seen.astype(np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def scan_of(message: Any, mount: Pose, unmeasured: Literal["near", "far"]) -> Scan:
    """A sensor_msgs/LaserScan of a sensor at `mount` in the robot's frame, beams counter-clockwise.

    By REP 117 infinity is nothing within range, and minus infinity something too near. What is NaN, 0 or
    outside of the limits is no measurement, and counts as something too near, or as nothing, as `unmeasured`
    says.

    Raises:
        MessageError: limits or angles that no range finder has.
    """
    first, increment = float(message.angle_min), float(message.angle_increment)
    near, far = float(message.range_min), float(message.range_max)
    with np.errstate(invalid="ignore"):  # a signalling NaN is one all the same
        given: Floats = np.asarray(message.ranges, dtype=np.float64)
    count = len(given)
    if not (0 <= near < far < math.inf):
        raise MessageError(f"a laser scan has the limits {near:g} and {far:g} m")
    if not (1 <= count <= MOST_BEAMS and math.isfinite(first + increment)):
        raise MessageError(f"a laser scan has {count} beams from {first:g} rad, {increment:g} rad apart")
    if not (increment or count == 1) or abs(increment) * (count - 1) > 2 * math.pi + 1e-3:
        raise MessageError(f"a laser scan has {count} beams {increment:g} rad apart")
    if increment < 0:
        first, increment, given = first + increment * (count - 1), -increment, given[::-1]
    measured = (given >= near) & (given > 0) & (given <= far)
    nothing, too_near = given == np.inf, given == -np.inf
    assumed = 0.0 if unmeasured == "near" else far
    ranges = np.where(measured, given, np.where(nothing, far, np.where(too_near, 0.0, assumed)))
    return Scan(
        first_angle_rad=first,
        increment_rad=increment,
        range_min_m=near,
        range_max_m=far,
        mount=(mount.x, mount.y, mount.psi),
        ranges=pack_floats(ranges),
    )


def transforms(frames: Mapping[str, tuple[str, Pose]], stamp_ns: Time) -> Any:
    """A tf2_msgs/TFMessage: for each child frame its parent and its pose in that."""
    return new(
        TF,
        transforms=[
            new(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp_ns, parent),
                child_frame_id=child,
                transform=new(
                    "geometry_msgs/msg/Transform",
                    translation=vector(at.x, at.y),
                    rotation=quaternion(at.psi),
                ),
            )
            for child, (parent, at) in frames.items()
        ],
    )
