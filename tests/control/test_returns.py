import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.control.returns import Returns, moved, returns_of
from maniple.core.geometry import Pose
from maniple.core.messages import Scan, pack_floats

DEGREE = math.pi / 180


def scan(
    ranges: list[float],
    first: float = -math.pi / 2,
    increment: float = DEGREE,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scan:
    return Scan(
        first_angle_rad=first,
        increment_rad=increment,
        range_min_m=0.2,
        range_max_m=8.0,
        mount=mount,
        ranges=pack_floats(ranges),
    )


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    st.lists(st.floats(0.0, 9.0, width=32), min_size=1, max_size=30),
    st.floats(-4.0, 4.0),
    st.floats(0.01, 0.2),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0)),
)
def test_agrees_with_composing_poses(
    ranges: list[float], first: float, increment: float, mount: tuple[float, float, float]
) -> None:
    result = returns_of(scan(ranges, first, increment, mount))
    expected = [
        Pose(*mount).compose(Pose(0.0, 0.0, first + k * increment)).compose(Pose(r, 0.0, 0.0))
        for k, r in enumerate(ranges)
        if r < 8.0
    ]
    assert result.distance == pytest.approx([math.hypot(p.x, p.y) for p in expected], abs=1e-9)
    x, y = result.distance * np.cos(result.bearing), result.distance * np.sin(result.bearing)
    assert x == pytest.approx([p.x for p in expected], abs=1e-9)
    assert y == pytest.approx([p.y for p in expected], abs=1e-9)
    assert np.all(np.abs(result.bearing) <= math.pi)


def test_drops_what_is_not_there_and_keeps_what_is_too_near_to_measure() -> None:
    result = returns_of(scan([8.0, 0.05, 9.0, 3.0, -1.0]))
    assert result.distance == pytest.approx([0.05, 3.0, 0.0], abs=1e-6)
    assert len(returns_of(scan([])).distance) == 0


def test_same_beams_in_the_same_order_whether_the_sensor_sits_in_the_centre_or_not() -> None:
    ranges = [1.0 + 0.01 * k for k in range(181)]
    centred = returns_of(scan(ranges))
    shifted = returns_of(scan(ranges, mount=(1e-9, 0.0, 0.0)))
    assert shifted.bearing == pytest.approx(centred.bearing, abs=1e-8)
    assert shifted.distance == pytest.approx(centred.distance, abs=1e-8)


@pytest.mark.parametrize(
    ("first_deg", "increment_deg", "beams", "yaw_deg", "ahead", "behind"),
    [
        (-90, 1, 181, 0, True, False),  # a laser in front
        (-90, 1, 181, 180, False, True),  # turned round
        (-90, 1, 181, 30, False, False),  # askew
        (-135, 0.5, 541, 0, True, False),
        (-180, 1, 360, 0, True, True),
        (0, 1, 360, 77, True, True),
        (-60, 1, 121, 0, False, False),  # too narrow
        (-88, 1, 177, 0, True, False),  # nearly the half-plane
        (0, 1, 1, 0, False, False),
    ],
)
def test_field_of_view(
    first_deg: float, increment_deg: float, beams: int, yaw_deg: float, ahead: bool, behind: bool
) -> None:
    mount = (0.0, 0.0, yaw_deg * DEGREE)
    result = returns_of(scan([1.0] * beams, first_deg * DEGREE, increment_deg * DEGREE, mount))
    assert (result.sees_ahead, result.sees_behind) == (ahead, behind)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    st.lists(st.tuples(st.floats(0.5, 8.0), st.floats(-3.1, 3.1)), min_size=1, max_size=10),
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.floats(-2.0, 2.0)),
)
def test_moved_is_undone_by_moving_back(
    polar: list[tuple[float, float]], motion: tuple[float, float, float]
) -> None:
    seen = Returns(np.array([p[0] for p in polar]), np.array([p[1] for p in polar]), True, False)
    there = moved(seen, Pose(*motion))
    back = moved(there, Pose(*motion).inverse())
    assert back.distance == pytest.approx(seen.distance, abs=1e-9)
    assert back.bearing == pytest.approx(seen.bearing, abs=1e-7)
    assert there.sees_ahead
    assert not there.sees_behind


def test_moving_towards_a_thing_brings_it_nearer() -> None:
    seen = Returns(np.array([2.0]), np.array([0.0]), True, True)
    assert moved(seen, Pose(0.5, 0.0, 0.1)).distance == pytest.approx([1.5])
    assert moved(seen, Pose(0.5, 0.0, 0.1)).bearing == pytest.approx([-0.1])
    assert moved(seen, Pose(0.0, 0.0, 0.0)) is seen


RING = [math.radians(angle) for angle in (90, 50, 30, 10, -10, -30, -50, -90)]


def sonars(
    directions: list[float], cone: float = math.radians(30), ranges: list[float] | None = None
) -> Scan:
    """Transducers that look in these directions from points 0.15 m away from the middle."""
    beams = [(0.15 * math.cos(a), 0.15 * math.sin(a), a) for a in directions]
    return Scan(
        first_angle_rad=0.0,
        increment_rad=0.0,
        range_min_m=0.1,
        range_max_m=5.0,
        mount=(0.0, 0.0, 0.0),
        beams=pack_floats(beams),
        cone_rad=cone,
        ranges=pack_floats(ranges or [5.0] * len(directions)),
    )


def test_what_a_cone_sees_is_on_its_axis() -> None:
    result = returns_of(sonars(RING, ranges=[1.0, 5.0, 5.0, 5.0, 5.0, 2.0, 5.0, 0.05]))
    assert result.distance == pytest.approx([1.15, 2.15, 0.2], abs=1e-6)
    assert result.bearing == pytest.approx([RING[0], RING[5], RING[7]], abs=1e-6)
    assert result.half_cone == pytest.approx(math.radians(15))
    assert moved(result, Pose(0.1, 0.0, 0.0)).half_cone == result.half_cone


def test_the_mount_turns_and_moves_the_transducers() -> None:
    scan = sonars([0.0], ranges=[1.0])
    turned = returns_of(replace(scan, mount=(0.2, 0.3, 2.0)))
    assert turned.distance * np.exp(1j * turned.bearing) == pytest.approx(
        complex(0.2, 0.3) + 1.15 * np.exp(2j), abs=1e-6
    )


@pytest.mark.parametrize(
    ("directions", "cone_deg", "ahead", "behind"),
    [
        (RING, 30, True, False),  # the front ring of a Pioneer: holes of 10 degrees between 65 and 75
        (RING, 28, False, False),
        ([*RING, *(a + math.pi for a in RING)], 30, True, True),
        ([a + math.pi for a in RING], 30, False, True),
        (RING[1:-1], 30, False, False),
        ([0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi], 80, True, True),
    ],
)
def test_what_cones_cover_together(
    directions: list[float], cone_deg: float, ahead: bool, behind: bool
) -> None:
    result = returns_of(sonars(directions, math.radians(cone_deg)))
    assert (result.sees_ahead, result.sees_behind) == (ahead, behind)
