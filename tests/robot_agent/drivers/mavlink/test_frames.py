"""Frames, both ways."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maniple.core.geometry import wrap
from robot_agent.drivers.mavlink.frames import (
    METRES_PER_DEGREE,
    Origin,
    east_north,
    north_east_yaw,
    pose,
    twist,
)

metres = st.floats(-1e4, 1e4)
angles = st.floats(-math.pi, math.pi)


@pytest.mark.parametrize(
    ("ned", "world"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)),  # heads north: along y
        ((0.0, 0.0, math.pi / 2), (0.0, 0.0, 0.0)),  # heads east: along x
        ((3.0, 4.0, math.pi), (4.0, 3.0, -math.pi / 2)),
    ],
)
def test_north_is_y_and_east_is_x(ned: tuple[float, float, float], world: tuple[float, float, float]) -> None:
    assert pose(*ned) == pytest.approx(world)


@given(north=metres, east=metres, yaw=angles, at=st.tuples(metres, metres))
def test_there_and_back(north: float, east: float, yaw: float, at: tuple[float, float]) -> None:
    back = north_east_yaw(*pose(north, east, yaw, at), at=at)
    assert back[:2] == pytest.approx((north, east), abs=1e-8)
    assert math.cos(back[2] - yaw) == pytest.approx(1.0)


@given(north=metres, east=metres, yaw=angles, u=st.floats(-3, 3), v=st.floats(-3, 3), w=st.floats(-3, 3))
def test_twist_is_the_derivative_of_the_pose(
    north: float, east: float, yaw: float, u: float, v: float, w: float
) -> None:
    """A robot moves with (u, w, v) in the world; the vehicle's own numbers of that give them back."""
    dt = 1e-6
    x, y, psi = pose(north, east, yaw)
    moved = (
        x + dt * (u * math.cos(psi) - v * math.sin(psi)),
        y + dt * (u * math.sin(psi) + v * math.cos(psi)),
        wrap(psi + dt * w),
    )
    to_north, to_east, to_yaw = north_east_yaw(*moved)
    rates = (to_north - north) / dt, (to_east - east) / dt, math.remainder(to_yaw - yaw, 2 * math.pi) / dt
    assert twist(rates[0], rates[1], yaw, rates[2]) == pytest.approx((u, w, v), abs=0.01)


def test_a_degree_north_and_a_degree_east() -> None:
    """111.32 km, and that times the cosine of the latitude."""
    here = Origin.of(60.0, 10.0, 0.0)
    assert east_north(here, Origin.of(60.001, 10.0, 0.0)) == pytest.approx((0.0, 1e-3 * METRES_PER_DEGREE))
    east, north = east_north(here, Origin.of(60.0, 10.001, 0.0))
    assert (east, north) == pytest.approx((0.5e-3 * METRES_PER_DEGREE, 0.0), rel=1e-4)
    assert east_north(here, here) == (0.0, 0.0)


def test_across_the_date_line() -> None:
    east, _ = east_north(Origin.of(0.0, 179.999, 0.0), Origin.of(0.0, -179.999, 0.0))
    assert east == pytest.approx(2e-3 * METRES_PER_DEGREE)


@given(latitude=st.floats(-65, 65), longitude=st.floats(-179, 179), east=st.floats(-2e3, 2e3))
def test_agrees_with_the_ellipsoid_within_a_percent(latitude: float, longitude: float, east: float) -> None:
    """WGS-84: the length of a degree of longitude is pi/180 a cos(lat) / sqrt(1 - e^2 sin^2(lat))."""
    sine = math.sin(math.radians(latitude))
    degree = math.radians(1.0) * 6378137.0 / math.sqrt(1.0 - 0.00669438 * sine * sine)
    turned = east / (degree * math.cos(math.radians(latitude)))
    found, north = east_north(
        Origin.of(latitude, longitude, 0.0), Origin.of(latitude, longitude + turned, 0.0)
    )
    assert found == pytest.approx(east, rel=0.01, abs=0.02)
    assert north == 0.0
