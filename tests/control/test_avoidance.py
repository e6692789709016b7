import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from maniple.control import avoidance
from maniple.control.avoidance import REST, AvoidanceState, Force, Sides
from maniple.control.returns import Returns
from maniple.core.scenario.types import Avoidance, Impedance

PAPER = Avoidance()


def returns(*polar: tuple[float, float]) -> Returns:
    """Returns from (distance m, bearing degrees) pairs."""
    return Returns(
        np.array([p[0] for p in polar]), np.radians([p[1] for p in polar]).astype(np.float64), True, True
    )


def disc(distance: float, bearing_deg: float, radius: float) -> list[tuple[float, float]]:
    """What a laser of one beam a degree sees of a disc whose centre is at (distance, bearing)."""
    found = []
    for beam in range(-90, 91):
        off = math.radians(beam - bearing_deg)
        miss = distance * math.sin(off)
        if abs(miss) < radius and math.cos(off) > 0:
            found.append((distance * math.cos(off) - math.sqrt(radius**2 - miss**2), float(beam)))
    return found


def test_force_of_equations_9_and_10() -> None:
    largest = PAPER.b * (PAPER.d_max_m - PAPER.d_min_m) ** 2
    assert avoidance.force(PAPER, 0.95) == 0.0
    assert avoidance.force(PAPER, 2.0) == 0.0
    assert avoidance.force(PAPER, 0.75) == pytest.approx(0.04)
    assert avoidance.force(PAPER, 0.30) == pytest.approx(largest)
    assert avoidance.force(PAPER, 0.1) == pytest.approx(largest)


def test_no_force_without_returns_in_the_shell() -> None:
    assert avoidance.forces(PAPER, returns()) == avoidance.CALM
    assert avoidance.forces(PAPER, returns((0.96, 0.0), (3.0, 20.0))) == avoidance.CALM
    assert avoidance.forces(PAPER, returns((0.5, 120.0), (0.5, -91.0))) == avoidance.CALM


def test_sides_are_closed_where_the_paper_closes_them() -> None:
    assert avoidance.forces(PAPER, returns((0.5, 0.0))).right.force > 0.0
    assert avoidance.forces(PAPER, returns((0.5, -90.0))).right.force > 0.0
    assert avoidance.forces(PAPER, returns((0.5, 90.0))).left.force > 0.0
    assert avoidance.forces(PAPER, returns((0.5, 1.0))).right == avoidance.NO_FORCE


@pytest.mark.parametrize(
    ("bearing", "side"), [(0.0, "right"), (-20.0, "right"), (20.0, "left"), (3.0, "left")]
)
def test_one_object_counts_once_on_the_side_of_its_nearest_return(bearing: float, side: str) -> None:
    sides = avoidance.forces(PAPER, returns(*disc(0.7, bearing, 0.15)))
    other = sides.left if side == "right" else sides.right
    assert other == avoidance.NO_FORCE
    chosen = sides.right if side == "right" else sides.left
    assert chosen.force == pytest.approx(avoidance.force(PAPER, 0.55), rel=1e-3)
    assert math.degrees(chosen.bearing) == pytest.approx(bearing, abs=1e-6)


def test_return_by_return_an_object_ahead_counts_on_both_sides() -> None:
    printed = Avoidance(split="returns")
    sides = avoidance.forces(printed, returns(*disc(0.7, 0.0, 0.15)))
    assert sides.right.force == pytest.approx(sides.left.force, rel=0.02)


def test_objects_on_both_sides_count_each_and_the_nearer_of_a_side_wins() -> None:
    seen = [*disc(0.8, -60.0, 0.1), *disc(0.6, -20.0, 0.1), *disc(0.75, 40.0, 0.1)]
    sides = avoidance.forces(PAPER, returns(*seen))
    assert sides.right == pytest.approx(Force(avoidance.force(PAPER, 0.5), math.radians(-20.0)), rel=1e-3)
    assert sides.left == pytest.approx(Force(avoidance.force(PAPER, 0.65), math.radians(40.0)), rel=1e-3)


def test_where_the_fan_begins_does_not_part_an_object() -> None:
    seen = disc(0.7, 2.0, 0.15)
    front_first = sorted(seen, key=lambda pair: pair[1] % 360.0)
    assert avoidance.forces(PAPER, returns(*front_first)) == avoidance.forces(PAPER, returns(*seen))


def test_gap_decides_what_is_one_object() -> None:
    seen = returns((0.50, -10.0), (0.52, 12.0))
    assert avoidance.forces(PAPER, seen).left == avoidance.NO_FORCE
    assert avoidance.forces(Avoidance(gap_m=0.1), seen).left.force > 0.0


impedances = st.builds(
    Impedance,
    inertia=st.floats(0.05, 5.0),
    damping=st.floats(0.05, 10.0),
    stiffness=st.floats(0.05, 20.0),
)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(impedances, st.floats(0.001, 2.0), st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1))
def test_response_is_the_zero_order_hold_of_scipy(
    impedance: Impedance, dt: float, x: float, rate: float, load: float
) -> None:
    i, b, k = impedance.inertia, impedance.damping, impedance.stiffness
    system: Any = (
        np.array([[0, 1], [-k / i, -b / i]]),
        np.array([[0], [1 / i]]),
        np.eye(2),
        np.zeros((2, 1)),
    )
    phi, gamma, *_ = signal.cont2discrete(system, dt, method="zoh")
    expected = phi @ [x, rate] + gamma[:, 0] * load
    assert avoidance.respond(impedance, x, rate, load, dt) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("nudge", [-1e-9, 0.0, 1e-9])
def test_critical_damping(nudge: float) -> None:
    a11, a12, a21, a22 = avoidance.transition(1.0, 2.0 + nudge, 1.0, 0.7)
    fading = math.exp(-0.7)
    expected = [1.7 * fading, 0.7 * fading, -0.7 * fading, 0.3 * fading]
    assert (a11, a12, a21, a22) == pytest.approx(expected, abs=1e-8)


def test_stiff_and_long_steps_stay_finite() -> None:
    assert avoidance.transition(1e-3, 1e3, 1.0, 1e4) == pytest.approx((math.exp(-10), 0, 0, 0), abs=1e-6)


def test_two_half_steps_are_one_step() -> None:
    sides = Sides(Force(0.3, -0.4), Force(0.1, 0.8))
    state = AvoidanceState(0.01, 0.02, -0.1, 0.3)
    once = avoidance.step(PAPER, state, sides, 0.1)
    twice = avoidance.step(PAPER, avoidance.step(PAPER, state, sides, 0.04), sides, 0.06)
    assert twice == pytest.approx(once, abs=1e-12)


def test_settles_where_the_springs_balance_the_forces() -> None:
    sides = Sides(Force(0.3, -0.4), Force(0.1, 0.8))
    state = avoidance.step(PAPER, REST, sides, 1e3)
    linear = 0.3 * math.cos(0.4) + 0.1 * math.cos(0.8)
    assert state == pytest.approx((linear / 10.0, 0.0, 0.2 / 0.65, 0.0), abs=1e-12)
    printed = avoidance.step(Avoidance(form="sin"), REST, sides, 1e3)
    assert printed.u_cor == pytest.approx((0.1 * math.sin(0.8) - 0.3 * math.sin(0.4)) / 10.0)


def test_rest_without_force_stays_rest() -> None:
    assert avoidance.step(PAPER, REST, avoidance.CALM, 0.1) is REST
