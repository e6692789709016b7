"""Changes of a running fault plan, as functions of values.

The index of a rule is part of its draw: a rule that goes leaves a blank, so that those after it keep their
places and decide as before.
"""

from collections.abc import Callable, Collection
from typing import Literal, TypeAlias

from msgspec.structs import replace

from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition
from maniple.core.time import SECOND, Time, to_seconds

BLANK = Fault(source="", destination="", topic="")
"""Holds the place of a rule that is gone: it matches no link."""

Stage: TypeAlias = Literal["to come", "running", "over"]


def begun(plan: FaultPlan | None, now: Time) -> FaultPlan:
    """The plan; where there is none an empty one, its times counting from the last full second."""
    return FaultPlan(since_ns=now - now % SECOND) if plan is None else plan


def elapsed_s(plan: FaultPlan, now: Time) -> float:
    """`now` (scenario time) as the plan counts time, s, to the millisecond."""
    return round(to_seconds(now - plan.since_ns), 3)


def stage(at_s: float, for_s: float | None, now_s: float) -> Stage:
    """Where something is at `now_s` that begins at `at_s` and lasts `for_s`, or to the end."""
    if now_s < at_s:
        return "to come"
    return "running" if for_s is None or now_s < at_s + for_s else "over"


def rule_stage(rule: Fault, now_s: float) -> Stage:
    """Where a rule is: "running" inside of a window, "to come" before one, "over" after the last."""
    if not rule.windows or any(begin <= now_s < end for begin, end in rule.windows):
        return "running"
    return "to come" if any(now_s < begin for begin, _ in rule.windows) else "over"


def numbered(plan: FaultPlan) -> dict[int, Fault]:
    """The rules by their numbers, without the blanks."""
    return {number: rule for number, rule in enumerate(plan.faults) if rule != BLANK}


def pruned(plan: FaultPlan, now: Time) -> FaultPlan:
    """The plan without what is over. Crashes for good stay: the dead are to stay dead."""
    now_s = elapsed_s(plan, now)

    def lasts(at_s: float, for_s: float | None) -> bool:
        return stage(at_s, for_s, now_s) != "over"

    return replace(
        _without_rules(plan, lambda _, rule: rule_stage(rule, now_s) == "over"),
        partitions=tuple(one for one in plan.partitions if lasts(one.at_s, one.for_s)),
        crashes=tuple(one for one in plan.crashes if lasts(one.at_s, one.restart_after_s)),
        freezes=tuple(one for one in plan.freezes if lasts(one.at_s, one.for_s)),
    )


def with_rule(plan: FaultPlan, rule: Fault, add: bool = False) -> FaultPlan:
    """The plan with a rule in the place of those for the same link and topic, or, with `add`, beside them."""
    same = [] if add else [number for number, one in numbered(plan).items() if _link(one) == _link(rule)]
    cleared = _without_rules(plan, lambda number, _: number in same)
    rules = list(cleared.faults)
    place = same[0] if same else next((i for i, one in enumerate(rules) if one == BLANK), len(rules))
    rules += [BLANK] * (place + 1 - len(rules))
    rules[place] = rule
    return replace(cleared, faults=tuple(rules))


def without_rules(plan: FaultPlan, numbers: Collection[int]) -> FaultPlan:
    """The plan without the rules of these numbers."""
    return _without_rules(plan, lambda number, _: number in numbers)


def with_partition(plan: FaultPlan, partition: Partition) -> FaultPlan:
    """The plan with another partition."""
    return replace(plan, partitions=(*plan.partitions, partition))


def without_partitions(plan: FaultPlan) -> FaultPlan:
    """The plan without partitions."""
    return replace(plan, partitions=())


def with_crash(plan: FaultPlan, crash: Crash) -> FaultPlan:
    """The plan with another crash."""
    return replace(plan, crashes=(*plan.crashes, crash))


def with_freeze(plan: FaultPlan, freeze: Freeze) -> FaultPlan:
    """The plan with another freeze."""
    return replace(plan, freezes=(*plan.freezes, freeze))


def without_fate(plan: FaultPlan, node: str) -> FaultPlan:
    """The plan without crashes and freezes of a node."""
    return replace(
        plan,
        crashes=tuple(one for one in plan.crashes if one.node != node),
        freezes=tuple(one for one in plan.freezes if one.node != node),
    )


def emptied(plan: FaultPlan) -> FaultPlan:
    """A plan in which nothing is wrong, counting from the same moment."""
    return FaultPlan(since_ns=plan.since_ns)


def _without_rules(plan: FaultPlan, gone: Callable[[int, Fault], bool]) -> FaultPlan:
    rules = [BLANK if gone(number, rule) else rule for number, rule in enumerate(plan.faults)]
    while rules and rules[-1] == BLANK:
        rules.pop()
    return replace(plan, faults=tuple(rules))


def _link(rule: Fault) -> tuple[str, str, str]:
    return rule.source, rule.destination, rule.topic
