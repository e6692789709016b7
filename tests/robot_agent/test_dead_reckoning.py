import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.control.limits import Velocity
from maniple.core.geometry import Pose
from maniple.core.messages import Motion
from maniple.core.streams import stream
from maniple.core.time import SECOND
from robot_agent.dead_reckoning import Reckoning, Wheels, advance, follow, gauge_of, step, wheels_of
from simulator.dynamics import integrate
from simulator.encoders import Encoders
from tests.pioneer import PIONEER

METRES_PER_TICK, TRACK = 1e-6, 0.33
WHEELS = Wheels(
    ahead=(0.5 * METRES_PER_TICK,) * 2,
    turn=(-METRES_PER_TICK / TRACK, METRES_PER_TICK / TRACK),
    left=(),
    ticks_per_second=2e6,
)
TENTH = SECOND // 10


def ticks_of(forward: float, turn: float) -> tuple[int, int]:
    """Counts after both wheels rolled at constant rates along an arc."""
    half = 0.5 * turn * TRACK
    return round((forward - half) / METRES_PER_TICK), round((forward + half) / METRES_PER_TICK)


def test_geometry_of_a_pioneer() -> None:
    wheels = wheels_of(PIONEER)
    assert wheels.ahead == pytest.approx([0.5e-3 / 128] * 2, rel=1e-4)
    assert wheels.turn[1] == -wheels.turn[0] == pytest.approx(1e-3 / 128 / 0.33, rel=1e-4)
    assert wheels.left == ()
    assert wheels.ticks_per_second * 1e-3 / 128 > 1.2  # what ARIA lets it do


def test_first_counts_are_the_origin() -> None:
    state, jumped = step(WHEELS, Reckoning(), (10**9, -(10**9)), 5 * SECOND)
    assert (state.pose, state.velocity, jumped) == (Pose(0, 0, 0), Velocity(), False)


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
        assert (state.velocity.u, state.velocity.w) == pytest.approx((10 * forward, 10 * turn), abs=1e-4)
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
    assert (state.pose, state.velocity) == (there, Velocity())
    state, jumped = step(WHEELS, state, (-5_000_000 + 50_000, 50_000), 3 * TENTH)
    assert not jumped
    assert state.pose.x == pytest.approx(there.x + 0.05)


def test_a_long_silence_is_no_jump() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    state, jumped = step(WHEELS, state, (5_000_000, 5_000_000), 10 * SECOND)
    assert not jumped
    assert (state.pose.x, state.velocity.u) == pytest.approx((5.0, 0.5))


def test_counts_without_time_keep_the_velocity() -> None:
    state, _ = step(WHEELS, Reckoning(), (0, 0), 0)
    state, _ = step(WHEELS, state, (50_000, 50_000), TENTH)
    again, jumped = step(WHEELS, state, (50_001, 50_001), TENTH)
    assert not jumped
    assert again.velocity == state.velocity
    assert again.pose.x == pytest.approx(0.050001)


