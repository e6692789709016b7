"""Obstacle avoidance over time against SciPy: linear simulation of the transfer functions, an ODE solver."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import signal
from scipy.integrate import solve_ivp

from maniple.control import avoidance
from maniple.control.avoidance import REST, Force, Sides
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Avoidance, Impedance

DT_S = 0.1


def scans(count: int) -> list[Sides]:
    """What a robot feels at 10 Hz on its way past things: nothing, one side, both."""
    rng = np.random.default_rng(2)
    out = []
    for k in range(count):
        right, left = rng.uniform(0.0, 0.4225, 2) * (np.array([k, k + 9]) // 12 % 2)
        out.append(
            Sides(
                Force(float(right), float(rng.uniform(-0.5 * math.pi, 0.0))),
                Force(float(left), float(rng.uniform(0.0, 0.5 * math.pi))),
            )
        )
    return out


def corrections(parameters: Avoidance, sides: list[Sides]) -> Floats:
    """(u_cor, w_cor) after each scan, (k, 2)."""
    state, out = REST, []
    for each in sides:
        state = avoidance.step(parameters, state, each, DT_S)
        out.append((state.u_cor, state.w_cor))
    return np.array(out)


@pytest.mark.parametrize("form", ["cos", "sin"])
def test_both_impedances_are_the_linear_simulation_of_scipy(form: str) -> None:
    """Z_u^-1 and Z_w^-1 as transfer functions, the forces held between scans."""
    parameters = Avoidance(form="cos" if form == "cos" else "sin")
    sides = scans(150)
    shape = np.cos if form == "cos" else np.sin
    along = [r.force * shape(r.bearing) + left.force * shape(left.bearing) for r, left in sides]
    turning = [r.force - left.force for r, left in sides]
    got = corrections(parameters, sides)
    times = DT_S * np.arange(len(sides) + 1)
    for column, impedance, load in ((0, parameters.linear, along), (1, parameters.angular, turning)):
        _, expected, _ = signal.lsim(transfer(impedance), [*load, 0.0], times, interp=False)
        assert np.abs(expected).max() > 1e-3
        assert_allclose(got[:, column], expected[1:], atol=1e-10)


def transfer(impedance: Impedance) -> signal.TransferFunction:
    return signal.TransferFunction([1.0], [impedance.inertia, impedance.damping, impedance.stiffness])


def test_a_steady_force_is_answered_as_an_ode_solver_has_it() -> None:
    """Eqs. (13) and (14) with the paper's parameters, from rest, over ten seconds."""
    sides = Sides(Force(0.2, -0.6), Force(0.05, 1.1))
    parameters = Avoidance()

    def slope(_t: float, z: Floats) -> list[float]:
        u, du, w, dw = z
        along = 0.2 * math.cos(0.6) + 0.05 * math.cos(1.1)
        return [du, (along - 5.6 * du - 10.0 * u) / 0.4, dw, (0.15 - 1.4 * dw - 0.65 * w) / 0.2]

    got = corrections(parameters, [sides] * 100)
    times = DT_S * np.arange(1, 101)
    expected = solve_ivp(slope, (0.0, 10.0), [0.0] * 4, "Radau", times, rtol=1e-10, atol=1e-12).y
    assert_allclose(got, expected[[0, 2]].T, atol=1e-8)


def test_the_angular_correction_takes_about_two_seconds() -> None:
    """The slow pole of I s^2 + B s + K with the paper's figures."""
    angular = Avoidance().angular
    slow = np.roots([angular.inertia, angular.damping, angular.stiffness]).real.max()
    assert -1.0 / slow == pytest.approx(2.0)
    settled = 0.4225 / angular.stiffness
    got = corrections(Avoidance(), [Sides(Force(0.4225, 0.0), avoidance.NO_FORCE)] * 20)[-1, 1]
    assert 0.5 * settled < got < 0.65 * settled
