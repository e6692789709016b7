import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from central_controller.reference import REST, Course, reached
from maniple.core.geometry import Pose
from maniple.core.scenario.types import (
    Controller,
    Line,
    Orbit,
    Positioning,
    Samples,
    Sequence,
)

LINE = Line(start=(1.0, 2.0), end=(4.0, 6.0), speed_mps=0.5, settle_s=3.0)
HEADING = math.atan2(4.0, 3.0)
STAND = Positioning(target=(1.0, 2.0, 0.5), tolerance_m=0.1, tolerance_rad=0.2, settle_s=2.0)


def test_duration_is_the_way_and_the_rest() -> None:
    assert Course(LINE).duration_s(0) == pytest.approx(13.0)
    assert Course(LINE).total_s == Course(LINE).duration_s(0)
    assert Course(LINE).legs == 1


@pytest.mark.parametrize("t_s", [-5.0, -1e-9])
def test_before_the_start_it_waits_there(t_s: float) -> None:
    assert Course(LINE).at(0, t_s) == (Pose(1.0, 2.0, HEADING), REST)


@pytest.mark.parametrize("t_s", [10.0, 12.0, 1e9])
def test_at_the_end_it_stays_there(t_s: float) -> None:
    pose, velocity = Course(LINE).at(0, t_s)
    assert pose == pytest.approx((4.0, 6.0, HEADING))
    assert velocity == REST


@pytest.mark.parametrize("t_s", [0.0, 2.0, 5.0, 9.999])
def test_on_the_way_it_moves_at_constant_velocity(t_s: float) -> None:
    pose, velocity = Course(LINE).at(0, t_s)
    assert pose == pytest.approx((1.0 + 0.3 * t_s, 2.0 + 0.4 * t_s, HEADING))
    assert velocity == pytest.approx((0.3, 0.4, 0.0))


def test_it_arrives_where_it_stays() -> None:
    for task in (LINE, Orbit(centre=(0, 0), radius_m=2, speed_mps=0.3, turns=0.7)):
        course = Course(task)
        end_s = course.duration_s(0) - task.settle_s
        assert course.at(0, end_s - 1e-9).pose == pytest.approx(course.at(0, end_s).pose, abs=1e-8)


def test_a_line_of_no_length_is_a_place_to_hold() -> None:
    hold = Course(Line(start=(1.0, 2.0), end=(1.0, 2.0), speed_mps=0.5, settle_s=3.0))
    assert hold.total_s == 3.0
    assert hold.at(0, 1.0) == (Pose(1.0, 2.0, 0.0), REST)


def test_the_legs_of_a_sequence_have_their_own_time() -> None:
    samples = Samples(times_s=(0.0, 4.0), poses=((4.0, 6.0, 0.0), (8.0, 6.0, 0.0)), settle_s=1.0)
    course = Course(Sequence(tasks=(LINE, STAND, samples)))
    assert course.legs == 3
    assert course.at(2, 1.0).pose == pytest.approx((5.0, 6.0, 0.0))
    assert course.at(2, 1.0).velocity == pytest.approx((1.0, 0.0, 0.0))
    assert course.duration_s(2) == 5.0
    assert course.total_s == pytest.approx(13.0 + course.duration_s(1) + 5.0)
    assert [course.positioning(leg) for leg in range(3)] == [None, STAND, None]


# -- positioning


@pytest.mark.parametrize("t_s", [-1.0, 0.0, 5.0, 1e6])
def test_a_position_to_take_up_does_not_move(t_s: float) -> None:
    assert Course(STAND).at(0, t_s) == (Pose(1.0, 2.0, 0.5), REST)


@pytest.mark.parametrize(("kappa", "saturation"), [(0.25, 0.1), (0.12, 0.2), (1.0, 0.05)])
def test_how_long_taking_it_up_takes_is_the_solution_of_the_law(kappa: float, saturation: float) -> None:
    def within(t: float, e: Any) -> float:
        return float(e[0] - STAND.tolerance_m)

    within.terminal = True  # type: ignore[attr-defined]
    solved = solve_ivp(
        lambda t, e: -saturation * np.tanh(kappa * e / saturation),
        (0.0, 1e4),
        [math.hypot(1.0, 2.0)],
        events=within,
        rtol=1e-10,
        atol=1e-12,
    )
    course = Course(STAND, Controller(kappa=kappa, saturation=saturation))
    assert course.duration_s(0) == pytest.approx(solved.t_events[0][0] + STAND.settle_s, rel=1e-6)


def test_a_position_that_is_far_away_takes_long_but_not_for_ever() -> None:
    far = Positioning(target=(9000.0, 0.0, 0.0))
    assert Course(far).total_s == pytest.approx(9000.0 / 0.1, rel=1e-3)


GOOD = np.array([0.1, -0.1, 0.2, 0.1, -0.1, -0.2])


def test_within_all_tolerances_it_is_reached() -> None:
    assert reached(STAND, np.tile(GOOD, (4, 1)))


@pytest.mark.parametrize("column", range(6))
@pytest.mark.parametrize("wrong", [0.201, -0.201, math.nan])
def test_one_error_is_enough_not_to_have_reached_it(column: int, wrong: float) -> None:
    errors = np.tile(GOOD, (4, 1))
    errors[2, column] = wrong
    assert not reached(STAND, errors)


def test_without_triangles_nothing_is_reached() -> None:
    assert not reached(STAND, np.zeros((0, 6)))


@settings(deadline=None, derandomize=True)
@given(t_s=st.floats(-10, 60))
def test_the_reference_is_always_finite_and_near(t_s: float) -> None:
    reference = Course(Orbit(centre=(1, 0), radius_m=2, speed_mps=0.5, settle_s=3)).at(0, t_s)
    assert math.dist(reference.pose[:2], (1, 0)) == pytest.approx(2)
    assert math.hypot(*reference.velocity[:2]) in (0.0, pytest.approx(0.5))