@pytest.mark.parametrize("kind", ["differential", "omnidirectional", "car"])
def test_from_motion_through_encoders_back_to_motion(kind: str) -> None:
    """Random velocities of the simulated robot, each for a while: what its encoders count leads back to its
    pose, but for the rounding of the counts."""
    extra: dict[str, dict[str, float]] = {
        "differential": {},
        "omnidirectional": {"v_max_mps": 0.7},
        "car": {"wheelbase_m": 0.33, "steer_max_rad": 0.4},
    }
    model = replace(PIONEER, drive=kind, **extra[kind])
    random, wheels = stream(3, kind), wheels_of(model)
    encoders = Encoders([model], np.array([0.4]), 1, ["r1"])
    rows = 3 if kind == "omnidirectional" else 2
    travel, position = np.zeros((rows, 1)), np.array([1.0 + 2.0j])
    travel[1] = 0.4
    state, _ = step(wheels, Reckoning(), encoders.ticks(travel)[0], 0)
    for k in range(1, 201):
        velocity = random.uniform(-0.7, 0.7, (rows, 1)) * ([[1.0], [1.745], [1.0]][:rows])
        _, travels, positions = integrate(np.stack([velocity] * 2), travel, position, 0.05)
        travel, position = travels[-1], positions[-1]
        state, jumped = step(wheels, state, encoders.ticks(travel)[0], k * TENTH // 2)
        assert not jumped
        assert (*state.velocity,)[:rows] == pytest.approx(velocity[:, 0], abs=2e-3)
    there = Pose(1.0, 2.0, 0.4).compose(state.pose)
    assert (there.x, there.y) == pytest.approx((position[0].real, position[0].imag), abs=1e-4)
    assert math.remainder(there.psi - travel[1, 0], 2 * math.pi) == pytest.approx(0.0, abs=2e-4)


GAUGE = gauge_of(PIONEER)
IN_WORLD = gauge_of(PIONEER, in_world=True)
DRIVER_FRAMES = [Pose(0.0, 0.0, 0.0), Pose(500.0, -30.0, 2.5)]


@settings(deadline=None, derandomize=True)
@given(
    st.sampled_from(DRIVER_FRAMES),
    st.lists(st.tuples(st.floats(-0.07, 0.07), st.floats(-0.17, 0.17)), max_size=20),
)
def test_reported_poses_count_from_where_the_first_was(frame: Pose, arcs: list[tuple[float, float]]) -> None:
    state, jumped = follow(GAUGE, Reckoning(), frame, Velocity(), 0)
    assert (state.pose, jumped) == (Pose(0.0, 0.0, 0.0), False)
    pose = Pose(0.0, 0.0, 0.0)
    for k, (forward, turn) in enumerate(arcs, start=1):
        pose = pose.advance(forward, turn)
        said = Velocity(10 * forward, 10 * turn)
        state, jumped = follow(GAUGE, state, frame.compose(pose), said, k * TENTH)
        assert not jumped
        assert state.velocity == said
    assert (state.pose.x, state.pose.y) == pytest.approx((pose.x, pose.y), abs=1e-9)
    assert math.remainder(state.pose.psi - pose.psi, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("jump", [Pose(0.3, 0.0, 0.0), Pose(0.0, -50.0, 0.0), Pose(0.0, 0.0, 1.0)])
def test_a_pose_that_jumps_is_a_new_origin_of_its_frame_and_in_the_world_it_is_believed(jump: Pose) -> None:
    start, there = Pose(5.0, 5.0, 0.4), Pose(5.0, 5.0, 0.4).compose(jump)
    for gauge, at, went in ((GAUGE, (0.0, 0.0, 0.0), Pose(0.05, 0.0, 0.0)), (IN_WORLD, there, None)):
        state, _ = follow(gauge, Reckoning(), start, Velocity(), 0)
        state, jumped = follow(gauge, state, there, Velocity(0.5), TENTH)
        assert jumped
        assert (state.pose, state.velocity) == (at, Velocity(0.5))
        state, jumped = follow(gauge, state, there.advance(0.05, 0.0), Velocity(0.5), 2 * TENTH)
        assert not jumped
        assert state.pose == pytest.approx(went or there.advance(0.05, 0.0))


def test_what_the_drive_says_it_goes_and_small_corrections_are_no_jumps() -> None:
    """A pilot drives the robot at 3 m/s; an estimate is corrected by 8 cm."""
    state, _ = follow(GAUGE, Reckoning(), Pose(0.0, 0.0, 0.0), Velocity(), 0)
    state, jumped = follow(GAUGE, state, Pose(0.3, 0.0, 0.0), Velocity(3.0), TENTH)
    assert not jumped
    assert state.pose.x == pytest.approx(0.3)
    state, jumped = follow(GAUGE, state, Pose(0.3, 0.08, 0.0), Velocity(), TENTH)
    assert not jumped
    assert state.pose.y == pytest.approx(0.08)


def test_counts_and_poses_by_turns_count_on_from_each_other() -> None:
    def report(pose: tuple[float, float, float] | None, ticks: tuple[int, ...] = ()) -> Motion:
        return Motion(ticks=ticks, applied=(0.0, 0.0), state="active", controllable=True, pose=pose)

    state, stamp = Reckoning(), 0
    step_of = round(0.05 / GAUGE.wheels.ahead[0] / 2)
    for motion in (
        report(None, (7, 7)),
        report(None, (7 + step_of, 7 + step_of)),
        report((9.0, 9.0, math.pi / 2)),
        report((9.0, 9.05, math.pi / 2)),
        report(None, (7, 7)),
        report(None, (7 + step_of, 7 + step_of)),
    ):
        state, jumped = advance(GAUGE, state, motion, stamp)
        stamp += TENTH
        assert not jumped
    assert (state.pose.x, state.pose.y, state.pose.psi) == pytest.approx((0.15, 0.0, 0.0), abs=1e-4)
