import math

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.integrate import solve_ivp

from maniple.control import unicycle
from maniple.control.compensation import (
    SPREAD,
    Adaptive,
    Derivative,
    Terms,
    bounds,
    corrected,
    reference,
    regressor,
)
from maniple.control.limits import Velocity
from maniple.core.errors import ScenarioError
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Compensation
from tests.pioneer import PIONEER

THETA = (0.2604, 0.2509, -0.000499, 0.9965, 0.00263, 1.0768)
"""A Pioneer 3-DX with a SICK laser, which the figures of the source are for."""
MODEL = replace(PIONEER, theta=THETA)
WRONG = 1.0 / 1.5


def drive(u: float, w: float, told: Velocity, theta: tuple[float, ...] = THETA) -> tuple[float, float]:
    """(u', w') of the drive."""
    th1, th2, th3, th4, th5, th6 = theta
    return (th3 * w * w - th4 * u + told.u) / th1, (-th5 * u * w - th6 * w + told.w) / th2


def wanted(t: float) -> tuple[Velocity, Velocity]:
    """A desired velocity and its derivative."""
    return (
        Velocity(0.4 + 0.1 * math.sin(t), 0.5 * math.cos(0.7 * t)),
        Velocity(0.1 * math.cos(t), -0.35 * math.sin(0.7 * t)),
    )


@pytest.mark.parametrize("theta", [THETA, (0.5338, 0.2168, -0.0134, 0.9560, -0.0843, 1.0590)])
def test_with_the_true_parameters_the_drive_follows_exactly(theta: tuple[float, ...]) -> None:
    def slope(t: float, state: np.ndarray) -> tuple[float, float]:
        desired, rates = wanted(t)
        measured = Velocity(*state)
        told = reference(theta, Terms(desired, measured, corrected(Compensation(), desired, measured, rates)))
        return drive(state[0], state[1], told, theta)

    times = np.linspace(0.0, 20.0, 50)
    start = wanted(0.0)[0][:2]
    on_it = solve_ivp(slope, (0.0, 20.0), start, t_eval=times, rtol=1e-10, atol=1e-12)
    expected = np.array([wanted(t)[0][:2] for t in times]).T
    assert on_it.y == pytest.approx(expected, abs=1e-8)
    off_it = solve_ivp(slope, (0.0, 20.0), (0.0, 0.0), t_eval=times, rtol=1e-9, atol=1e-12)
    assert off_it.y[:, -1] == pytest.approx(expected[:, -1], abs=1e-6), "an error at first fades"


def test_adaptation_only_takes_energy_out_of_the_error() -> None:
    """V = th1 u~^2/2 + th2 w~^2/2 + sum (th^ - th)^2 / (2 gamma) never grows, but for the forgetting."""
    law = Compensation()
    gamma, theta = np.array(law.gamma), np.array(THETA)

    def energy(state: np.ndarray, t: float) -> float:
        desired, _ = wanted(t)
        du, dw = desired.u - state[0], desired.w - state[1]
        off = (state[2:] - theta) ** 2 / gamma
        return 0.5 * float(THETA[0] * du**2 + THETA[1] * dw**2 + off.sum())

    def slope(t: float, state: np.ndarray) -> np.ndarray:
        desired, rates = wanted(t)
        measured = Velocity(state[0], state[1])
        terms = Terms(desired, measured, corrected(law, desired, measured, rates))
        told = reference(tuple(state[2:]), terms)
        return np.array([*drive(state[0], state[1], told), *(gamma * regressor(terms))])

    times = np.linspace(0.0, 60.0, 600)
    found = solve_ivp(slope, (0.0, 60.0), [0.0, 0.0, *(WRONG * theta)], t_eval=times, rtol=1e-9, atol=1e-11)
    energies = [energy(state, t) for state, t in zip(found.y.T, times, strict=True)]
    assert np.diff(energies).max() < 1e-9
    assert energies[-1] < 0.5 * energies[0]


def circle(law: Compensation, seconds: float = 90.0, dt_s: float = 0.005) -> float:
    """RMS distance (m) of the control point from a point that goes round a circle of 1.5 m at 0.375 m/s, over
    the last 45 s."""
    adaptive, a, radius, speed = Adaptive(law, MODEL), 0.2, 1.5, 0.375
    x, y, psi, u, w = radius, 0.0, math.pi / 2, 0.0, 0.0
    late = []
    for k in range(round(seconds / dt_s)):
        angle = speed / radius * k * dt_s
        ex = radius * math.cos(angle) - x - a * math.cos(psi)
        ey = radius * math.sin(angle) - y - a * math.sin(psi)
        vx = -speed * math.sin(angle) + 0.1 * math.tanh(2.0 * ex)
        vy = speed * math.cos(angle) + 0.1 * math.tanh(2.0 * ey)
        desired = Velocity(*unicycle.inverse(psi, a, vx, vy))
        du, dw = drive(u, w, adaptive.step(desired, Velocity(u, w), True, dt_s if k else 0.0))
        u, w = u + du * dt_s, w + dw * dt_s
        x, y, psi = x + u * math.cos(psi) * dt_s, y + u * math.sin(psi) * dt_s, psi + w * dt_s
        if (seconds - k * dt_s) <= 45.0:
            late.append(ex * ex + ey * ey)
    return math.sqrt(sum(late) / len(late))


