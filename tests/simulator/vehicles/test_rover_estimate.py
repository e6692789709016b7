import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maniple.core.messages import Motion
from maniple.core.time import MILLISECOND, SECOND
from simulator.vehicles.rover_estimate import Estimate, Geo

SITE = Geo.of(47.3977, 8.5456, 488.0)


def motion(x: float, y: float, psi: float, u: float = 0.0, w: float = 0.0) -> Motion:
    return Motion(
        ticks=(), applied=(u, w), state="active", controllable=True, pose=(x, y, psi), twist=(u, w, 0.0)
    )


@given(
    st.floats(-70, 70),
    st.floats(-179, 179),
    st.floats(-2000, 2000),
    st.floats(-2000, 2000),
)
def test_places_and_offsets_are_inverse(lat: float, lon: float, north: float, east: float) -> None:
    here = Geo.of(lat, lon, 10.0)
    assert here.offset(here.moved(north, east)) == pytest.approx((north, east), abs=3.0)  # of 2 km
    assert here.offset(here.moved(north / 100, east / 100)) == pytest.approx(
        (north / 100, east / 100), abs=0.02
    )


def test_a_kilometre_on_the_sphere() -> None:
    north, east = SITE.offset(Geo.of(47.3977 + 0.01, 8.5456 + 0.01, 488.0))
    degree = math.pi / 180 * 6_378_100
    assert north == pytest.approx(0.01 * degree, rel=1e-9)
    assert east == pytest.approx(0.01 * degree * math.cos(math.radians(47.4027)), rel=1e-6)


def test_between_reports_it_carries_the_pose_on() -> None:
    estimate = Estimate(SITE, gnss=True, boot=0)
    now = 5 * SECOND
    estimate.see(motion(1.0, 2.0, 0.0, u=0.5, w=0.4), now)
    assert estimate.set_origin(SITE, now)
    here = estimate.position(now + 100 * MILLISECOND)
    assert here is not None
    assert (here.east, here.north) == pytest.approx((1.05, 2.001), abs=1e-4)
    assert here.yaw == pytest.approx(math.pi / 2 - 0.04)
    assert (here.v_east, here.v_north) == pytest.approx((0.5, 0.02), abs=1e-3)
    assert here.yaw_rate == -0.4
    assert estimate.position(now + SECOND) is None  # silent for too long


def test_an_origin_elsewhere_shifts_all() -> None:
    estimate = Estimate(SITE, gnss=True, boot=0)
    now = 5 * SECOND
    estimate.see(motion(3.0, 4.0, 0.0), now)
    assert estimate.set_origin(SITE.moved(-100.0, 50.0), now)
    here = estimate.position(now)
    assert here is not None
    assert (here.east, here.north) == pytest.approx((3.0 - 50.0, 4.0 + 100.0), abs=0.02)
    fix = estimate.fix(now)
    assert fix is not None
    assert SITE.offset(fix) == pytest.approx((4.0, 3.0), abs=0.02)


def test_seldom_external_positions_do_not_count() -> None:
    estimate = Estimate(SITE, gnss=False, boot=0)
    estimate.see(motion(0.0, 0.0, 0.0), 2 * SECOND)
    assert estimate.set_origin(SITE, 2 * SECOND)
    for k in range(30):
        now = 2 * SECOND + k * 400 * MILLISECOND
        estimate.see(motion(0.0, 0.0, 0.0), now)
        estimate.feed(0.0, 0.0, now)
        estimate.update(now)
        assert estimate.position(now) is None
