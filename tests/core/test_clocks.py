from hypothesis import given
from hypothesis import strategies as st

from maniple.core.clocks import NodeClock, node_clock
from maniple.core.scenario.types import ClockError
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from tests.host.nodes import scenario_with

EPOCH = VIRTUAL_EPOCH
TIMES = st.integers(EPOCH - 10**6 * SECOND, EPOCH + 10**6 * SECOND)
CLOCKS = st.builds(
    NodeClock, st.just(EPOCH), st.integers(-(10**6) * SECOND, 10**6 * SECOND), st.floats(-10_000, 10_000)
)


@given(CLOCKS, TIMES)
def test_true_is_the_inverse_of_shown(clock: NodeClock, true: int) -> None:
    assert abs(clock.true(clock.shown(true)) - true) <= 1


@given(CLOCKS, TIMES, st.integers(0, 10**6))
def test_no_clock_goes_backwards(clock: NodeClock, true: int, span: int) -> None:
    assert clock.shown(true) <= clock.shown(true + span)
    assert clock.true(true) <= clock.true(true + span)


def test_offset_and_skew_mean_what_they_say() -> None:
    clock = NodeClock(EPOCH, 2 * SECOND, 100.0)
    assert clock.shown(EPOCH) == EPOCH + 2 * SECOND
    assert clock.shown(EPOCH + 10_000 * SECOND) == EPOCH + 10_003 * SECOND
    assert clock.true(EPOCH + 10_003 * SECOND) == EPOCH + 10_000 * SECOND


def test_a_clock_that_is_right_changes_nothing() -> None:
    clock = NodeClock(EPOCH)
    assert clock.shown(2**61) == clock.true(2**61) == 2**61


def test_each_node_has_the_clock_of_the_scenario() -> None:
    scenario = scenario_with(clocks=(ClockError(node="r1", offset_s=-1.5, skew_ppm=20.0),))
    assert node_clock(scenario, "r1", 7) == NodeClock(7, -1_500_000_000, 20.0)
    assert node_clock(scenario, "controller", 7) == NodeClock(7)
