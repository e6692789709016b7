import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from maniple.core.geometry import Pose, rotation, wrap, wrap_array

quick = settings(deadline=None, derandomize=True, max_examples=100)
lengths = st.floats(-50.0, 50.0)
angles = st.floats(-20.0, 20.0)
poses = st.builds(Pose, lengths, lengths, angles)


def matrix(pose: Pose) -> np.ndarray:
    """The homogeneous transform of a pose."""
    result = np.eye(3)
    result[:2, :2] = rotation(pose.psi)
    result[:2, 2] = pose.x, pose.y
    return result


@quick
@given(angles)
def test_wrap_is_the_angle_that_atan2_gives(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped - angle), 1.0)
    assert wrap(wrapped) == wrapped


@quick
@given(st.lists(angles, max_size=20))
def test_wrap_array_is_wrap(values: list[float]) -> None:
    wrapped = wrap_array(np.array(values))
    expected = np.array([wrap(value) for value in values])
    assert np.allclose(np.cos(wrapped - expected), 1.0)
    assert np.all((wrapped > -np.pi - 1e-12) & (wrapped <= np.pi))


@pytest.mark.parametrize("angle", [math.pi, -math.pi, 3 * math.pi, -3 * math.pi])
def test_half_a_turn_is_plus_pi(angle: float) -> None:
    assert wrap(angle) == math.pi
    assert wrap_array(np.array([angle]))[0] == math.pi


@quick
@given(poses, poses)
def test_compose_is_the_product_of_transforms(outer: Pose, inner: Pose) -> None:
    assert np.allclose(matrix(outer.compose(inner)), matrix(outer) @ matrix(inner), atol=1e-9)


@quick
@given(poses)
def test_inverse_undoes(pose: Pose) -> None:
    for identity in (pose.compose(pose.inverse()), pose.inverse().compose(pose)):
        assert np.allclose(matrix(identity), np.eye(3), atol=1e-9)


@quick
@given(poses, lengths, lengths)
def test_rotate_turns_free_vectors(pose: Pose, vx: float, vy: float) -> None:
    assert np.allclose(pose.rotate(vx, vy), rotation(pose.psi) @ [vx, vy])


@settings(deadline=None, derandomize=True, max_examples=20)
@given(poses, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_advance_integrates_the_unicycle(pose: Pose, forward: float, turn: float) -> None:
    """Against a numerical solution of x' = u cos psi, y' = u sin psi, psi' = w over one second."""
    solved = solve_ivp(
        lambda _, s: [forward * math.cos(s[2]), forward * math.sin(s[2]), turn],
        (0.0, 1.0),
        pose,
        rtol=1e-10,
        atol=1e-10,
    )
    x, y, psi = solved.y[:, -1]
    moved = pose.advance(forward, turn)
    assert moved[:2] == pytest.approx((x, y), abs=1e-7)
    assert math.cos(moved.psi - psi) == pytest.approx(1.0)


def test_advance_is_smooth_where_the_arc_becomes_a_line() -> None:
    around = [Pose(0.0, 0.0, 0.3).advance(2.0, turn) for turn in (0.0, 0.9e-9, 1.1e-9)]
    assert np.allclose(around[0], around[1], atol=1e-8)
    assert np.allclose(around[1], around[2], atol=1e-8)
