import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from central_controller import formation
from central_controller.chain import Chain, Desired
from central_controller.formation import Gains
from central_controller.reference import REST
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Controller
from tests.central_controller.places import placed

GAINS = Gains.of(Controller(kappa=0.25, saturation=0.10))
PLACES = {
    3: [(0.6, 0.0), (-0.3, 0.6), (-0.3, -0.6)],
    6: [(1.0, 0.0), (0.0, 0.6), (0.0, -0.6), (-1.0, 0.6), (-1.0, -0.6), (-2.0, 0.0)],
}
DT_S = 0.05


def column(n: int) -> Floats:
    """Places of n robots, two abreast."""
    rank = np.arange(n)
    return np.column_stack([-0.8 * rank, np.where(rank % 2, 0.6, -0.6)])


def ideal_robots(chain: Chain, positions: Floats, desired: Desired, duration_s: float) -> Floats:
    """Where points that do what they are told end up (Euler)."""
    for _ in range(round(duration_s / DT_S)):
        positions = positions + DT_S * formation.step(chain, GAINS, positions, desired).velocities
    return positions


def reached(places: Floats, positions: Floats) -> int:
    """How many of the platoons (starts, n, 2) stand where they are to be."""
    distance = np.linalg.norm(positions - places, axis=-1)
    return int((distance.max(axis=-1) < 1e-3).sum())


def test_gains_are_one_number_or_six() -> None:
    six = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    gains = Gains.of(Controller(kappa=six, saturation=0.5))
    assert_allclose(gains.slope, np.array(six) / 0.5)
    assert_allclose(gains.saturation, np.full(6, 0.5))
    assert_allclose(Gains.of(Controller(kappa=0.3, saturation=six)).slope, 0.3 / np.array(six))


def test_law_is_eq_7() -> None:
    rng = np.random.default_rng(0)
    error, rates = rng.normal(size=(50, 6)), rng.normal(size=(50, 6))
    kappa, saturation = np.diag(rng.uniform(0.1, 1, 6)), np.diag(rng.uniform(0.1, 1, 6))
    gains = Gains(np.diag(kappa) / np.diag(saturation), np.diag(saturation))
    expected = [
        r + saturation @ np.tanh(np.linalg.inv(saturation) @ kappa @ e)
        for r, e in zip(rates, error, strict=True)
    ]
    assert_allclose(formation.law(rates, error, gains), expected, rtol=1e-12)


def test_correction_is_linear_near_zero_and_saturates() -> None:
    small, large = np.full((1, 6), 1e-5), np.full((1, 6), -1e3)
    rest = np.zeros((1, 6))
    assert_allclose(formation.law(rest, small, GAINS), 0.25 * small, rtol=1e-6)
    assert_allclose(formation.law(rest, large, GAINS), np.full((1, 6), -0.10), rtol=1e-12)


def test_errors_of_angles_take_the_short_way() -> None:
    desired = np.array([[5.0, -5.0, 3.0, 1.0, 1.0, -3.0]])
    actual = np.array([[0.0, 0.0, -3.0, 3.0, 0.0, 3.0]])
    turn = 2 * np.pi - 6.0
    assert_allclose(formation.errors(desired, actual), [[5, -5, -turn, -2, 1, turn]], atol=1e-12)


def test_the_error_obeys_eq_8_for_ideal_robots() -> None:
    """One triangle: q~' = -L tanh(L^-1 kappa q~), six independent scalar equations, solved by scipy."""
    chain = Chain(PLACES[3])
    desired = chain.desired(Pose(0.0, 0.0, 0.0), REST)
    start = placed(PLACES[3], Pose(0.4, -0.3, 0.2)) * 1.2

    def of_positions(_t: float, x: Floats) -> Floats:
        return formation.step(chain, GAINS, x.reshape(3, 2), desired).velocities.ravel()

    def of_errors(_t: float, e: Floats) -> Floats:
        return -0.10 * np.tanh(0.25 / 0.10 * e)

    first = formation.step(chain, GAINS, start, desired).errors.ravel()
    end = solve_ivp(of_positions, (0, 10), start.ravel(), rtol=1e-9, atol=1e-11).y[:, -1]
    expected = solve_ivp(of_errors, (0, 10), first, rtol=1e-9, atol=1e-11).y[:, -1]
    actual = formation.step(chain, GAINS, end.reshape(3, 2), desired).errors.ravel()
    assert np.abs(first).max() > 0.1
    assert_allclose(actual, expected, atol=1e-7)


