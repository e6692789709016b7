"""ROS 2's small types. Metres, radians, seconds; x forward or east, y left or north (REP 103)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rosbags.typesys.stores.ros2_jazzy as ros

from maniple.core.geometry import Pose
from maniple.core.time import SECOND, Time

FLOAT32 = 7
"""`sensor_msgs/PointField.FLOAT32`."""


def type_of(message: object) -> str:
    """The ROS 2 type of a message, as "nav_msgs/msg/Path"."""
    name: str = getattr(message, "__msgtype__")  # noqa: B009 - a class variable of every type of rosbags
    return name


def stamp(time: Time) -> ros.builtin_interfaces__msg__Time:
    """A moment."""
    seconds, nanos = divmod(time, SECOND)
    return ros.builtin_interfaces__msg__Time(seconds, nanos)


def header(frame: str, time: Time) -> ros.std_msgs__msg__Header:
    """What is given in a frame at a moment."""
    return ros.std_msgs__msg__Header(stamp(time), frame)


def quaternion(psi: float) -> ros.geometry_msgs__msg__Quaternion:
    """A turn about z, rad."""
    return ros.geometry_msgs__msg__Quaternion(0.0, 0.0, math.sin(0.5 * psi), math.cos(0.5 * psi))


def pose(at: Pose) -> ros.geometry_msgs__msg__Pose:
    """A pose in the plane."""
    return ros.geometry_msgs__msg__Pose(ros.geometry_msgs__msg__Point(at.x, at.y, 0.0), quaternion(at.psi))


def pose_stamped(frame: str, at: Pose, time: Time) -> ros.geometry_msgs__msg__PoseStamped:
    """A pose in the plane of a frame."""
    return ros.geometry_msgs__msg__PoseStamped(header(frame, time), pose(at))


def path(frame: str, poses: Sequence[Pose], time: Time) -> ros.nav_msgs__msg__Path:
    """A way."""
    return ros.nav_msgs__msg__Path(header(frame, time), [pose_stamped(frame, one, time) for one in poses])


def transform(parent: str, child: str, at: Pose, time: Time) -> ros.geometry_msgs__msg__TransformStamped:
    """Where a frame is in another."""
    return ros.geometry_msgs__msg__TransformStamped(
        header(parent, time),
        child,
        ros.geometry_msgs__msg__Transform(
            ros.geometry_msgs__msg__Vector3(at.x, at.y, 0.0), quaternion(at.psi)
        ),
    )


def twist(u_mps: float, v_mps: float, w_radps: float) -> ros.geometry_msgs__msg__Twist:
    """Forward, to the left, and turning."""
    return ros.geometry_msgs__msg__Twist(
        ros.geometry_msgs__msg__Vector3(u_mps, v_mps, 0.0), ros.geometry_msgs__msg__Vector3(0.0, 0.0, w_radps)
    )


def odometry(
    frame: str, child: str, at: Pose, velocity: tuple[float, float, float], time: Time
) -> ros.nav_msgs__msg__Odometry:
    """Pose in a frame, and (u m/s, v m/s, w rad/s) along the axes of `child`. No covariances: zeros."""
    unknown = np.zeros(36)
    return ros.nav_msgs__msg__Odometry(
        header(frame, time),
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(pose(at), unknown),
        ros.geometry_msgs__msg__TwistWithCovariance(twist(*velocity), unknown),
    )


def diagnosis(
    level: int, name: str, hardware: str, message: str, values: Mapping[str, object]
) -> ros.diagnostic_msgs__msg__DiagnosticStatus:
    """How a part is: level 0 well, 1 a warning, 2 an error."""
    return ros.diagnostic_msgs__msg__DiagnosticStatus(
        level,
        name,
        message,
        hardware,
        [ros.diagnostic_msgs__msg__KeyValue(key, _text(value)) for key, value in values.items()],
    )


def matrix(rows: Any, labels: tuple[str, str]) -> ros.std_msgs__msg__Float64MultiArray:
    """Numbers (k, m) with a label for each dimension."""
    count, columns = rows.shape
    return ros.std_msgs__msg__Float64MultiArray(
        ros.std_msgs__msg__MultiArrayLayout(
            [
                ros.std_msgs__msg__MultiArrayDimension(labels[0], count, count * columns),
                ros.std_msgs__msg__MultiArrayDimension(labels[1], columns, columns),
            ],
            0,
        ),
        np.ascontiguousarray(rows, dtype=np.float64).ravel(),
    )


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
