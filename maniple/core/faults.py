"""What a fault plan says of a moment: who is cut off from whom, who is dead or frozen, what comes next.

What it does to the messages of a link is in `links`.
"""

from collections.abc import Collection, Iterable, Iterator
from fnmatch import fnmatchcase

from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition, Scenario
from maniple.core.time import Time, from_seconds

NEVER: Time = 2**62
"""The start of a run that has not begun: nothing that is timed happens."""

Span = tuple[Time, Time]
"""From, and until but not at."""


def plan_of(scenario: Scenario, since: Time) -> FaultPlan:
    """What a resolved scenario injects, its times counted from `since`."""
    return FaultPlan(
        since_ns=since,
        faults=scenario.faults,
        partitions=scenario.partitions,
        crashes=scenario.crashes,
        freezes=scenario.freezes,
    )


def matches(rule: Fault, source: str, destination: str, topic: str) -> bool:
    """Whether a rule applies to a directed link."""
    return _matches_nodes(rule, source, destination) and fnmatchcase(topic, rule.topic)


def beside(node: str, scenario: Scenario) -> frozenset[str]:
    """The nodes on the same computer, itself among them: no network fails between these."""
    host = scenario.controller.host
    here = {"controller", host} if host is not None and node in ("controller", host) else set()
    return frozenset({node, *here})


def dies_with(node: str, scenario: Scenario) -> tuple[str, ...]:
    """The nodes that end with one: a controller ends with the robot it runs on, not the robot with it."""
    return (node, "controller") if node == scenario.controller.host else (node,)


def dies_by(node: str, scenario: Scenario) -> tuple[str, ...]:
    """The nodes whose crash ends this one: itself and, of a controller, the robot it runs on."""
    host = scenario.controller.host
    return (node, host) if node == "controller" and host is not None else (node,)


def cut(plan: FaultPlan, source: str, destination: str, now: Time) -> bool:
    """Whether nothing at all gets from one node to another: a partition is between them, or a rule that loses
    everything on every topic is on. Nodes `beside` each other are never cut off; that is the caller's to ask.
    """
    return any(
        separates(partition, source, destination) and holds((span_of(plan, partition),), now)
        for partition in plan.partitions
    ) or any(
        rule.loss >= 1.0
        and rule.topic == "*"
        and _matches_nodes(rule, source, destination)
        and (not rule.windows or holds(windows_of(plan, rule), now))
        for rule in plan.faults
    )


def dead(plan: FaultPlan, nodes: Collection[str], now: Time) -> Crash | None:
    """The crash of one of these nodes that holds now, from when it dies to when it may live again; of several
    the one that lasts longest."""
    holding = [
        crash
        for crash in plan.crashes
        if crash.node in nodes and plan.since_ns + from_seconds(crash.at_s) <= now < back_at(plan, crash)
    ]
    return max(holding, key=lambda crash: back_at(plan, crash), default=None)


def back_at(plan: FaultPlan, crash: Crash) -> Time:
    """When who died may live again; `NEVER` or later where it is gone for good."""
    if crash.restart_after_s is None:
        return NEVER
    return plan.since_ns + from_seconds(crash.at_s) + from_seconds(crash.restart_after_s)


def crash_between(plan: FaultPlan, nodes: Collection[str], after: Time, until: Time) -> Crash | None:
    """The first crash of one of these nodes in (after, until]."""
    due = [crash for crash in plan.crashes if crash.node in nodes and _begins(plan, crash, after, until)]
    return min(due, key=lambda crash: crash.at_s, default=None)


def freeze_between(plan: FaultPlan, nodes: Collection[str], after: Time, until: Time) -> Freeze | None:
    """The first freeze of one of these nodes that begins in (after, until]."""
    due = [freeze for freeze in plan.freezes if freeze.node in nodes and _begins(plan, freeze, after, until)]
    return min(due, key=lambda freeze: freeze.at_s, default=None)


def next_change(plan: FaultPlan, after: Time) -> Time | None:
    """When a rule or a partition begins or ends, or a node crashes or freezes, for the next time."""
    if plan.since_ns >= NEVER:
        return None
    return min((edge for edge in _edges(plan) if after < edge < NEVER), default=None)


def _matches_nodes(rule: Fault, source: str, destination: str) -> bool:
    return fnmatchcase(source, rule.source) and fnmatchcase(destination, rule.destination)


def group_of(partition: Partition, node: str) -> int:
    """Index of the group of a partition a node belongs to; -1 for those that are in none of them."""
    for index, patterns in enumerate(partition.groups):
        if any(fnmatchcase(node, pattern) for pattern in patterns):
            return index
    return -1


def separates(partition: Partition, one: str, other: str) -> bool:
    """Whether a partition, while it holds, is between two nodes."""
    return group_of(partition, one) != group_of(partition, other)


def windows_of(plan: FaultPlan, rule: Fault) -> tuple[Span, ...]:
    """When a rule is on; empty: always."""
    since = plan.since_ns
    return tuple((since + from_seconds(begin), since + from_seconds(end)) for begin, end in rule.windows)


def span_of(plan: FaultPlan, partition: Partition) -> Span:
    """From when to when a partition holds."""
    begin = plan.since_ns + from_seconds(partition.at_s)
    return begin, NEVER if partition.for_s is None else begin + from_seconds(partition.for_s)


def holds(spans: Iterable[Span], now: Time) -> bool:
    """Whether a moment is in one of these spans."""
    return any(begin <= now < end for begin, end in spans)


def _begins(plan: FaultPlan, event: Crash | Freeze, after: Time, until: Time) -> bool:
    return after < plan.since_ns + from_seconds(event.at_s) <= until


def _edges(plan: FaultPlan) -> Iterator[Time]:
    for rule in plan.faults:
        for window in windows_of(plan, rule):
            yield from window
    for partition in plan.partitions:
        yield from span_of(plan, partition)
    for at_s in (event.at_s for events in (plan.crashes, plan.freezes) for event in events):
        yield plan.since_ns + from_seconds(at_s)
