import math

import pytest

from central_controller.reference import REST, duration_s, reference
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Line

LINE = Line(start=(1.0, 2.0), end=(4.0, 6.0), speed_mps=0.5, settle_s=3.0)
HEADING = math.atan2(4.0, 3.0)


def test_duration_is_the_way_and_the_rest() -> None:
    assert duration_s(LINE) == pytest.approx(13.0)


@pytest.mark.parametrize("t_s", [-5.0, -1e-9])
def test_before_the_start_it_waits_there(t_s: float) -> None:
    assert reference(LINE, t_s) == (Pose(1.0, 2.0, HEADING), REST)


@pytest.mark.parametrize("t_s", [10.0, 12.0, 1e9])
def test_at_the_end_it_stays_there(t_s: float) -> None:
    assert reference(LINE, t_s) == (Pose(4.0, 6.0, HEADING), REST)


@pytest.mark.parametrize("t_s", [0.0, 2.0, 5.0, 9.999])
def test_on_the_way_it_moves_at_constant_velocity(t_s: float) -> None:
    pose, velocity = reference(LINE, t_s)
    assert pose == pytest.approx((1.0 + 0.3 * t_s, 2.0 + 0.4 * t_s, HEADING))
    assert velocity == pytest.approx((0.3, 0.4, 0.0))


def test_it_arrives_where_it_stays() -> None:
    assert reference(LINE, 10.0 - 1e-9).pose == pytest.approx(reference(LINE, 10.0).pose, abs=1e-8)


def test_a_line_of_no_length_is_a_place_to_hold() -> None:
    hold = Line(start=(1.0, 2.0), end=(1.0, 2.0), speed_mps=0.5, settle_s=3.0)
    assert duration_s(hold) == 3.0
    assert reference(hold, 1.0) == (Pose(1.0, 2.0, 0.0), REST)
