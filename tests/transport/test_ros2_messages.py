"""What robots say in ROS 2's terms, and what it means here."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.errors import MessageError
from maniple.core.geometry import Pose, wrap
from maniple.core.messages import Scan, pack_floats, unpack_floats
from maniple.transport.ros2_cdr import LASER_SCAN, decode, encode, new
from maniple.transport.ros2_messages import (
    MOST_BEAMS,
    Velocity3,
    header,
    laser_scan,
    ns_of,
    odometry,
    pose_of,
    quaternion,
    scan_of,
    time_of,
    transforms,
    twist,
    twist_stamped,
    velocity_of,
    yaw_of,
)

MOUNT = Pose(0.1, 0.0, 0.5)
FINITE = st.floats(-1e6, 1e6)
HEADING = st.floats(-math.pi, math.pi)


def scanned(ranges: list[float], **changes: float) -> object:
    numbers = {
        "angle_min": -0.2,
        "angle_max": 0.2,
        "angle_increment": 0.1,
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.5,
        "range_max": 8.0,
    }
    return new(
        LASER_SCAN,
        header=header(0, "laser"),
        ranges=np.array(ranges, dtype=np.float32),
        intensities=np.zeros(len(ranges), dtype=np.float32),
        **(numbers | changes),
    )


@settings(deadline=None)
@given(FINITE, FINITE, HEADING, FINITE, FINITE, FINITE)
def test_odometry_says_what_was_put_in(x: float, y: float, psi: float, u: float, w: float, v: float) -> None:
    message = odometry(Pose(x, y, psi), Velocity3(u, w, v), 0, "odom", "base_link")
    (xx, yy, turned), velocity = pose_of(message)
    assert (xx, yy, *velocity) == (x, y, u, w, v)
    assert abs(wrap(turned - psi)) < 1e-9


@settings(deadline=None)
@given(FINITE, FINITE, FINITE)
def test_velocities_say_what_was_put_in_stamped_or_not(u: float, w: float, v: float) -> None:
    said = Velocity3(u, w, v)
    assert velocity_of(twist(said)) == velocity_of(twist_stamped(said, 1, "base_link")) == said


@settings(deadline=None)
@given(HEADING, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_the_heading_is_where_the_x_axis_points_whatever_the_slope(
    yaw: float, pitch: float, roll: float
) -> None:
    # Rz(yaw) Ry(pitch) Rx(roll), as a product of quaternions.
    cy, sy, cp, sp, cr, sr = (f(a / 2) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    turn = quaternion(0.0)
    turn.w, turn.x = cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr
    turn.y, turn.z = cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr
    assert abs(wrap(yaw_of(turn) - yaw)) < 1e-9


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e9])
@pytest.mark.parametrize("where", ["x", "y"])
def test_a_position_that_is_none_is_refused(bad: float, where: str) -> None:
    message = odometry(Pose(0, 0, 0), Velocity3(0, 0, 0), 0, "odom", "base_link")
    setattr(message.pose.pose.position, where, bad)
    with pytest.raises(MessageError, match="the position"):
        pose_of(message)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, 2.0])
def test_an_orientation_that_is_none_is_refused(bad: float) -> None:
    message = odometry(Pose(0, 0, 0), Velocity3(0, 0, 0), 0, "odom", "base_link")
    message.pose.pose.orientation.w = bad
    with pytest.raises(MessageError, match="no unit quaternion"):
        pose_of(message)


@pytest.mark.parametrize("which", ["u", "w", "v"])
def test_a_velocity_that_is_none_is_refused(which: str) -> None:
    with pytest.raises(MessageError, match="not finite"):
        velocity_of(twist(Velocity3(0.0, 0.0, 0.0)._replace(**{which: math.nan})))


@pytest.mark.parametrize("stamp", [0, 1, 999_999_999, 1_000_000_000, 1_795_457_848_382_476_073])
def test_times_are_seconds_and_nanoseconds(stamp: int) -> None:
    said = time_of(stamp)
    assert (said.sec, said.nanosec) == divmod(stamp, 10**9)
    assert ns_of(said) == stamp


@pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (2**31 - 1, 0), (5, 10**9), (5, 2**32 - 1)])
def test_what_is_no_time_counts_as_none(sec: int, nanosec: int) -> None:
    assert ns_of(new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)) == 0


def test_a_scan_goes_there_and_back() -> None:
    ranges = [0.0, 1.0, 7.5, 8.0]
    scan = Scan(
        first_angle_rad=-1.0,
        increment_rad=0.5,
        range_min_m=0.25,
        range_max_m=8.0,
        mount=(MOUNT.x, MOUNT.y, MOUNT.psi),
        ranges=pack_floats(ranges),
    )
    message = decode(encode(laser_scan(scan, 5, "laser", 0.1)), LASER_SCAN)
    assert message.ranges.tolist() == [-math.inf, 1.0, 7.5, math.inf]
    assert (message.angle_min, message.angle_max, message.header.stamp.nanosec) == (-1.0, 0.5, 5)
    assert scan_of(message, MOUNT, "near") == scan


def test_beams_in_directions_of_their_own_are_no_laser_scan() -> None:
    scan = Scan(
        first_angle_rad=0,
        increment_rad=0,
        range_min_m=0,
        range_max_m=5,
        mount=(0, 0, 0),
        ranges=pack_floats([1.0]),
        beams=pack_floats([[0.0, 0.0, 0.0]]),
    )
    with pytest.raises(MessageError, match="no even fan"):
        laser_scan(scan, 0, "laser", 0.1)


def test_infinity_is_nothing_and_minus_infinity_is_too_near() -> None:
    said = scanned([math.inf, -math.inf, 0.5, 8.0])
    for scan in (scan_of(said, MOUNT, "near"), scan_of(said, MOUNT, "far")):
        assert unpack_floats(scan.ranges).tolist() == [8.0, 0.0, 0.5, 8.0]
    assert (scan.range_min_m, scan.range_max_m, scan.mount) == (0.5, 8.0, tuple(MOUNT))


@pytest.mark.parametrize("value", [math.nan, 0.0, 0.3, 8.5, -1.0])
def test_what_was_not_measured_is_too_near_unless_it_is_to_be_far(value: float) -> None:
    said = scanned([value, 2.0])
    near, far = scan_of(said, MOUNT, "near"), scan_of(said, MOUNT, "far")
    assert unpack_floats(near.ranges).tolist() == [0.0, 2.0]
    assert unpack_floats(far.ranges).tolist() == [8.0, 2.0]


def test_a_clockwise_scan_is_turned_round() -> None:
    scan = scan_of(scanned([1.0, 2.0, 3.0, 4.0, 5.0], angle_min=0.2, angle_increment=-0.1), MOUNT, "near")
    assert unpack_floats(scan.ranges).tolist() == [5.0, 4.0, 3.0, 2.0, 1.0]
    assert scan.increment_rad == pytest.approx(0.1)
    assert scan.first_angle_rad == pytest.approx(-0.2)


@pytest.mark.parametrize(
    "changes",
    [
        {"range_min": math.nan},
        {"range_min": -1.0},
        {"range_min": 8.0},
        {"range_max": math.inf},
        {"range_max": math.nan},
        {"range_max": 0.0},
        {"angle_min": math.nan},
        {"angle_increment": math.inf},
        {"angle_increment": math.nan},
        {"angle_increment": 0.0},
        {"angle_increment": 4.0},
        {"angle_increment": -4.0},
    ],
)
def test_scans_that_no_range_finder_makes_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(MessageError, match="a laser scan has"):
        scan_of(scanned([1.0, 2.0, 3.0], **changes), MOUNT, "near")


@pytest.mark.parametrize("count", [0, MOST_BEAMS + 1])
def test_so_are_scans_without_beams_and_with_too_many(count: int) -> None:
    with pytest.raises(MessageError, match=f"{count} beams"):
        scan_of(scanned([1.0] * count, angle_increment=1e-5), MOUNT, "near")


def test_transforms_are_poses_of_frames_in_frames() -> None:
    message = transforms({"base_link": ("odom", Pose(1.0, 2.0, 0.5)), "laser": ("base_link", MOUNT)}, 7)
    base, laser = message.transforms
    assert (base.header.frame_id, base.child_frame_id, base.transform.translation.x) == (
        "odom",
        "base_link",
        1.0,
    )
    assert (laser.header.frame_id, laser.child_frame_id) == ("base_link", "laser")
    assert yaw_of(laser.transform.rotation) == pytest.approx(MOUNT.psi)
    assert ns_of(base.header.stamp) == 7