@pytest.mark.parametrize("n", [3, 6])
def test_the_signed_law_always_gets_there(n: int) -> None:
    chain, pose = Chain(PLACES[n]), Pose(0.5, -0.5, 0.8)
    starts = np.random.default_rng(1).uniform(-3.0, 3.0, size=(100, n, 2))
    ends = ideal_robots(chain, starts, chain.desired(pose, REST), 150.0)
    assert reached(placed(PLACES[n], pose), ends) == 100


def test_the_printed_law_gets_there_about_half_the_time() -> None:
    """It can't tell a triangle from its mirror image: its errors vanish for both."""
    chain, pose = Chain(PLACES[3], signed=False), Pose(0.5, -0.5, 0.8)
    starts = np.random.default_rng(1).uniform(-3.0, 3.0, size=(100, 3, 2))
    desired = chain.desired(pose, REST)
    ends = ideal_robots(chain, starts, desired, 150.0)
    assert 30 <= reached(placed(PLACES[3], pose), ends) <= 70
    assert np.abs(formation.step(chain, GAINS, ends, desired).errors).max() < 1e-3


def test_the_printed_law_of_six_fails_as_often() -> None:
    chain, pose = Chain(PLACES[6], signed=False), Pose(0.5, -0.5, 0.8)
    starts = np.random.default_rng(1).uniform(-3.0, 3.0, size=(100, 6, 2))
    ends = ideal_robots(chain, starts, chain.desired(pose, REST), 150.0)
    assert 30 <= reached(placed(PLACES[6], pose), ends) <= 70


@pytest.mark.parametrize("n", [3, 10, 50, 100])
def test_errors_vanish_for_any_number_of_robots(n: int) -> None:
    """From places scattered by up to 0.5 m."""
    chain, pose = Chain(column(n)), Pose(0.0, 0.0, 0.3)
    rng = np.random.default_rng(n)
    direction, distance = rng.uniform(0, 2 * np.pi, n), 0.5 * np.sqrt(rng.uniform(size=n))
    scatter = np.column_stack([distance * np.cos(direction), distance * np.sin(direction)])
    desired = chain.desired(pose, REST)
    ends = ideal_robots(chain, placed(column(n), pose) + scatter, desired, 120.0)
    assert np.abs(formation.step(chain, GAINS, ends, desired).errors).max() < 1e-6
    assert_allclose(ends, placed(column(n), pose), atol=1e-6)


def test_a_moving_turning_reference_is_followed_without_error() -> None:
    """Feed-forward: with no error at first there is none later (RK4 over a circle)."""
    chain, w, v = Chain(PLACES[6]), 0.1, 0.2
    dt = 0.1

    def pose(t: float) -> Pose:
        return Pose(0.0, 0.0, 0.0).advance(v * t, w * t)

    def velocity(t: float, x: Floats) -> Floats:
        c, s = np.cos(w * t), np.sin(w * t)
        desired = chain.desired(pose(t), (v * float(c), v * float(s), w))
        return formation.step(chain, GAINS, x, desired).velocities

    x = placed(PLACES[6], pose(0.0))
    for k in range(300):
        t = k * dt
        k1 = velocity(t, x)
        k2 = velocity(t + dt / 2, x + dt / 2 * k1)
        k3 = velocity(t + dt / 2, x + dt / 2 * k2)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(t + dt, x + dt * k3))
    assert_allclose(x, placed(PLACES[6], pose(30.0)), atol=1e-5)
