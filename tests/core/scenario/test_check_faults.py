from typing import Any

import pytest

from maniple.core.errors import ScenarioError
from maniple.core.messages import FaultPlan
from maniple.core.plans import BLANK
from maniple.core.scenario.check import problems
from maniple.core.scenario.check_faults import plan_problems
from maniple.core.scenario.parse import scenario_of, with_overrides
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition

Data = dict[str, Any]
NODES = "controller, r1, r2, r3"
MORTAL = "controller, recorder, router, r1, r2, r3"


def checked(data: Data, *overrides: str) -> list[str]:
    return problems(resolve(scenario_of(with_overrides(data, overrides)), {}, {}))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("faults=[{source='r9'}]", f"faults[0].source = 'r9': matches nothing; valid: {NODES}, operator"),
        ("faults=[{destination='sim*'}]", f"faults[0].destination = 'sim*': matches nothing; valid: {NODES}"),
        (
            "faults=[{windows=[[0, 5], [7, 7]]}]",
            "faults[0].windows[1] = [7.0, 7.0]: is empty; must be [from, to) with from < to",
        ),
        (
            "partitions=[{groups=[]}]",
            f"partitions[0].groups: missing; must be at least one group of nodes: {NODES}, operator",
        ),
        (
            "partitions=[{groups=[['r1'], []]}]",
            f"partitions[0].groups[1]: is empty; must name nodes: {NODES}, operator",
        ),
        (
            "partitions=[{groups=[['r1', 'simulator']]}]",
            f"partitions[0].groups[0] = 'simulator': matches nothing; valid: {NODES}, operator",
        ),
        (
            "partitions=[{groups=[['r1', 'r2'], ['controller', 'r[23]']]}]",
            "partitions[0].groups[1]: r2 is in groups[0] already; must be in one group",
        ),
        (
            "partitions=[{groups=[['*']]}]",
            "partitions[0].groups: all nodes are in one group; must leave somebody out, or be more groups",
        ),
        (
            "crashes=[{node='simulator', at_s=1}]",
            f"crashes[0].node = 'simulator': its death ends the run; must be one of {MORTAL}",
        ),
        (
            "crashes=[{node='r9', at_s=1}]",
            f"crashes[0].node = 'r9': must be one of {MORTAL}",
        ),
        (
            "crashes=[{node='r1', at_s=9}, {node='r1', at_s=1}]",
            "crashes[0].at_s = 9.0: r1 is dead already then, for good",
        ),
        (
            "crashes=[{node='r1', at_s=1, restart_after_s=5}, {node='r1', at_s=4}]",
            "crashes[1].at_s = 4.0: r1 is dead already then, until 6 s",
        ),
        (
            "freezes=[{node='r9', at_s=1, for_s=1}]",
            "freezes[0].node = 'r9': must be one of controller, simulator, recorder, router, r1, r2, r3",
        ),
        (
            "freezes=[{node='r1', at_s=1, for_s=5}, {node='r1', at_s=6, for_s=1}]",
            "freezes[1].at_s = 6.0: r1 is frozen already then, until 6 s",
        ),
        (
            "clocks=[{node='router', offset_s=1}]",
            "clocks[0].node = 'router': must be one of controller, simulator, r1, r2, r3",
        ),
        (
            "clocks=[{node='r1', offset_s=1}, {node='r1', skew_ppm=1}]",
            "clocks[1].node = 'r1': clocks[0] has it already; must be named once",
        ),
    ],
)
def test_what_is_a_slip_of_the_pen_is_told(data: Data, override: str, message: str) -> None:
    assert checked(data, override) == [message]


@pytest.mark.parametrize("topic", ["robot/*/odo", "hw/*", "platoon/stop"])
def test_a_rule_is_for_topics_that_faults_apply_to(data: Data, topic: str) -> None:
    (message,) = checked(data, f"faults=[{{topic='{topic}'}}]")
    assert message.startswith(f"faults[0].topic = '{topic}': matches nothing; valid: robot/r1/odometry, ")


def test_a_controller_is_where_its_robot_is(data: Data) -> None:
    alone = "partitions=[{groups=[['r1']]}]"
    assert checked(data, alone) == []
    assert checked(data, alone, "controller.host=r2") == []
    assert checked(data, alone, "controller.host=r1") == [
        "partitions[0].groups: the controller runs on r1; must be in the same group"
    ]


