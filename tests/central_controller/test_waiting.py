import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from central_controller.waiting import rate
from maniple.core.scenario.types import Waiting

WAIT = Waiting(enabled=True, free_m=0.2, stop_m=0.6)


@pytest.mark.parametrize(
    ("error_m", "expected"),
    [(0.0, 1.0), (0.2, 1.0), (0.3, 0.75), (0.4, 0.5), (0.6, 0.0), (5.0, 0.0), (math.inf, 0.0)],
)
def test_the_reference_slows_evenly_between_the_two_errors(error_m: float, expected: float) -> None:
    assert rate(WAIT, error_m) == pytest.approx(expected)


@given(error_m=st.floats(0, 100), more_m=st.floats(0, 100))
def test_a_larger_error_never_makes_it_faster(error_m: float, more_m: float) -> None:
    assert 0.0 <= rate(WAIT, error_m + more_m) <= rate(WAIT, error_m) <= 1.0


@pytest.mark.parametrize("error_m", [0.0, 0.4, 100.0])
def test_nobody_is_waited_for_by_default(error_m: float) -> None:
    assert rate(Waiting(), error_m) == 1.0
