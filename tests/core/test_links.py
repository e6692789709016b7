import itertools
import math
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.core.links import Link, RateQueue
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Burst, Fault, Partition

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


# -- bursts, copies, reordering, corruption


EVERYTHING = Fault(
    latency_s=0.1,
    jitter_s=0.05,
    loss=0.1,
    burst=Burst(enter=0.05, leave=0.3),
    duplicate=0.2,
    reorder=0.15,
    reorder_s=0.4,
    corrupt=0.25,
)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(
    st.permutations([(life, seq) for life in (1, 2) for seq in range(12)]),
    st.lists(st.integers(0, 2**61), min_size=24, max_size=24),
    st.integers(0, 10_000),
)
def test_neither_order_nor_timing_nor_size_decides(
    order: list[tuple[int, int]], stamps: list[int], size: int
) -> None:
    one, other = link(EVERYTHING), link(EVERYTHING)
    decided = {key: one.decide(*key, stamp, size) for key, stamp in zip(order, stamps, strict=True)}
    assert decided == {key: other.decide(*key, 0, 100) for key in sorted(order)}


def test_rules_that_are_added_change_no_draw_of_those_before() -> None:
    alone, more = link(EVERYTHING), link(EVERYTHING, Fault(loss=0.5, latency_s=1.0))
    for seq in range(500):
        before, after = alone.decide(1, seq, 0, 100), more.decide(1, seq, 0, 100)
        assert after.delay == before.delay + 1_000_000_000
        assert after.dropped or not before.dropped
        assert (after.corrupted, after.copy_delay is None) == (before.corrupted, before.copy_delay is None)


def test_shares_are_as_injected() -> None:
    """Binomial counts, within 4.5 standard deviations, and each independent of the others."""
    plan, count = link(EVERYTHING), 20_000
    decisions = [plan.decide(1, seq, 0, 100) for seq in range(count)]
    passed = np.array([not decision.dropped for decision in decisions])
    held = np.array([decision.delay >= 450_000_000 for decision in decisions])
    seen = {
        0.1: np.array([decision.cause == "loss" for decision in decisions]),
        0.2: np.array([decision.copy_delay is not None for decision in decisions]),
        0.15: held,
        0.25: np.array([decision.corrupted for decision in decisions]),
    }
    for share, found in seen.items():
        assert abs(found.sum() - count * share) <= 4.5 * math.sqrt(count * share * (1.0 - share))
    for one, other in itertools.combinations([*seen.values()][1:], 2):
        assert np.corrcoef(one, other)[0, 1] == pytest.approx(0.0, abs=0.03)
    assert passed.mean() == pytest.approx(0.9 * (1.0 - 0.05 / 0.35), abs=0.015)


def test_losses_of_a_burst_are_told_apart_and_run_as_the_chain_does() -> None:
    plan = link(Fault(burst=Burst(enter=0.02, leave=0.25, loss_good=0.0, loss_bad=1.0)))
    lost = np.array([plan.decide(1, seq, 0, 100).cause == "burst" for seq in range(40_000)])
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate(([False], lost, [False])))))[::2]
    assert lost.mean() == pytest.approx(0.02 / 0.27, abs=0.006)
    assert runs.mean() == pytest.approx(4.0, abs=4.5 * math.sqrt(0.75) / 0.25 / math.sqrt(len(runs)))


def test_both_states_of_a_burst_may_lose_some() -> None:
    plan = link(Fault(burst=Burst(enter=0.2, leave=0.2, loss_good=0.1, loss_bad=0.6)))
    lost = np.mean([plan.decide(1, seq, 0, 100).dropped for seq in range(40_000)])
    assert lost == pytest.approx(0.35, abs=0.015)


def test_a_copy_has_a_delay_of_its_own() -> None:
    plan = link(Fault(latency_s=0.1, jitter_s=0.05, duplicate=1.0))
    decisions = [plan.decide(1, seq, 0, 100) for seq in range(8000)]
    first = np.array([decision.delay for decision in decisions]) * 1e-9
    second = np.array([decision.copy_delay or 0 for decision in decisions]) * 1e-9
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0.0, abs=0.05)
    for delays in (first, second):
        counts, _ = np.histogram(delays, bins=20, range=(0.05, 0.15))
        assert counts.sum() == 8000
        assert ((counts - 400.0) ** 2 / 400.0).sum() < 45.0  # the 0.07 % point with 19 degrees of freedom