def test_a_frozen_node_cannot_die(data: Data) -> None:
    freeze = "freezes=[{node='r1', at_s=1, for_s=5}]"
    assert checked(data, freeze, "crashes=[{node='r1', at_s=3}]") == [
        "crashes[0].at_s = 3.0: r1 is frozen already then, until 6 s"
    ]
    assert checked(data, freeze, "crashes=[{node='r1', at_s=7}]") == []


def test_nodes_may_die_more_than_once(data: Data) -> None:
    twice = (
        "crashes=[{node='r1', at_s=1, restart_after_s=5}, {node='controller', at_s=2}, {node='r1', at_s=7}]"
    )
    assert checked(data, twice, "controller.host=r2", "waiting.enabled=true") == []


@pytest.mark.parametrize(
    ("first", "then", "what"),
    [
        ("r1", "controller", "controller is dead already then, until 6 s"),
        ("controller", "r1", "controller is dead already then, until 6 s"),
    ],
)
def test_a_controller_on_a_robot_is_dead_while_that_is(data: Data, first: str, then: str, what: str) -> None:
    crashes = f"crashes=[{{node='{first}', at_s=1, restart_after_s=5}}, {{node='{then}', at_s=4}}]"
    assert checked(data, crashes) == []
    assert checked(data, crashes, "controller.host=r1") == [f"crashes[1].at_s = 4.0: {what}"]


def test_a_preset_fills_what_is_left_out_and_nothing_else(data: Data) -> None:
    scenario = scenario_of(with_overrides(data, ["faults=[{preset='lte', latency_s=0.2, topic='robot/*'}]"]))
    (rule,) = resolve(scenario, {}, {}).faults
    assert (rule.preset, rule.topic, rule.latency_s, rule.rate_kbps) == ("lte", "robot/*", 0.2, 6000.0)


def test_no_such_preset(data: Data) -> None:
    with pytest.raises(ScenarioError, match=r"faults\[0\]\.preset = 'dsl': must be one of wifi-good, "):
        checked(data, "faults=[{preset='dsl'}]")
    (message,) = plan_problems(FaultPlan(since_ns=0, faults=(Fault(preset="dsl"),)), ["r1"])
    assert message.startswith("faults[0].preset = 'dsl': must be one of wifi-good, ")


def test_a_plan_from_python_or_the_network_is_checked_for_types_too() -> None:
    plan = FaultPlan(
        since_ns=0,
        faults=(BLANK, Fault(loss=1.5), Fault(latency_s=float("nan"))),
        crashes=(Crash(node="r1", at_s=-1.0),),
    )
    assert [text.split(":")[0] for text in plan_problems(plan, ["r1", "r2", "r3"])] == [
        "faults[1].loss = 1.5",
        "faults[2].latency_s = nan",
        "crashes[0].at_s = -1.0",
    ]


def test_a_sound_plan_has_no_problems() -> None:
    """The place of a rule that is gone is not a rule that matches nothing."""
    plan = FaultPlan(
        since_ns=0,
        faults=(BLANK, Fault(source="operator", topic="formation/goal", loss=0.5)),
        partitions=(Partition(groups=(("r1", "r2"), ("controller",)), for_s=5.0),),
        crashes=(Crash(node="router", at_s=1.0),),
        freezes=(Freeze(node="simulator", at_s=1.0, for_s=2.0),),
    )
    assert plan_problems(plan, ["r1", "r2", "r3"]) == []


def test_drivers_and_vehicles_can_die_and_freeze_where_there_are_any(data: Data) -> None:
    (message,) = checked(data, "crashes=[{node='r1-driver', at_s=1.0}]")
    assert message == "crashes[0].node = 'r1-driver': must be one of controller, recorder, router, r1, r2, r3"
    plan = FaultPlan(
        since_ns=0,
        crashes=(Crash(node="r1-driver", at_s=1.0),),
        freezes=(Freeze(node="r1-vehicle", at_s=1.0, for_s=2.0),),
    )
    assert plan_problems(plan, ["r1", "r2", "r3"], beside=["r1-vehicle", "r1-driver"]) == []
    partition = Partition(groups=(("r1-driver",), ("r1",)))
    (first, *_) = plan_problems(
        FaultPlan(since_ns=0, partitions=(partition,)), ["r1", "r2", "r3"], beside=["r1-driver"]
    )
    assert first.startswith("partitions[0].groups[0] = 'r1-driver': matches nothing")


def test_a_group_of_unknown_nodes_is_one_problem(data: Data) -> None:
    (message,) = checked(data, "partitions=[{groups=[['r9']]}]")
    assert message.startswith("partitions[0].groups[0] = 'r9': matches nothing")
