"""Ranges of a vehicle, as scans."""

import math
from typing import Any

import numpy as np
import pytest

from maniple.control.returns import returns_of
from maniple.core.messages import Scan, unpack_floats
from maniple.core.time import MILLISECOND
from robot_agent.drivers.mavlink.ranges import FRESH, Ranges
from tests.robot_agent.drivers.mavlink.bench import MAV

PERIOD = 100 * MILLISECOND


def sector(orientation: int, cm: int, low: int = 20, high: int = 800, **more: Any) -> Any:
    return MAV.MAVLink_distance_sensor_message(0, low, high, cm, 0, orientation, orientation, 0, **more)


def fan(cm: dict[int, int], step: float = 5.0, offset: float = 0.0, frame: int = 12) -> Any:
    distances = [cm.get(index, 801) for index in range(72)]
    return MAV.MAVLink_obstacle_distance_message(0, 0, distances, 0, 20, 800, step, offset, frame)


def seen(scan: Scan | None) -> dict[int, float]:
    """Range by direction, degrees counter-clockwise."""
    assert scan is not None
    directions = np.degrees(unpack_floats(scan.beams, 3)[:, 2])
    return {round(a): round(r, 3) for a, r in zip(directions, unpack_floats(scan.ranges), strict=True)}


def test_sectors_go_clockwise_and_beams_counter_clockwise() -> None:
    ranges = Ranges(PERIOD)
    for orientation in range(8):
        ranges.sector(sector(orientation, 100 + 10 * orientation), 0)
    scan = ranges.due(0)
    expected = {0: 1.0, -45: 1.1, -90: 1.2, -135: 1.3, 180: 1.4, 135: 1.5, 90: 1.6, 45: 1.7}
    assert {angle % 360: r for angle, r in seen(scan).items()} == {a % 360: r for a, r in expected.items()}
    assert scan is not None
    assert scan.cone_rad == pytest.approx(math.pi / 4)
    assert (scan.range_min_m, scan.range_max_m) == (0.2, 8.0)
    around = returns_of(scan)
    assert around.sees_ahead
    assert around.sees_behind


def test_nothing_seen_too_near_and_invalid() -> None:
    ranges = Ranges(PERIOD)
    ranges.sector(sector(0, 801), 0)
    ranges.sector(sector(1, 19), 0)
    ranges.sector(sector(2, 300, high=300), 0)
    ranges.sector(sector(3, 100, signal_quality=1), 0)
    ranges.sector(sector(25, 100), 0)  # looks down
    ranges.sector(sector(4, 100, low=50, high=50), 0)
    scan = ranges.due(0)
    assert seen(scan) == {0: 8.0, -45: 0.0, -90: 8.0}


def test_a_sector_that_falls_silent_is_no_longer_looked_at() -> None:
    ranges = Ranges(PERIOD)
    for orientation in range(8):
        ranges.sector(sector(orientation, 100), 0)
    for orientation in range(4):
        ranges.sector(sector(orientation, 200), FRESH + 1)
    scan = ranges.due(FRESH + 1)
    assert set(seen(scan)) == {0, -45, -90, -135}
    assert scan is not None
    assert not returns_of(scan).sees_behind


def test_a_scan_each_period_and_none_without_news() -> None:
    ranges = Ranges(PERIOD)
    ranges.sector(sector(0, 100), 0)
    assert ranges.due(0) is not None
    ranges.sector(sector(0, 100), 1)
    assert ranges.due(PERIOD - 1) is None
    assert ranges.due(PERIOD) is not None
    assert ranges.due(5 * PERIOD) is None


def test_a_fan_in_the_frame_of_the_body() -> None:
    ranges = Ranges(PERIOD)
    ranges.fan(fan({0: 100, 9: 200, 63: 300, 5: 65535}), None, 0)
    found = seen(ranges.due(0))
    assert (found[0], found[-45], found[45]) == (1.0, 2.0, 3.0)
    assert -25 not in found, "65535 is not known"
    assert len(found) == 71
    assert found[90] == 8.0


def test_a_fan_that_starts_on_the_left() -> None:
    ranges = Ranges(PERIOD)
    ranges.fan(fan({0: 100, 71: 200}, step=1.0, offset=-35.0), None, 0)
    found = seen(ranges.due(0))
    assert (found[35], found[-36]) == (1.0, 2.0)


def test_a_fan_from_north_is_turned_by_the_heading() -> None:
    ranges = Ranges(PERIOD)
    ranges.fan(fan({0: 100}, frame=0), math.radians(90.0), 0)  # heads east: north is to the left
    assert seen(ranges.due(0))[90] == 1.0
    ranges.fan(fan({0: 100}, frame=0), None, PERIOD)
    assert ranges.due(PERIOD) is None, "the heading is not known"


def test_a_fan_says_more_than_sectors() -> None:
    ranges = Ranges(PERIOD)
    ranges.sector(sector(0, 100), 0)
    ranges.fan(fan({}), None, 0)
    assert len(seen(ranges.due(0))) == 72
    ranges.sector(sector(0, 100), 2 * FRESH)
    assert len(seen(ranges.due(2 * FRESH))) == 1
    assert ranges.heard(2 * FRESH) == "DISTANCE_SENSOR, sectors 0"


@pytest.mark.parametrize("step", [math.nan, math.inf, -5.0, 0.0, 400.0])
def test_absurd_fans_are_left_out(step: float) -> None:
    ranges = Ranges(PERIOD)
    ranges.fan(fan({0: 100}, step=step), None, 0)
    ranges.fan(fan({0: 100}, offset=math.nan), None, 0)
    assert ranges.due(0) is None
