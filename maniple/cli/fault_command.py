"""`maniple fault`: change what the network does to a running platoon, and which processes die or freeze."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from rich.console import Console

from maniple.cli import fault_text
from maniple.cli.fault_options import by_option, effect_problem, link_problem, parsed
from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import (
    Connect,
    Json,
    Prefix,
    Timeout,
    latched,
    nodes_known,
    operator_session,
    publish,
)
from maniple.core import plans, topics
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.messages import FaultPlan
from maniple.core.presets import with_preset
from maniple.core.scenario.check_faults import plan_problems
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

LEAD_S = 0.3
"""What begins now begins so much later, wall time: everybody is to know of it by then."""

Change = Callable[[FaultPlan, float], FaultPlan]
"""A changed plan; the second argument is the time that counts as now, in seconds since the start."""

app = typer.Typer(
    name="fault",
    help="Change what the network does to a running platoon, and which processes die or freeze.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

From = Annotated[str | None, typer.Option("--from", metavar="NODE", help="Sender; * and ? as in file names.")]
To = Annotated[str | None, typer.Option("--to", metavar="NODE", help="Receiver, likewise.")]
OnTopic = Annotated[str | None, typer.Option("--topic", help="Topic, likewise, as in 'robot/*/odometry'.")]
For = Annotated[float | None, typer.Option("--for", metavar="S", help="For so many seconds from now.")]


@app.command()
def show(
    connect: Connect = LOCAL, prefix: Prefix = "maniple", json: Json = False, timeout: Timeout = 5.0
) -> None:
    """Show what is planned: rules with their numbers, partitions, crashes and freezes, and where they are."""
    from maniple.host.joining import clock_of

    with operator_session(connect, prefix, timeout) as session:
        _say(_planned(session), clock_of(session).now(), connect, json)


@app.command("set")
def set_rule(
    source: From = None,
    destination: To = None,
    topic: OnTopic = None,
    preset: Annotated[str | None, typer.Option(help="A measured network: see docs/faults.md.")] = None,
    latency: Annotated[float | None, typer.Option(help="Seconds, one way.")] = None,
    jitter: Annotated[float | None, typer.Option(help="Seconds the latency is off by, at most.")] = None,
    loss: Annotated[float | None, typer.Option(help="Share of the messages, 0 to 1.")] = None,
    burst_enter: Annotated[float | None, typer.Option(help="Bursts: from good to bad, 0 to 1.")] = None,
    burst_leave: Annotated[float | None, typer.Option(help="Bursts: from bad to good.")] = None,
    burst_loss_good: Annotated[float | None, typer.Option(help="Share lost between bursts.")] = None,
    burst_loss_bad: Annotated[float | None, typer.Option(help="Share lost in bursts.")] = None,
    duplicate: Annotated[float | None, typer.Option(help="Share that arrives twice.")] = None,
    reorder: Annotated[float | None, typer.Option(help="Share that later ones overtake.")] = None,
    reorder_by: Annotated[float | None, typer.Option(help="Seconds these are held back.")] = None,
    corrupt: Annotated[float | None, typer.Option(help="Share of which bits are flipped.")] = None,
    rate_kbps: Annotated[float | None, typer.Option(help="Kilobits a second.")] = None,
    queue: Annotated[float | None, typer.Option(help="Seconds in that queue, at most.")] = None,
    window: Annotated[
        list[str] | None, typer.Option(metavar="FROM:TO", help="On then, seconds since the start.")
    ] = None,
    for_s: For = None,
    add: Annotated[bool, typer.Option("--add", help="Beside the rules for the same link and topic.")] = False,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Make links worse; a rule for the same link and topic is replaced."""
    if window and for_s is not None:
        raise typer.BadParameter("give --window or --for, not both", param_hint="--for")
    links = {"source": source, "destination": destination, "topic": topic}
    burst = _given(enter=burst_enter, leave=burst_leave, loss_good=burst_loss_good, loss_bad=burst_loss_bad)
    numbers = _given(
        preset=preset,
        latency_s=latency,
        jitter_s=jitter,
        loss=loss,
        burst=burst or None,
        duplicate=duplicate,
        reorder=reorder,
        reorder_s=reorder_by,
        corrupt=corrupt,
        rate_kbps=rate_kbps,
        queue_s=queue,
    )
    if not numbers:
        raise typer.BadParameter("say what is to be wrong: --latency, --loss, --preset, ...; or use clear")
    data = _given(**links) | numbers | {"windows": [_window(text) for text in window or ()]}
    rule = parsed(Fault, data)
    if for_s is not None:
        parsed(Freeze, {"node": "any", "at_s": 0, "for_s": for_s})
    try:
        rule = with_preset(rule)
    except ScenarioError as error:
        raise ArgumentError(by_option(str(error))) from None
    if found := effect_problem(rule, numbers):
        raise ArgumentError(found)

    def change(plan: FaultPlan, now_s: float) -> FaultPlan:
        windows = rule.windows if for_s is None else ((now_s, round(now_s + for_s, 3)),)
        return plans.with_rule(plan, msgspec.structs.replace(rule, windows=windows), add)

    _change(change, connect, prefix, json, timeout, lambda robots: link_problem(rule, robots))


