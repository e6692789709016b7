from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core import time


@settings(deadline=None, derandomize=True, max_examples=100)
@given(st.integers(min_value=-(10**15), max_value=10**15))
def test_seconds_round_trip(duration: int) -> None:
    assert time.from_seconds(time.to_seconds(duration)) == duration


def test_spans_go_to_the_nearest_nanosecond() -> None:
    assert time.from_seconds(0.1) == 100_000_000
    assert time.from_seconds(1e-9 * 0.6) == 1
    assert time.period(30.0) == 33_333_333
    assert time.period(20.0) * 20 == time.SECOND
    assert 1000 * time.MILLISECOND == time.SECOND
