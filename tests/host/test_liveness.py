"""What a node is told of who lives, over links that are cut and routers that die."""

import pytest

from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Partition
from maniple.core.time import SECOND
from maniple.host.liveness import ROUTER, Life, Liveness

CALM = FaultPlan(since_ns=0)
LEASE, SETTLE, GRACE = 2 * SECOND, SECOND // 4, 3 * SECOND


@pytest.fixture
def liveness() -> Liveness:
    made = Liveness("controller", LEASE, SETTLE, GRACE)
    made.heard(ROUTER, 1, True, 0)
    for robot in ("r1", "r2"):
        made.heard(robot, 1, True, 0)
    assert made.visible(CALM, 0) == [Life(ROUTER, 1, True), Life("r1", 1, True), Life("r2", 1, True)]
    return made


def ends(liveness: Liveness, plan: FaultPlan, until_s: float, step_s: float = 0.1) -> dict[str, float]:
    """When each node's life ends for the one that is told, s."""
    found = {}
    for k in range(round(until_s / step_s) + 1):
        for life in liveness.visible(plan, round(k * step_s * SECOND)):
            found[f"{life.node} {'lives' if life.alive else 'ends'}"] = k * step_s
    return found


def test_an_end_is_told_once_it_is_sure_that_it_is_not_the_link(liveness: Liveness) -> None:
    liveness.heard("r1", 1, False, 0)
    assert ends(liveness, CALM, 5) == {"r1 ends": pytest.approx(0.3)}


def test_when_the_router_goes_nobody_counts_as_gone(liveness: Liveness) -> None:
    for node in ("r1", "r2", ROUTER):
        liveness.heard(node, 1, False, 0)
    assert ends(liveness, CALM, 60) == {"router ends": pytest.approx(0.3)}


def test_when_the_router_is_back_who_does_not_come_back_with_it_is_gone(liveness: Liveness) -> None:
    for node in ("r1", "r2", ROUTER):
        liveness.heard(node, 1, False, 0)
    liveness.visible(CALM, SECOND)
    liveness.heard(ROUTER, 1, True, 10 * SECOND)
    liveness.heard("r2", 1, True, 11 * SECOND)
    told = [life for t in range(10, 20) for life in liveness.visible(CALM, t * SECOND)]
    assert told == [Life(ROUTER, 1, True), Life("r1", 1, False)]


def test_who_is_cut_off_counts_as_gone_after_the_lease_and_is_back_when_the_link_is(
    liveness: Liveness,
) -> None:
    plan = FaultPlan(since_ns=0, partitions=(Partition(groups=(("r2",),), at_s=1.0, for_s=5.0),))
    assert ends(liveness, plan, 10) == {"r2 ends": pytest.approx(3.0), "r2 lives": pytest.approx(6.0)}


def test_a_short_cut_is_not_noticed(liveness: Liveness) -> None:
    plan = FaultPlan(since_ns=0, partitions=(Partition(groups=(("r2",),), at_s=1.0, for_s=1.5),))
    assert ends(liveness, plan, 10) == {}


def test_nothing_new_is_learnt_over_a_cut_link(liveness: Liveness) -> None:
    plan = FaultPlan(since_ns=0, partitions=(Partition(groups=(("r2",),), at_s=0.0, for_s=4.0),))
    liveness.heard("r2", 1, False, 0)
    liveness.heard("r2", 2, True, SECOND)
    told = [(t, life) for t in range(8) for life in liveness.visible(plan, t * SECOND)]
    assert told == [(2, Life("r2", 1, False)), (4, Life("r2", 2, True))]


def test_nodes_on_one_computer_are_never_cut_off() -> None:
    liveness = Liveness("controller", LEASE, local=("r1", "controller"))
    liveness.heard("r1", 1, True, 0)
    liveness.visible(CALM, 0)
    plan = FaultPlan(since_ns=0, partitions=(Partition(groups=(("r1",),)),))
    assert ends(liveness, plan, 10) == {}


def test_lives_that_are_over_are_forgotten() -> None:
    liveness = Liveness("controller", LEASE)
    for life in range(1000):
        liveness.heard("r1", life, True, life)
        liveness.heard("r1", life, False, life)
        liveness.visible(CALM, life)
    assert not liveness._tokens
