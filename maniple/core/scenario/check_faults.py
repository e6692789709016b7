"""Whether what is to be injected makes sense: of a scenario, and of a plan that changes a running platoon."""

import math
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase

import msgspec

from maniple.core.edges import processes_of
from maniple.core.faults import group_of, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.plans import BLANK
from maniple.core.presets import PRESETS
from maniple.core.scenario import fields
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition, Scenario
from maniple.core.topics import TOPICS

_OPERATOR = "operator"
PROCESSES = ("recorder", "router")
"""Who can die and freeze besides robots with all they have, controller and simulator; in virtual time there
are none."""

_MOST_NAMES = 8


def fault_problems(scenario: Scenario) -> Iterator[str]:
    """What is wrong with the faults of a resolved scenario; a line each."""
    robots = [robot.id for robot in scenario.robots]
    beside = [process for robot in scenario.robots for process in processes_of(robot)]
    yield from plan_problems(plan_of(scenario, 0), robots, scenario.controller.host, beside)
    yield from _clocks(scenario, robots)


def plan_problems(
    plan: FaultPlan, robots: Sequence[str], host: str | None = None, beside: Sequence[str] = ()
) -> list[str]:
    """What is wrong with a plan for these robots: path, value and what would be valid; empty if nothing is.

    `host` is the robot the controller runs on, which takes it along when it dies; `beside` are the processes
    of robots beside their agents, which can die and freeze too.
    """
    if found := list(_types(plan)):
        return found
    found = [
        text
        for index, rule in enumerate(plan.faults)
        if rule != BLANK
        for text in _rule(f"faults[{index}]", rule, robots)
    ]
    for index, partition in enumerate(plan.partitions):
        found += _partition(f"partitions[{index}]", partition, ["controller", *robots, _OPERATOR], host)
    return [*found, *_nodes(plan, [*robots, *beside]), *_overlaps(plan, host)]


def some(names: Sequence[str], most: int = _MOST_NAMES) -> str:
    """The first of some names."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def _types(plan: FaultPlan) -> Iterator[str]:
    kinds: tuple[tuple[str, type[msgspec.Struct]], ...] = (
        ("faults", Fault),
        ("partitions", Partition),
        ("crashes", Crash),
        ("freezes", Freeze),
    )
    for name, kind in kinds:
        for index, part in enumerate(getattr(plan, name)):
            data = msgspec.to_builtins(part)
            yield from fields.problems(fields.type_of(kind), data, f"{name}[{index}]")


def _rule(path: str, rule: Fault, robots: Sequence[str]) -> Iterator[str]:
    """A rule that matches nothing is most likely a slip of the pen."""
    patterns = [row.pattern for row in TOPICS if row.faults]
    topics = list(dict.fromkeys(pattern.replace("{id}", name) for name in robots for pattern in patterns))
    nodes = ["controller", *robots]
    for field, names in (("source", [*nodes, _OPERATOR]), ("destination", nodes), ("topic", topics)):
        pattern = getattr(rule, field)
        if not any(fnmatchcase(name, pattern) for name in names):
            yield f"{path}.{field} = {pattern!r}: matches nothing; valid: {some(names)}"
    if rule.preset and rule.preset not in PRESETS:
        yield f"{path}.preset = {rule.preset!r}: must be one of {', '.join(PRESETS)}"
    for index, (begin, end) in enumerate(rule.windows):
        if begin >= end:
            yield f"{path}.windows[{index}] = {[begin, end]}: is empty; must be [from, to) with from < to"


def _partition(path: str, partition: Partition, nodes: Sequence[str], host: str | None) -> Iterator[str]:
    """Groups that are empty, overlap, or leave nobody to be cut off from."""
    if not partition.groups:
        yield f"{path}.groups: missing; must be at least one group of nodes: {some(nodes)}"
        return
    for index, patterns in enumerate(partition.groups):
        where = f"{path}.groups[{index}]"
        if not patterns:
            yield f"{where}: is empty; must name nodes: {some(nodes)}"
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in nodes):
                yield f"{where} = {pattern!r}: matches nothing; valid: {some(nodes)}"
        for name in nodes:
            first = group_of(partition, name)
            if first < index and first >= 0 and any(fnmatchcase(name, pattern) for pattern in patterns):
                yield f"{where}: {name} is in groups[{first}] already; must be in one group"
    if host is not None and group_of(partition, host) != group_of(partition, "controller"):
        yield f"{path}.groups: the controller runs on {host}; must be in the same group"
    elif {group_of(partition, name) for name in nodes} == {0}:
        yield f"{path}.groups: all nodes are in one group; must leave somebody out, or be more groups"


def _nodes(plan: FaultPlan, others: Sequence[str]) -> Iterator[str]:
    """Who dies and who freezes."""
    nodes = ["controller", *PROCESSES, *others]
    for index, crash in enumerate(plan.crashes):
        if crash.node == "simulator":
            yield (
                f"crashes[{index}].node = 'simulator': its death ends the run; must be one of {some(nodes)}"
            )
        elif crash.node not in nodes:
            yield f"crashes[{index}].node = {crash.node!r}: must be one of {some(nodes)}"
    nodes = ["controller", "simulator", *PROCESSES, *others]
    for index, freeze in enumerate(plan.freezes):
        if freeze.node not in nodes:
            yield f"freezes[{index}].node = {freeze.node!r}: must be one of {some(nodes)}"


def _overlaps(plan: FaultPlan, host: str | None) -> Iterator[str]:
    """Nodes that would have to die or freeze while they are dead or frozen."""
    events: list[tuple[float, str, Crash | Freeze]] = [
        *((one.at_s, f"crashes[{index}]", one) for index, one in enumerate(plan.crashes)),
        *((one.at_s, f"freezes[{index}]", one) for index, one in enumerate(plan.freezes)),
    ]
    gone: dict[str, tuple[float, str]] = {}
    for at_s, path, event in sorted(events, key=lambda event: event[0]):
        crashes = isinstance(event, Crash)
        lasts = (event.restart_after_s or math.inf) if isinstance(event, Crash) else event.for_s
        for name in (event.node, "controller") if crashes and event.node == host else (event.node,):
            until, how = gone.get(name, (-1.0, ""))
            if at_s <= until:
                back = "for good" if until == math.inf else f"until {until:g} s"
                yield f"{path}.at_s = {at_s}: {name} is {how} already then, {back}"
            if at_s + lasts > until:
                gone[name] = at_s + lasts, "dead" if crashes else "frozen"


def _clocks(scenario: Scenario, robots: Sequence[str]) -> Iterator[str]:
    nodes = ["controller", "simulator", *robots]
    named = [clock.node for clock in scenario.clocks]
    for index, name in enumerate(named):
        if name not in nodes:
            yield f"clocks[{index}].node = {name!r}: must be one of {some(nodes)}"
        elif (first := named.index(name)) < index:
            yield f"clocks[{index}].node = {name!r}: clocks[{first}] has it already; must be named once"