def test_one_to_eight_bits_are_flipped_and_the_crc_tells() -> None:
    plan, data = link(EVERYTHING), bytes(range(200))
    counts = set()
    for seq in range(300):
        flipped = plan.flipped(1, seq, data)
        assert plan.flipped(1, seq, data) == flipped
        assert zlib.crc32(flipped) != zlib.crc32(data)
        counts.add(sum((a ^ b).bit_count() for a, b in zip(data, flipped, strict=True)))
    assert counts == set(range(1, 9))
    assert 1 <= int.from_bytes(plan.flipped(1, 0, b"\0")).bit_count() <= 8


# -- windows and partitions


def test_a_rule_is_on_in_its_windows_by_when_a_message_was_sent() -> None:
    plan = link(Fault(loss=1.0, windows=((1.0, 2.0), (5.0, 6.0))))
    lost = [t for t in range(0, 70, 5) if plan.decide(1, t, t * 100_000_000, 100).dropped]
    assert lost == [10, 15, 50, 55]


def test_a_window_changes_no_draw() -> None:
    always, later = link(EVERYTHING), link(replace(EVERYTHING, windows=((1.0, 2.0),)))
    for seq in range(100):
        assert later.decide(1, seq, 1_500_000_000, 100) == always.decide(1, seq, 0, 100)
        assert later.decide(1, seq, 2_000_000_000, 100) == ("", 0, None, False)


def test_a_partition_lets_nothing_through() -> None:
    parted = FaultPlan(
        since_ns=0,
        faults=(Fault(latency_s=0.1),),
        partitions=(Partition(groups=(("r1",),), at_s=1.0, for_s=1.0),),
    )
    there, between = Link(parted, 1, *LINK), Link(parted, 1, "r2", LINK[1], "robot/r2/odometry")
    assert [there.decide(1, 0, t, 100)[:2] for t in (0, 10**9, 2 * 10**9)] == [
        ("", 100_000_000),
        ("cut", 0),
        ("", 100_000_000),
    ]
    assert between.decide(1, 0, 10**9, 100)[:2] == ("", 100_000_000)


# -- the rate limit

LIMITED = Fault(rate_kbps=80.0, queue_s=0.5)
"""10 bytes a millisecond."""


def test_below_the_rate_each_message_takes_its_time_and_none_waits() -> None:
    plan = link(LIMITED)
    for seq in range(50):
        assert plan.decide(1, seq, seq * 20_000_000, 200)[:2] == ("", 20_000_000)


def test_above_the_rate_the_queue_fills_and_then_carries_the_rate() -> None:
    """Sent at twice the rate: message k waits for k/2 of its own time until the queue is full; from there on
    every other one gets through."""
    plan, took = link(LIMITED), 20_000_000
    decisions = [plan.decide(1, seq, seq * took // 2, 200) for seq in range(1000)]
    fills = 0
    while not decisions[fills].dropped:
        assert decisions[fills].delay == took + fills * took // 2
        fills += 1
    assert fills == 1 + round(0.5e9) // (took // 2)
    later = decisions[fills:]
    assert {decision.cause for decision in later} == {"", "rate"}
    assert sum(not decision.dropped for decision in later) == pytest.approx(len(later) / 2, abs=1)
    assert max(decision.delay for decision in later if not decision.dropped) <= 500_000_000 + took


def test_all_topics_of_a_source_share_a_link_and_no_other_source_does() -> None:
    plan, queues = FaultPlan(since_ns=0, faults=(LIMITED,)), dict[tuple[int, str], RateQueue]()
    links = [
        Link(plan, 1, "r1", "controller", topic, queues) for topic in ("robot/r1/odometry", "robot/r1/ranges")
    ]
    other = Link(plan, 1, "r2", "controller", "robot/r2/odometry", queues)
    assert [one.decide(1, 0, 0, 1000).delay for one in (*links, other)] == [10**8, 2 * 10**8, 10**8]


def test_a_forged_stamp_blocks_no_link() -> None:
    plan = link(LIMITED)
    plan.decide(1, 0, 0, 200)
    plan.decide(1, 2**61, 2**61, 200)
    assert plan.decide(1, 1, 20_000_000, 200)[:2] == ("", 20_000_000)
