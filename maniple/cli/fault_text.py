"""A fault plan for people and for machines."""

from collections.abc import Iterator
from typing import Any

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from maniple.core import plans
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Fault, Partition
from maniple.core.time import Time

_COLOURS = {"running": "red", "to come": "yellow", "over": "dim"}


def report(plan: FaultPlan | None, now: Time) -> dict[str, Any]:
    """A plan as JSON: what is left at its default is left out, and every entry says where it is."""
    if plan is None:
        return {
            "since_ns": None,
            "elapsed_s": None,
            "rules": [],
            "partitions": [],
            "crashes": [],
            "freezes": [],
        }
    now_s = plans.elapsed_s(plan, now)
    return {
        "since_ns": plan.since_ns,
        "elapsed_s": now_s,
        "rules": [
            {"number": number, "state": plans.rule_stage(rule, now_s), **_given(rule)}
            for number, rule in plans.numbered(plan).items()
        ],
        "partitions": [
            {"state": plans.stage(one.at_s, one.for_s, now_s), **msgspec.to_builtins(one)}
            for one in plan.partitions
        ],
        "crashes": [
            {"state": plans.stage(one.at_s, one.restart_after_s, now_s), **msgspec.to_builtins(one)}
            for one in plan.crashes
        ],
        "freezes": [
            {"state": plans.stage(one.at_s, one.for_s, now_s), **msgspec.to_builtins(one)}
            for one in plan.freezes
        ],
    }


def picture(plan: FaultPlan | None, now: Time, connect: str) -> RenderableType:
    """A plan as a table, and where it was asked."""
    if plan is None:
        return _head("no faults are planned", connect)
    now_s = plans.elapsed_s(plan, now)
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("", justify="right", no_wrap=True)
    table.add_column("who", overflow="fold")
    table.add_column("what", overflow="fold")
    table.add_column("when", overflow="fold")
    table.add_column("now", no_wrap=True)
    for number, who, what, when, stage in _rows(plan, now_s):
        table.add_row(number, who, what, when, Text(stage, style=_COLOURS[stage]))
    nothing = "" if table.row_count else ": nothing is wrong"
    head = _head(f"{now_s:.1f} s since the start{nothing}", connect)
    return Group(head, table) if table.row_count else head


def summary(rule: Fault) -> str:
    """What a rule does, in words."""
    return ", ".join(_effects(rule)) or "nothing"


def _head(text: str, connect: str) -> Text:
    return Text(text).append(f" ({connect})", style="dim")


def _rows(plan: FaultPlan, now_s: float) -> Iterator[tuple[str, str, str, str, plans.Stage]]:
    for number, rule in plans.numbered(plan).items():
        when = ", ".join(f"{begin:g} to {end:g} s" for begin, end in rule.windows) or "always"
        yield f"{number}", link(rule), summary(rule), when, plans.rule_stage(rule, now_s)
    for partition in plan.partitions:
        stage = plans.stage(partition.at_s, partition.for_s, now_s)
        yield "", groups(partition), "partition", _span(partition.at_s, partition.for_s), stage
    for crash in plan.crashes:
        stage = plans.stage(crash.at_s, crash.restart_after_s, now_s)
        what = "crash" if crash.restart_after_s is None else f"crash, back after {crash.restart_after_s:g} s"
        yield "", crash.node, what, f"at {crash.at_s:g} s", stage
    for freeze in plan.freezes:
        stage = plans.stage(freeze.at_s, freeze.for_s, now_s)
        yield "", freeze.node, "freeze", _span(freeze.at_s, freeze.for_s), stage


def link(rule: Fault) -> str:
    """The links of a rule, in words."""
    source, destination = ("all" if name == "*" else name for name in (rule.source, rule.destination))
    nodes = f"{source} to {destination}"
    return nodes if rule.topic == "*" else f"{nodes}: {rule.topic}"


def groups(partition: Partition) -> str:
    """Who is apart from whom."""
    return " | ".join(",".join(group) for group in partition.groups) + " | all others"


def _effects(rule: Fault) -> Iterator[str]:
    if rule.preset:
        yield rule.preset
    if rule.latency_s or rule.jitter_s:
        spread = f" +- {1000 * rule.jitter_s:g}" if rule.jitter_s else ""
        yield f"{1000 * rule.latency_s:g}{spread} ms late"
    if rule.loss:
        yield f"{_share(rule.loss)} lost"
    if rule.burst is not None:
        enter, leave = _share(rule.burst.enter), _share(rule.burst.leave)
        bad, good = _share(rule.burst.loss_bad), _share(rule.burst.loss_good)
        yield f"bursts (enter {enter}, leave {leave}; {bad} lost, else {good})"
    if rule.duplicate:
        yield f"{_share(rule.duplicate)} twice"
    if rule.reorder:
        yield f"{_share(rule.reorder)} held back by {1000 * rule.reorder_s:g} ms"
    if rule.corrupt:
        yield f"{_share(rule.corrupt)} corrupted"
    if rule.rate_kbps is not None:
        yield f"{rule.rate_kbps:g} kbit/s, queue of {rule.queue_s:g} s"


def _share(value: float) -> str:
    return f"{100 * value:g} %"


def _span(at_s: float, for_s: float | None) -> str:
    return f"from {at_s:g} s" + ("" if for_s is None else f" for {for_s:g} s")


def _given(rule: Fault) -> dict[str, Any]:
    """The fields of a rule that are not as they are by default."""
    plain = msgspec.to_builtins(Fault())
    named = ("source", "destination", "topic")
    return {
        key: value for key, value in msgspec.to_builtins(rule).items() if key in named or value != plain[key]
    }