@app.command()
def clear(
    rules: Annotated[list[int] | None, typer.Argument(metavar="RULE...", help="By number.")] = None,
    source: From = None,
    destination: To = None,
    topic: OnTopic = None,
    partitions: Annotated[bool, typer.Option("--partitions", help="End the partitions.")] = False,
    node: Annotated[
        list[str] | None, typer.Option(metavar="NODE", help="Take back its crashes and freezes.")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Everything: the network is as it is.")] = False,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Take rules back, by number or by what they were set with; end partitions; let the dead live again."""
    by_link = _given(source=source, destination=destination, topic=topic)
    if not (rules or by_link or partitions or node or everything):
        raise typer.BadParameter(
            "say what to clear: RULE..., --from, --to, --topic, --partitions, --node or --all"
        )

    def change(plan: FaultPlan, _: float) -> FaultPlan:
        if everything:
            return plans.emptied(plan)
        changed = plans.without_rules(plan, _chosen(plan, rules or [], by_link)) if rules or by_link else plan
        changed = plans.without_partitions(changed) if partitions else changed
        for name in node or ():
            _require_fate(plan, name)
            changed = plans.without_fate(changed, name)
        return changed

    _change(change, connect, prefix, json, timeout)


@app.command()
def partition(
    groups: Annotated[list[str], typer.Argument(metavar="GROUP...", help="Nodes, as in r1,r2 or 'r*'.")],
    for_s: For = None,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Keep groups of nodes from hearing each other; the nodes in none of them are another group."""
    parts = [[name.strip() for name in group.split(",") if name.strip()] for group in groups]
    made = parsed(Partition, {"groups": parts, **_given(for_s=for_s)})
    _change(
        lambda plan, now_s: plans.with_partition(plan, msgspec.structs.replace(made, at_s=now_s)),
        connect,
        prefix,
        json,
        timeout,
    )


@app.command()
def crash(
    node: Annotated[
        str,
        typer.Argument(
            help="A robot, its driver (r1-driver), scanner or vehicle, the controller, recorder or router."
        ),
    ],
    restart_after: Annotated[
        float | None, typer.Option("--restart-after", metavar="S", help="May live again after this.")
    ] = None,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Kill a process as SIGKILL does; without --restart-after for good."""
    made = parsed(Crash, {"node": node, "at_s": 0, **_given(restart_after_s=restart_after)})
    _change(
        lambda plan, now_s: plans.with_crash(plan, msgspec.structs.replace(made, at_s=now_s)),
        connect,
        prefix,
        json,
        timeout,
    )


@app.command()
def freeze(
    node: Annotated[
        str,
        typer.Argument(
            help="A robot, its driver (r1-driver), scanner or vehicle, the controller, simulator, recorder "
            "or router."
        ),
    ],
    for_s: Annotated[float, typer.Option("--for", metavar="S", help="For so many seconds.")],
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Stop a process as SIGSTOP does, and let it go on later."""
    made = parsed(Freeze, {"node": node, "at_s": 0, "for_s": for_s})
    _change(
        lambda plan, now_s: plans.with_freeze(plan, msgspec.structs.replace(made, at_s=now_s)),
        connect,
        prefix,
        json,
        timeout,
    )


def _change(
    change: Change,
    connect: str,
    prefix: str,
    as_json: bool,
    timeout_s: float,
    check: Callable[[Sequence[str]], str] = lambda _: "",
) -> None:
    """Change the plan of a running platoon, and show what the router keeps then. `check` says what else is
    wrong for robots that are known.

    Raises:
        ArgumentError: the changed plan is not valid; says what would be.
        RunError: the platoon can't be reached.
    """
    from maniple.host.joining import clock_of

    with operator_session(connect, prefix, timeout_s) as session:
        clock = clock_of(session)
        now = clock.now()
        plan = plans.pruned(plans.begun(_planned(session), now), now)
        changed = change(plan, round(plans.elapsed_s(plan, now) + LEAD_S * clock.speed, 3))
        robots, _, beside = nodes_known(session)
        before = plan_problems(plan, robots, beside=beside)
        if found := [text for text in plan_problems(changed, robots, beside=beside) if text not in before]:
            unknown = (
                [] if robots else ["no robot is known there yet: neither one nor a controller was heard of"]
            )
            raise ArgumentError("\n".join([*map(by_option, found), *unknown]))
        if wrong := check(robots):
            raise ArgumentError(wrong)
        publish(session, topics.PLAN, changed, timeout_s)
        _say(_planned(session), clock.now(), connect, as_json)


def _planned(session: "ZenohSession") -> FaultPlan | None:
    plan = latched(session, topics.PLAN)
    assert plan is None or isinstance(plan, FaultPlan)
    return plan


def _say(plan: FaultPlan | None, now: int, connect: str, as_json: bool) -> None:
    if as_json:
        typer.echo(msgspec.json.encode({**fault_text.report(plan, now), "connect": connect}))
    else:
        Console(highlight=False).print(fault_text.picture(plan, now, connect))


def _given(**values: Any) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}


def _window(text: str) -> list[float]:
    begin, _, end = text.partition(":")
    try:
        return [float(begin), float(end)]
    except ValueError:
        raise typer.BadParameter(
            f"{text!r}: must be FROM:TO in seconds since the start, as in 10:20", param_hint="--window"
        ) from None


def _chosen(plan: FaultPlan, numbers: list[int], by_link: Mapping[str, str]) -> list[int]:
    """The rules of these numbers, or that were set for these links.

    Raises:
        ArgumentError: there is no such rule.
    """
    rules = plans.numbered(plan)
    there = ", ".join(f"{number} ({fault_text.link(rule)})" for number, rule in rules.items()) or "none"
    if unknown := [number for number in numbers if number not in rules]:
        raise ArgumentError(f"rule {unknown[0]}: is not there; rules are {there}")
    found = [number for number, rule in rules.items() if _is_for(rule, by_link)] if by_link else []
    if by_link and not found:
        raise ArgumentError(f"no rule was set for that; rules are {there}")
    return [*numbers, *found]


def _is_for(rule: Fault, by_link: Mapping[str, str]) -> bool:
    return all(getattr(rule, key) == value for key, value in by_link.items())


def _require_fate(plan: FaultPlan, node: str) -> None:
    fates: tuple[Crash | Freeze, ...] = (*plan.crashes, *plan.freezes)
    nodes = dict.fromkeys(one.node for one in fates)
    if node not in nodes:
        raise ArgumentError(
            f"--node {node}: no crash or freeze of it is planned; of {', '.join(nodes) or 'none'}"
        )
