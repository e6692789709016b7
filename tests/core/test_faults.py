from typing import Any

import pytest

from maniple.core.faults import (
    NEVER,
    back_at,
    crash_between,
    cut,
    dead,
    dies_by,
    freeze_between,
    matches,
    next_change,
    plan_of,
)
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Controller, Crash, Fault, Freeze, Partition
from maniple.core.time import SECOND
from tests.host.nodes import scenario_with

LINK = ("r1", "controller", "robot/r1/odometry")
SINCE = 1_000 * SECOND


def plan(since: int = SINCE, **parts: Any) -> FaultPlan:
    return FaultPlan(since_ns=since, **parts)


def at(seconds: float) -> int:
    return SINCE + round(seconds * SECOND)


@pytest.mark.parametrize(
    ("rule", "applies"),
    [
        (Fault(), True),
        (Fault(source="r1"), True),
        (Fault(source="r[23]"), False),
        (Fault(source="r?", destination="c*"), True),
        (Fault(topic="robot/*/odometry"), True),
        (Fault(topic="robot/*/command"), False),
        (Fault(source="R1"), False),
        (Fault(source="", destination="", topic=""), False),
    ],
)
def test_rules_match_as_file_names_do(rule: Fault, applies: bool) -> None:
    assert matches(rule, *LINK) is applies


def test_the_plan_of_a_scenario_is_all_that_it_injects() -> None:
    parts: dict[str, Any] = {
        "faults": (Fault(loss=0.1),),
        "partitions": (Partition(groups=(("r1",),)),),
        "crashes": (Crash(node="r1", at_s=1.0),),
        "freezes": (Freeze(node="r1", at_s=1.0, for_s=1.0),),
    }
    assert plan_of(scenario_with(**parts), 5) == FaultPlan(since_ns=5, **parts)


@pytest.mark.parametrize(
    ("groups", "one", "other", "apart"),
    [
        ((("r1",),), "r1", "controller", True),
        ((("r1",),), "controller", "r1", True),
        ((("r1",),), "r2", "controller", False),
        ((("r1", "r2"),), "r1", "r2", False),
        ((("r[12]",), ("r3", "controller")), "r2", "r3", True),
        ((("r[12]",), ("r3", "controller")), "r3", "controller", False),
        ((("r[12]",), ("r3", "controller")), "r4", "controller", True),
        ((("r[12]",), ("r3", "controller")), "r4", "r5", False),
    ],
)
def test_a_partition_is_between_groups_and_the_rest_is_one(
    groups: tuple[tuple[str, ...], ...], one: str, other: str, apart: bool
) -> None:
    assert cut(plan(partitions=(Partition(groups=groups),)), one, other, at(0)) is apart


@pytest.mark.parametrize(("seconds", "apart"), [(4.999, False), (5.0, True), (7.999, True), (8.0, False)])
def test_a_partition_has_a_beginning_and_an_end(seconds: float, apart: bool) -> None:
    parted = plan(partitions=(Partition(groups=(("r1",),), at_s=5.0, for_s=3.0),))
    assert cut(parted, "r1", "r2", at(seconds)) is apart


@pytest.mark.parametrize(
    ("rule", "apart"),
    [
        (Fault(loss=1.0), True),
        (Fault(loss=0.99), False),
        (Fault(loss=1.0, topic="robot/*"), False),
        (Fault(loss=1.0, source="r1"), True),
        (Fault(loss=1.0, source="controller"), False),
        (Fault(loss=1.0, windows=((0.0, 5.0), (9.0, 11.0))), True),
        (Fault(loss=1.0, windows=((0.0, 5.0),)), False),
    ],
)
def test_who_loses_everything_is_cut_off(rule: Fault, apart: bool) -> None:
    assert cut(plan(faults=(rule,)), "r1", "controller", at(10)) is apart


def test_the_dead_are_dead_from_the_crash_to_the_restart() -> None:
    short, long = Crash(node="r1", at_s=2.0, restart_after_s=3.0), Crash(node="controller", at_s=4.0)
    both = plan(crashes=(short, long))
    found = [dead(both, ("r1", "controller"), at(t)) for t in (1.999, 2.0, 4.0, 4.999, 1e6)]
    assert found == [None, short, long, long, long]
    assert dead(both, ("r1",), at(4.999)) == short
    assert dead(both, ("r1",), at(5.0)) is None
    assert back_at(both, short) == at(5.0)
    assert back_at(both, long) >= NEVER


def test_what_begins_between_two_moments() -> None:
    events = plan(
        crashes=(Crash(node="r1", at_s=3.0), Crash(node="r2", at_s=1.0), Crash(node="r1", at_s=2.0)),
        freezes=(Freeze(node="r1", at_s=1.0, for_s=0.5), Freeze(node="r2", at_s=1.0, for_s=0.5)),
    )
    assert crash_between(events, ("r1",), at(1), at(3)) == events.crashes[2]
    assert crash_between(events, ("r1",), at(2), at(3)) == events.crashes[0]
    assert crash_between(events, ("r1",), at(3), at(9)) is None
    assert freeze_between(events, ("r2",), at(0), at(1)) == events.freezes[1]
    assert freeze_between(events, ("r2",), at(1), at(9)) is None


def test_changes_are_visited_in_order_and_come_to_an_end() -> None:
    events = plan(
        faults=(Fault(loss=1.0, windows=((1.0, 4.0), (2.0, 3.0))), Fault(latency_s=1.0)),
        partitions=(
            Partition(groups=(("r1",),), at_s=2.5, for_s=3.0),
            Partition(groups=(("r2",),), at_s=7.0),
        ),
        crashes=(Crash(node="r1", at_s=6.0),),
        freezes=(Freeze(node="r1", at_s=0.5, for_s=9.0),),
    )
    now, visited = SINCE, []
    while (change := next_change(events, now)) is not None:
        visited.append((change - SINCE) / SECOND)
        now = change
    assert visited == [0.5, 1.0, 2.0, 2.5, 3.0, 4.0, 5.5, 6.0, 7.0]


def test_before_the_run_has_begun_nothing_timed_happens() -> None:
    waiting = plan(
        NEVER,
        faults=(Fault(loss=1.0, windows=((0.0, 1e6),)),),
        partitions=(Partition(groups=(("r1",),)),),
        crashes=(Crash(node="r1", at_s=0.0),),
        freezes=(Freeze(node="r1", at_s=0.0, for_s=1.0),),
    )
    late = 2**62 - 1
    assert not cut(waiting, "r1", "r2", late)
    assert dead(waiting, ("r1",), late) is None
    assert crash_between(waiting, ("r1",), 0, late) is None
    assert freeze_between(waiting, ("r1",), 0, late) is None
    assert next_change(waiting, 0) is None
    assert cut(plan(NEVER, faults=(Fault(loss=1.0),)), "r1", "r2", 0)


def test_a_controller_dies_by_its_robot_too() -> None:
    scenario = scenario_with(controller=Controller(host="r1"))
    assert dies_by("controller", scenario) == ("controller", "r1")
    assert dies_by("r1", scenario) == ("r1",)
    assert dies_by("controller", scenario_with()) == ("controller",)
