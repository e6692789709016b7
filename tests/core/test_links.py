import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.links import Link
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Fault

LINK = ("r1", "controller", "robot/r1/odometry")


def link(*plan: Fault, seed: int = 1, source: str = LINK[0]) -> Link:
    return Link(FaultPlan(since_ns=0, faults=plan), seed, source, LINK[1], LINK[2])


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.permutations([(i, s) for i in (1, 2) for s in range(5)]))
def test_decisions_do_not_depend_on_the_order_messages_come_in(order: list[tuple[int, int]]) -> None:
    plan = Fault(loss=0.5, latency_s=0.1, jitter_s=0.05)
    one, other = link(plan), link(plan)
    decided = {key: one.decide(*key, 0, 100) for key in order}
    assert decided == {key: other.decide(*key, 0, 100) for key in sorted(order)}


def test_loss_has_the_rate_asked_for_and_no_memory() -> None:
    plan = link(Fault(loss=0.3))
    lost = np.array([plan.decide(1, seq, 0, 100).dropped for seq in range(20_000)])
    assert lost.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / lost.size))
    assert np.corrcoef(lost[1:], lost[:-1])[0, 1] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize(("loss", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_loss_of_none_and_of_all_is_exact(loss: float, share: float) -> None:
    plan = link(Fault(loss=loss))
    assert np.mean([plan.decide(1, seq, 0, 100).dropped for seq in range(1000)]) == share


def test_jitter_is_even_around_the_latency() -> None:
    plan = link(Fault(latency_s=0.1, jitter_s=0.05))
    delays = np.array([plan.decide(1, seq, 0, 100).delay for seq in range(20_000)]) * 1e-9
    assert 0.05 <= delays.min() < 0.051
    assert 0.149 < delays.max() <= 0.15
    assert delays.mean() == pytest.approx(0.1, abs=0.001)
    assert delays.std() == pytest.approx(0.1 / math.sqrt(12), abs=0.001)


def test_delay_is_independent_of_loss_and_never_negative() -> None:
    plan = link(Fault(loss=0.5, jitter_s=0.01))
    decisions = [plan.decide(1, seq, 0, 100) for seq in range(5000)]
    assert min(decision.delay for decision in decisions) == 0
    delays = np.array([decision.delay for decision in decisions])
    lost = np.array([decision.dropped for decision in decisions])
    assert np.corrcoef(delays, lost)[0, 1] == pytest.approx(0.0, abs=0.05)


def test_rules_add_up() -> None:
    plan = link(Fault(latency_s=0.1, loss=0.2), Fault(latency_s=0.03, loss=0.5))
    decisions = [plan.decide(1, seq, 0, 100) for seq in range(20_000)]
    assert {decision.delay for decision in decisions} == {130_000_000}
    assert np.mean([decision.dropped for decision in decisions]) == pytest.approx(0.6, abs=0.015)


def test_links_incarnations_and_seeds_are_independent() -> None:
    plan = Fault(loss=0.5)
    links = [link(plan), link(plan, seed=2), link(plan, source="r2")]
    series = [[one.decide(1, seq, 0, 100).dropped for seq in range(4000)] for one in links]
    series.append([links[0].decide(2, seq, 0, 100).dropped for seq in range(4000)])
    for one, other in itertools.combinations(series, 2):
        assert np.corrcoef(one, other)[0, 1] == pytest.approx(0.0, abs=0.06)


def test_a_rule_that_does_not_match_changes_nothing_for_others() -> None:
    """The draw of a rule depends on its place in the plan, not on which others match."""
    mine = Fault(loss=0.5)
    alone = [link(Fault(source="r9"), mine).decide(1, seq, 0, 100) for seq in range(100)]
    beside = [link(Fault(source="r1", latency_s=0.0), mine).decide(1, seq, 0, 100) for seq in range(100)]
    assert alone == beside


def test_without_a_rule_nothing_happens() -> None:
    assert link().decide(1, 0, 0, 100) == ("", 0, None, False)
    assert not link()


def test_decisions_stay_what_they_were() -> None:
    """The same messages are lost in every version: these are of the first."""
    plan = link(Fault(latency_s=0.1, jitter_s=0.05, loss=0.3), seed=7)
    assert [plan.decide(1, seq, 0, 100)[:2] for seq in range(4)] == [
        ("loss", 129219449),
        ("", 95672293),
        ("", 117883412),
        ("", 62691985),
    ]
