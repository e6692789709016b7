import math

import pytest

from maniple.core.geometry import Pose
from maniple.core.messages import Scan, pack_floats
from maniple.core.time import SECOND
from robot_agent.range_sensing import RangeSensing

SCAN = Scan(
    first_angle_rad=-math.pi / 2,
    increment_rad=math.pi / 2,
    range_min_m=0.0,
    range_max_m=8.0,
    mount=(0.1, 0.0, 0.0),
    ranges=pack_floats([8.0, 1.9, 8.0]),
)


def test_knows_nothing_before_the_first_scan_and_after_the_last_has_gone_stale() -> None:
    sensing = RangeSensing(SECOND // 2)
    assert sensing.latest(100 * SECOND) is None
    assert sensing.around(Pose(0, 0, 0), 100 * SECOND) is None
    assert sensing.silence(100 * SECOND) == "no ranges yet"
    sensing.take(SCAN, Pose(0, 0, 0), 100 * SECOND)
    assert sensing.silence(102 * SECOND) == "no ranges for 2.0 s"
    assert sensing.latest(100 * SECOND + SECOND // 2) is not None
    assert sensing.latest(100 * SECOND + SECOND // 2 + 1) is None


def test_a_robot_that_turns_out_to_be_elsewhere_was_elsewhere_when_it_scanned() -> None:
    sensing = RangeSensing(SECOND)
    sensing.take(SCAN, Pose(1.0, 2.0, math.pi / 2), 0)
    before, after = Pose(1.0, 2.5, math.pi / 2), Pose(30.0, -7.0, 0.0)
    sensing.displaced(before, after)
    seen = sensing.around(after, 0)
    assert seen is not None
    assert seen.distance == pytest.approx([1.5])
    assert seen.bearing == pytest.approx([0.0], abs=1e-6)


def test_the_robot_has_moved_since_the_scan() -> None:
    sensing = RangeSensing(SECOND)
    sensing.take(SCAN, Pose(1.0, 2.0, math.pi / 2), 0)
    still = sensing.around(Pose(1.0, 2.0, math.pi / 2), 0)
    assert still is not None
    assert still is sensing.latest(0)
    assert still.distance == pytest.approx([2.0], abs=1e-6)
    there = sensing.around(Pose(1.0, 2.5, math.pi), 0)
    assert there is not None
    assert there.distance == pytest.approx([1.5], abs=1e-6)
    assert there.bearing == pytest.approx([-math.pi / 2], abs=1e-6)
