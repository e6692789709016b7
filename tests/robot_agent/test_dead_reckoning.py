import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.geometry import Pose
from maniple.core.scenario.types import RobotModel
from maniple.core.time import SECOND
from robot_agent.dead_reckoning import Reckoning, Wheels, step, wheels_of

WHEELS = Wheels(metres_per_tick=1e-6, track=0.33, ticks_per_second=2e6)
TENTH = SECOND // 10


def ticks_of(forward: float, turn: float) -> tuple[int, int]:
    """Counts after both wheels rolled at constant rates along an arc."""
    half = 0.5 * turn * WHEELS.track
    return round((forward - half) / WHEELS.metres_per_tick), round((forward + half) / WHEELS.metres_per_tick)


def test_geometry_of_a_pioneer() -> None:
    model = RobotModel(
        length_m=0.5,
        width_m=0.4,
        wheel_radius_m=0.0975,
        track_m=0.33,
        ticks_per_revolution=78414,
        u_max_mps=0.75,
        w_max_radps=1.745,
        u_accel_mps2=0.3,
        w_accel_radps2=1.7,
        brake_mps2=0.6,
        theta=(1, 1, 0, 1, 0, 1),
    )
    wheels = wheels_of(model)
    assert 1e-3 / wheels.metres_per_tick == pytest.approx(128, rel=1e-4)
    assert wheels.ticks_per_second * wheels.metres_per_tick > 1.2  # what ARIA lets it do


def test_first_counts_are_the_origin() -> None:
    state, jumped = step(WHEELS, Reckoning(), (10**9, -(10**9)), 5 * SECOND)
    assert (state.pose, state.u, state.w, jumped) == (Pose(0, 0, 0), 0.0, 0.0, False)


@settings(deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2)), max_size=20))
def test_arcs_add_up_exactly(arcs: list[tuple[float, float]]) -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    pose, left, right = Pose(0.0, 0.0, 0.0), 0, 0
    for k, (forward, turn) in enumerate(arcs, start=1):
        d_left, d_right = ticks_of(forward, turn)
        left, right = left + d_left, right + d_right
        pose = pose.advance(forward, turn)
        state, jumped = step(WHEELS, state, (left, right), k * TENTH)
        assert not jumped
        assert (state.u, state.w) == pytest.approx((10 * forward, 10 * turn), abs=1e-4)
    assert (state.pose.x, state.pose.y) == pytest.approx((pose.x, pose.y), abs=1e-3)
    assert math.remainder(state.pose.psi - pose.psi, 2 * math.pi) == pytest.approx(0.0, abs=1e-3)


def test_driving_back_the_same_way_ends_at_the_start() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    for k, ticks in enumerate([(50_000, 90_000), (140_000, 120_000), (50_000, 90_000), (0, 0)], start=1):
        state, _ = step(WHEELS, state, ticks, k * TENTH)
    assert state.pose == pytest.approx(Pose(0, 0, 0), abs=1e-12)


def test_counts_no_wheel_could_have_reached_are_a_new_origin() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    state, _ = step(WHEELS, state, (100_000, 100_000), TENTH)
    there = state.pose
    state, jumped = step(WHEELS, state, (-5_000_000, 0), 2 * TENTH)
    assert jumped
    assert (state.pose, state.u, state.w) == (there, 0.0, 0.0)
    state, jumped = step(WHEELS, state, (-5_000_000 + 50_000, 50_000), 3 * TENTH)
    assert not jumped
    assert state.pose.x == pytest.approx(there.x + 0.05)


def test_a_long_silence_is_no_jump() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    state, jumped = step(WHEELS, state, (5_000_000, 5_000_000), 10 * SECOND)
    assert not jumped
    assert (state.pose.x, state.u) == pytest.approx((5.0, 0.5))


def test_counts_without_time_keep_the_velocity() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    state, _ = step(WHEELS, state, (50_000, 50_000), TENTH)
    again, jumped = step(WHEELS, state, (50_001, 50_001), TENTH)
    assert not jumped
    assert again.u == state.u
    assert again.pose.x == pytest.approx(0.050001)
