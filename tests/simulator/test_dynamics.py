import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats, Pose
from simulator.dynamics import VelocityDynamics, integrate

SICK = (0.2604, 0.2509, -0.000499, 0.9965, 0.00263, 1.0768)
BARE = (0.5338, 0.2168, -0.0134, 0.9560, -0.0843, 1.0590)


def roll(
    theta: list[tuple[float, ...]], start: Floats, reference: Floats, step_s: float, steps: int
) -> Floats:
    dynamics = VelocityDynamics(theta, step_s)
    velocities = np.empty((steps + 1, *start.shape))
    velocities[0] = start
    drive = dynamics.input_gain * reference
    for k in range(steps):
        dynamics.step(velocities[k], drive, velocities[k + 1])
    return velocities


def exact(theta: tuple[float, ...], start: list[float], reference: list[float], duration_s: float) -> Floats:
    """(u, w, s, psi, x, y) after `duration_s` by an independent solver."""
    th1, th2, th3, th4, th5, th6 = theta

    def slope(_: float, z: Floats) -> list[float]:
        u, w, _, psi, _, _ = z
        return [
            (th3 * w * w - th4 * u + reference[0]) / th1,
            (-th5 * u * w - th6 * w + reference[1]) / th2,
            u,
            w,
            u * math.cos(psi),
            u * math.sin(psi),
        ]

    solution = solve_ivp(
        slope, (0.0, duration_s), [*start, 0, 0, 0, 0], method="DOP853", rtol=1e-12, atol=1e-13
    )
    return np.asarray(solution.y[:, -1])


@pytest.mark.parametrize("theta", [SICK, BARE])
@pytest.mark.parametrize("reference", [(0.75, 1.745), (-0.4, 0.9), (0.0, -1.7), (0.3, 0.0)])
def test_motion_agrees_with_an_independent_solver(
    theta: tuple[float, ...], reference: tuple[float, float]
) -> None:
    start = [0.2, -0.5]
    velocities = roll([theta], np.array([start]).T, np.array([reference]).T, 0.01, 200)
    _, travels, positions = integrate(velocities, np.zeros((2, 1)), np.zeros(1, dtype=complex), 0.01)
    u, w, s, psi, x, y = exact(theta, start, list(reference), 2.0)
    assert velocities[-1, :, 0] == pytest.approx([u, w], abs=2e-6)
    assert travels[-1, :, 0] == pytest.approx([s, psi], abs=2e-4)
    assert positions[-1, 0] == pytest.approx(complex(x, y), abs=2e-4)


def test_error_is_of_second_order() -> None:
    reference = (0.75, 1.745)
    u, w, *_, x, y = exact(BARE, [0.0, 0.0], list(reference), 1.0)
    errors = []
    for steps in (25, 50, 100):
        velocities = roll([BARE], np.zeros((2, 1)), np.array([reference]).T, 1.0 / steps, steps)
        _, _, positions = integrate(velocities, np.zeros((2, 1)), np.zeros(1, dtype=complex), 1.0 / steps)
        errors.append((np.hypot(*(velocities[-1, :, 0] - (u, w))), abs(positions[-1, 0] - complex(x, y))))
    for coarse, fine in pairwise(errors):
        assert coarse[0] / fine[0] == pytest.approx(4.0, rel=0.15)
        assert coarse[1] / fine[1] == pytest.approx(4.0, rel=0.15)


def test_uncoupled_drive_is_exact_for_any_step() -> None:
    theta = (0.3, 0.2, 0.0, 1.1, 0.0, 0.9)
    velocities = roll([theta], np.array([[0.5], [-1.0]]), np.array([[0.2], [1.0]]), 0.7, 1)
    u = 0.2 / 1.1 + (0.5 - 0.2 / 1.1) * math.exp(-0.7 * 1.1 / 0.3)
    w = 1.0 / 0.9 + (-1.0 - 1.0 / 0.9) * math.exp(-0.7 * 0.9 / 0.2)
    assert velocities[-1, :, 0] == pytest.approx([u, w], abs=1e-14)


def test_robots_do_not_influence_each_other() -> None:
    start, reference = np.array([[0.1, 0.3], [0.4, -0.2]]), np.array([[0.5, 0.2], [-1.0, 1.0]])
    both = roll([SICK, BARE], start, reference, 0.01, 50)
    for i, theta in enumerate([SICK, BARE]):
        alone = roll([theta], start[:, [i]], reference[:, [i]], 0.01, 50)
        assert both[:, :, i] == pytest.approx(alone[:, :, 0], abs=1e-15)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.floats(-1, 1), st.floats(-2, 2), st.floats(-3, 3), st.integers(1, 30))
def test_steady_velocities_make_an_exact_arc(u: float, w: float, psi: float, steps: int) -> None:
    velocities = np.empty((steps + 1, 2, 1))
    velocities[:, :, 0] = u, w
    arcs, travels, positions = integrate(velocities, np.array([[3.0], [psi]]), np.array([1.0 + 2.0j]), 0.01)
    end = Pose(1.0, 2.0, psi).advance(u * 0.01 * steps, w * 0.01 * steps)
    assert positions[-1, 0] == pytest.approx(complex(end.x, end.y), abs=1e-10)
    assert travels[-1, :, 0] == pytest.approx([3.0 + u * 0.01 * steps, psi + w * 0.01 * steps], abs=1e-12)
    assert arcs.sum(axis=0)[:, 0] == pytest.approx([u * 0.01 * steps, w * 0.01 * steps], abs=1e-12)


def test_theta_of_a_drive_that_would_run_away_is_refused() -> None:
    with pytest.raises(ScenarioError, match="th4"):
        VelocityDynamics([SICK, (0.3, 0.2, 0.0, -1.0, 0.0, 1.0)], 0.01)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.floats(-0.7, 0.7), st.floats(-1.7, 1.7), st.floats(-0.7, 0.7))
def test_sideways_motion_agrees_with_an_independent_solver(u_ref: float, w_ref: float, v_ref: float) -> None:
    th1, th2, th3, th4, th5, th6 = SICK

    def slope(_: float, z: Floats) -> list[float]:
        u, w, v, psi, _, _ = z
        return [
            (th3 * w * w - th4 * u + u_ref) / th1,
            (-th5 * u * w - th6 * w + w_ref) / th2,
            (-th4 * v + v_ref) / th1,
            w,
            u * math.cos(psi) - v * math.sin(psi),
            u * math.sin(psi) + v * math.cos(psi),
        ]

    start = [0.2, -0.5, 0.1]
    solution = solve_ivp(slope, (0.0, 2.0), [*start, 0, 0, 0], method="DOP853", rtol=1e-11, atol=1e-12)
    dynamics = VelocityDynamics([SICK], 0.01, sideways=True)
    velocities = np.empty((201, 3, 1))
    velocities[0, :, 0] = start
    drive = dynamics.input_gain * np.array([[u_ref], [w_ref], [v_ref]])
    for k in range(200):
        dynamics.step(velocities[k], drive, velocities[k + 1])
    _, travels, positions = integrate(velocities, np.zeros((3, 1)), np.zeros(1, dtype=complex), 0.01)
    u, w, v, psi, x, y = solution.y[:, -1]
    assert velocities[-1, :, 0] == pytest.approx([u, w, v], abs=2e-6)
    assert travels[-1, 1, 0] == pytest.approx(psi, abs=2e-4)
    assert positions[-1, 0] == pytest.approx(complex(x, y), abs=2e-4)
