"""Changes of a fault plan that runs."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maniple.core import codec, plans, topics
from maniple.core.faults import matches
from maniple.core.messages import FaultPlan
from maniple.core.plans import BLANK
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition
from maniple.core.time import SECOND

SINCE = 100 * SECOND
A, B, C = (Fault(source=name, loss=0.5) for name in ("r1", "r2", "r3"))


def plan(**parts: object) -> FaultPlan:
    return FaultPlan(since_ns=SINCE, **parts)  # type: ignore[arg-type]


def test_a_first_plan_counts_from_the_full_second() -> None:
    now = 7 * SECOND + 654_321_000
    made = plans.begun(None, now)
    assert made == FaultPlan(since_ns=7 * SECOND)
    assert plans.begun(made, now + SECOND) is made
    assert plans.elapsed_s(made, now) == 0.654


@pytest.mark.parametrize(
    ("at_s", "for_s", "now_s", "stage"),
    [
        (5, 2, 4.999, "to come"),
        (5, 2, 5, "running"),
        (5, 2, 6.999, "running"),
        (5, 2, 7, "over"),
        (5, None, 1e9, "running"),
    ],
)
def test_stages(at_s: float, for_s: float | None, now_s: float, stage: str) -> None:
    assert plans.stage(at_s, for_s, now_s) == stage


@pytest.mark.parametrize(
    ("now_s", "stage"), [(0, "to come"), (1, "running"), (2, "to come"), (3, "running"), (4, "over")]
)
def test_a_rule_with_windows_goes_on_and_off(now_s: float, stage: str) -> None:
    assert plans.rule_stage(Fault(windows=((1, 2), (3, 4))), now_s) == stage
    assert plans.rule_stage(Fault(), now_s) == "running"


def test_a_blank_matches_no_link_and_survives_the_wire() -> None:
    assert not matches(BLANK, "r1", "controller", "robot/r1/odometry")
    sent = plan(faults=(BLANK, A))
    assert codec.decode(topics.PLAN, codec.encode(sent)) == sent


def test_a_rule_that_goes_leaves_its_place_to_the_next_new_one() -> None:
    three = plan(faults=(A, B, C))
    two = plans.without_rules(three, [1])
    assert two.faults == (A, BLANK, C)
    assert plans.numbered(two) == {0: A, 2: C}
    assert plans.with_rule(two, Fault(source="r4")).faults == (A, Fault(source="r4"), C)
    assert plans.without_rules(two, [2]).faults == (A,)


def test_a_rule_for_the_same_link_is_replaced_where_it_is() -> None:
    better = Fault(source="r2", loss=0.1)
    assert plans.with_rule(plan(faults=(A, B, C)), better).faults == (A, better, C)
    assert plans.with_rule(plan(faults=(A, B, C)), better, add=True).faults == (A, B, C, better)
    both = plan(faults=(B, A, Fault(source="r2", latency_s=1.0)))
    assert plans.with_rule(both, better).faults == (better, A)
    other_topic = Fault(source="r2", topic="robot/*/status")
    assert plans.with_rule(plan(faults=(B,)), other_topic).faults == (B, other_topic)


def test_what_is_over_is_pruned() -> None:
    over, on = Fault(windows=((1, 2),)), Fault(windows=((1, 2), (30, 40)))
    groups = (("r1",), ("r2",))
    full = plan(
        faults=(over, on, A, over),
        partitions=(Partition(groups=groups, at_s=1, for_s=2), Partition(groups=groups, at_s=3)),
        crashes=(Crash(node="r1", at_s=1), Crash(node="r2", at_s=2, restart_after_s=3)),
        freezes=(Freeze(node="r1", at_s=1, for_s=2), Freeze(node="r2", at_s=9, for_s=2)),
    )
    left = plans.pruned(full, SINCE + 10 * SECOND)
    assert left.faults == (BLANK, on, A)
    assert left.partitions == full.partitions[1:]
    assert left.crashes == full.crashes[:1]
    assert left.freezes == full.freezes[1:]
    assert plans.pruned(full, SINCE) == full


def test_fates() -> None:
    made = plans.with_crash(plan(), Crash(node="r1", at_s=1))
    made = plans.with_freeze(made, Freeze(node="r2", at_s=1, for_s=2))
    assert plans.without_fate(made, "r2").freezes == ()
    assert plans.without_fate(made, "r2").crashes == made.crashes
    assert plans.without_fate(made, "r1").crashes == ()
    assert plans.emptied(made) == plan()


Step = Callable[[FaultPlan, float], FaultPlan]
"""Changes a plan; the number goes into what it adds, so that every rule is another."""
sources = st.sampled_from(["r1", "r2", "r3", "*"])
steps: st.SearchStrategy[Step] = st.one_of(
    st.tuples(sources, st.booleans()).map(
        lambda args: lambda one, mark: plans.with_rule(one, Fault(source=args[0], latency_s=mark), args[1])
    ),
    st.sets(st.integers(0, 6)).map(lambda numbers: lambda one, _: plans.without_rules(one, numbers)),
)


@given(st.lists(steps, max_size=20))
def test_whatever_is_changed_a_rule_that_stays_keeps_its_number(changes: list[Step]) -> None:
    made = plan()
    for mark, change in enumerate(changes):
        before, made = made, change(made, mark)
        assert not made.faults or made.faults[-1] != BLANK
        numbers = {rule: number for number, rule in plans.numbered(made).items()}
        for number, rule in plans.numbered(before).items():
            assert numbers.get(rule, number) == number