def test_the_circle_of_the_source() -> None:
    """There, with a kinematic controller that it does not give: exact 0.0002 m, fixed and too small by 1.5
    0.285 m, adapting from there 0.015 m."""
    exact = circle(Compensation(adapt=False))
    fixed = circle(Compensation(adapt=False, initial=WRONG))
    adapting = circle(Compensation(initial=WRONG))
    assert exact < 0.001
    assert 0.2 < fixed < 0.35
    assert adapting < fixed / 5.0


def test_the_derivative_lags_by_its_time_constant() -> None:
    tau, dt_s = 0.2, 0.1
    filtered = Derivative(tau)
    for k in range(60):
        t = k * dt_s
        found = filtered.step(0.5 * t * t, dt_s if k else 0.0)
    lag = 0.5 * dt_s / math.tanh(0.5 * dt_s / tau)
    assert found == pytest.approx(t - lag, abs=1e-9)
    assert tau < lag < 1.03 * tau


@pytest.mark.parametrize("dt_s", [0.01, 0.1, 0.5])
def test_the_derivative_is_exact_for_straight_lines_at_any_rate(dt_s: float) -> None:
    filtered, tau = Derivative(0.2), 0.2
    filtered.step(1.0, 0.0)
    for k in range(1, 40):
        found = filtered.step(1.0 + 3.0 * k * dt_s, dt_s)
        assert found == pytest.approx(3.0 * (1.0 - math.exp(-k * dt_s / tau)))


@pytest.mark.parametrize("dt_s", [0.001, 0.05, 0.1])
def test_the_derivative_does_not_amplify_noise(dt_s: float) -> None:
    tau = 0.2
    filtered = Derivative(tau)
    noise = np.random.default_rng(1).normal(size=20_000)
    found = [filtered.step(float(x), dt_s) for x in noise]
    keep = math.exp(-dt_s / tau)
    expected = (1.0 - keep) / dt_s * math.sqrt(2.0 / (1.0 + keep))
    assert np.std(found[200:]) == pytest.approx(expected, rel=0.05)
    assert expected <= 1.01 / tau


def test_a_gap_begins_the_derivative_anew() -> None:
    filtered = Derivative(0.2)
    for k in range(10):
        filtered.step(float(k), 0.1)
    assert filtered.step(50.0, 0.0) == 0.0
    assert filtered.step(50.0, 0.1) == 0.0


STRAIGHT, STANDING = Velocity(0.3, 0.1), Velocity()


def adapted(*, free: bool = True, desired: Velocity = STRAIGHT, dt_s: float = 0.05, steps: int = 200) -> bool:
    law = Adaptive(Compensation(initial=WRONG), MODEL)
    before = law.parameters
    measured = Velocity(0.9 * desired.u, 0.9 * desired.w)
    for _ in range(steps):
        law.step(desired, measured, free, dt_s)
    return law.parameters != before


def test_nothing_is_adapted_while_the_error_is_not_the_parameters_doing() -> None:
    assert adapted()
    assert not adapted(free=False), "the guard cut it off"
    assert not adapted(desired=STANDING)
    assert not adapted(desired=Velocity(5.0, 0.0)), "more than it can do"
    assert not adapted(dt_s=0.0)
    assert not adapted(steps=1), "more than it can speed up in one step"


def test_nothing_is_adapted_while_a_car_can_not_turn_so_tightly() -> None:
    car = replace(MODEL, drive="car", wheelbase_m=0.5, steer_max_rad=0.4)
    tightest = math.tan(0.4) / 0.5
    for share, learns in ((0.5, True), (1.5, False)):
        law = Adaptive(Compensation(), car)
        before = law.parameters
        desired = Velocity(0.3, 0.3 * share * tightest)
        for _ in range(200):
            law.step(desired, Velocity(0.29, 0.95 * desired.w), True, 0.05)
        assert (law.parameters != before) is learns


@pytest.mark.parametrize("measured", [Velocity(-1e3, 1e3), Velocity(1e3, -1e3), Velocity(1e9, 1e9)])
def test_parameters_stay_within_bounds(measured: Velocity) -> None:
    law = Adaptive(Compensation(gamma=(1e3,) * 6), replace(MODEL, u_max_mps=1e12, w_max_radps=1e12))
    for _ in range(50):
        law.step(STRAIGHT, measured, True, 0.1)
    for value, (low, high) in zip(law.parameters, bounds(THETA), strict=True):
        assert low <= value <= high


def test_parameters_may_start_anywhere_within_their_bounds() -> None:
    for initial in (1.0 / SPREAD, SPREAD):
        law = parameters_of(Compensation, {"initial": initial})
        start = Adaptive(law, MODEL).parameters
        assert all(low <= th <= high for th, (low, high) in zip(start, bounds(THETA), strict=True))
        with pytest.raises(ScenarioError, match="initial"):
            parameters_of(Compensation, {"initial": initial**1.01})


def test_sideways_goes_like_ahead() -> None:
    law = Compensation(adapt=False)
    told = Adaptive(law, MODEL).step(Velocity(0.2, 0.0, 0.2), Velocity(0.1, 0.0, 0.1), True, 0.0)
    assert told.v == pytest.approx(told.u)


def test_a_robot_without_sideways_motion_is_told_none() -> None:
    law = Adaptive(Compensation(), MODEL)
    for _ in range(5):
        assert law.step(STRAIGHT, Velocity(0.1, 0.2), True, 0.1).v == 0.0


def test_options_are_refused() -> None:
    with pytest.raises(ValueError, match="options k: it takes none"):
        Adaptive(Compensation(options={"k": 1}), MODEL)
