"""`maniple log diff`."""

from collections.abc import Iterator
from enum import StrEnum
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli.log.options import From, Topics, Until, Without, selection_of
from maniple.core.errors import ArgumentError

if TYPE_CHECKING:
    from maniple.report.comparison import Apart, FieldChange, FigureRow
    from maniple.report.comparison_diff import Diff
    from maniple.report.comparison_messages import FieldDifference, TopicDifference, Value, Which

_SHOWN = 12
"""Fields of a topic, or of a scenario, that are listed for people."""


class By(StrEnum):
    """What two recordings are judged by."""

    message = "message"
    time = "time"


def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="Recording (MCAP), as it is to be.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Recording that is compared with it.")],
    by: Annotated[
        By | None,
        typer.Option(
            help="What they are judged by: message by message, of the same topic, sender, life and number; "
            "or outcome and quantities over time since the platoon set out. By default message for two runs "
            "in virtual time, else time.",
            show_default=False,
        ),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME:FIELD=]NUMBER",
            help="How far a field may be off, absolute (robot/*/command:values=1e-6), or every number; may "
            "be given several times, the last that fits counts.",
            show_default=False,
        ),
    ] = None,
    tolerances: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="TOML file with default, ignore and a table of tolerances."),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[:FIELD]",
            help="What is not compared; may be given several times.",
            show_default=False,
        ),
    ] = None,
    start: From = None,
    until: Until = None,
    topic: Topics = None,
    without: Without = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw both runs into this folder, as PNG and SVG.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare two recordings: scenarios, outcomes, quantities over time, messages field by field.

    Exit status: 0 the same within the tolerances, 1 they differ, 2 bad input, 130 interrupted.
    """
    from maniple.recording.reader import read
    from maniple.report.comparison_diff import compare, draw, names_of, require_by_message, usual_way
    from maniple.report.comparison_tolerances import Tolerances, read_tolerances, require_used, tolerances_of

    given = tolerances_of(tolerance or (), ignore or ())
    limits = (Tolerances() if tolerances is None else read_tolerances(tolerances)).and_then(given)
    one, other = read(a), read(b)
    if not (one.topics or other.topics):
        raise ArgumentError(f"neither {a} nor {b} holds a message: there is nothing to compare")
    way = by.value if by else usual_way(one, other)
    require_by_message(way, **{"from": start, "until": until, "topic": topic, "without": without})
    selection = selection_of(one, start, until, topic, without)
    found = compare(one, other, limits, way, selection)
    require_used(given, names_of(found, one, other))
    result = found.diff
    if plot is not None:
        result = msgspec.structs.replace(result, pictures=draw(found.pairs, (a.name, b.name), plot))
    if as_json:
        typer.echo(msgspec.json.encode(result))
    else:
        show(result, Console(width=None if Console().is_terminal else 120))
    raise typer.Exit(0 if result.same else 1)


def show(result: "Diff", console: Console, verdict: bool = True) -> None:
    """A comparison for people; without `verdict` nothing is said to be right or wrong."""
    console.print(f"A  {result.a}\nB  {result.b}", highlight=False, markup=False, soft_wrap=True)
    show_changes(console, "they came about otherwise", result.made)
    show_changes(console, "the scenarios differ", result.scenario)
    judged = verdict and result.by == "time"
    show_outcome(console, result.outcome, judged)
    show_series(console, result.series, judged)
    if result.by == "message":
        show_messages(console, result.messages)
    for picture in result.pictures:
        console.print(f"picture: {picture}", highlight=False, markup=False, soft_wrap=True)
    if verdict:
        style = "green" if result.same else "red"
        console.print(_verdict(result), style=style, highlight=False, soft_wrap=True)


def _verdict(result: "Diff") -> str:
    if result.same and result.by == "time":
        count = len(result.outcome) + len(result.series)
        return f"the same within the tolerances: {count} figures and quantities"
    if result.same:
        within, identical = (
            sum(getattr(t, name) for t in result.messages) for name in ("within", "identical")
        )
        also = f", {within} within the tolerances" if within else ""
        return f"the same: {identical} messages identical{also}"
    if result.by == "message":
        differ = [topic.topic for topic in result.messages if not topic.same]
        return f"they differ on {len(differ)} of {len(result.messages)} topics"
    within = [*(row.within for row in result.outcome), *(row.within for row in result.series)]
    return f"they differ in {within.count(False)} of {len(within)} figures and quantities"


def show_changes(console: Console, title: str, changes: "tuple[FieldChange, ...]") -> None:
    """Fields that are not the same, for people."""
    if not changes:
        return
    table = Table(title, "A", "B", box=None, padding=(0, 2, 0, 0))
    for change in changes[:_SHOWN]:
        table.add_row(*(Text("-" if v is None else str(v)) for v in (change.field, change.a, change.b)))
    console.print(table)
    if len(changes) > _SHOWN:
        console.print(f"and {len(changes) - _SHOWN} more")


def show_outcome(console: Console, rows: "tuple[FigureRow, ...]", judged: bool) -> None:
    """The figures in which two runs differ, for people."""
    table = Table("outcome", box=None, padding=(0, 2, 0, 0))
    for heading in ("A", "B", "B - A"):
        table.add_column(heading, justify="right", no_wrap=True)
    differ = [row for row in rows if row.a != row.b]
    for row in differ:
        off = "" if row.difference is None else f"{row.difference:+.4g}"
        style = "red" if judged and not row.within else ""
        table.add_row(row.field, shown(row.a), shown(row.b), off, style=style)
    if differ:
        console.print(table)


def show_series(console: Console, rows: "tuple[Apart, ...]", judged: bool) -> None:
    """How far quantities over time are apart: of those that all robots have, the worst."""
    table = Table("over time", "worst", box=None, padding=(0, 2, 0, 0))
    for heading in ("largest |A - B|", "at / s", "A", "B", "rms"):
        table.add_column(heading, justify="right", no_wrap=True)
    groups: dict[str, list[Apart]] = {}
    for row in rows:
        groups.setdefault(f"{_kind(row.name)}:{row.field}", []).append(row)
    for name, group in groups.items():
        worst = max(group, key=lambda row: (judged and not row.within, bool(row.only), row.largest or 0.0))
        if worst.largest == 0.0:
            continue
        cells = [shown(number) for number in (worst.largest, worst.at_s, worst.a, worst.b, worst.rms)]
        if worst.largest is None:
            cells = [f"only in {worst.only}" if worst.only else "nothing to compare", "", "", "", ""]
        who = worst.name.split("/")[1] if "*" in name else ""
        table.add_row(name, who, *cells, style="red" if judged and not worst.within else "")
    if table.rows:
        console.print(table)


def show_messages(console: Console, topics: "tuple[TopicDifference, ...]", judged: bool = True) -> None:
    """How messages compare, robots together, and what differs in which field."""
    table = Table("messages of", box=None, padding=(0, 2, 0, 0))
    for heading in ("A", "B", "identical", "within", "beyond", "only in A", "only in B"):
        table.add_column(heading, justify="right", no_wrap=True)
    kinds: dict[str, list[TopicDifference]] = {}
    for topic in topics:
        kinds.setdefault(_kind(topic.topic), []).append(topic)
    for kind, group in kinds.items():
        if any(topic.identical < max(topic.a, topic.b) for topic in group):
            numbers = [
                sum(column)
                for column in zip(
                    *((t.a, t.b, t.identical, t.within, t.beyond, t.only_a, t.only_b) for t in group),
                    strict=True,
                )
            ]
            bad = judged and not all(topic.same for topic in group)
            table.add_row(kind, *map(str, numbers), style="red" if bad else "")
    if table.rows:
        console.print(table)
    for kind, group in kinds.items():
        for line in _remarks(kind, group):
            console.print(Text(line), soft_wrap=True)


def _remarks(kind: str, group: "list[TopicDifference]") -> Iterator[str]:
    """What there is to say of topics of one kind."""
    for side, found in (("A", [t.first_only_a for t in group]), ("B", [t.first_only_b for t in group])):
        firsts = [(which.at_s, which, topic) for which, topic in zip(found, group, strict=True) if which]
        if firsts:
            _, which, topic = min(firsts, key=itemgetter(0))
            yield f"{kind} only in {side}, the first: {topic.topic} of {_which(which)}"
    fields: dict[str, list[FieldDifference]] = {}
    for topic in group:
        for field in topic.fields:
            if field.beyond:
                fields.setdefault(field.field, []).append(field)
    for name, same in list(fields.items())[:_SHOWN]:
        first = min(same, key=lambda field: field.first.message.at_s)
        largest = max(same, key=lambda field: field.largest.difference or 0.0)
        count = sum(field.beyond for field in same)
        yield f"{kind}:{name} is beyond {shown(first.tolerance)} in {count} messages"
        yield f"  first: {_value(first, first.first)}"
        if largest.largest.difference is not None and largest.largest != first.first:
            yield f"  largest: {_value(largest, largest.largest)}"
    if len(fields) > _SHOWN:
        yield f"{kind}: and {len(fields) - _SHOWN} more fields"


def _kind(name: str) -> str:
    """A name without the robot or node."""
    head, _, rest = name.partition("/")
    if "/" in rest:
        return f"{head}/*/{rest.partition('/')[2]}"
    return f"{head}/*" if head in ("journal", "links") else name


def _value(field: "FieldDifference", value: "Value") -> str:
    off = "" if value.difference is None else f", {value.difference:.3g} apart"
    which = f"{field.topic} of {_which(value.message)}"
    return f"{value.field} {shown(value.a)} and {shown(value.b)}{off}; {which}"


def _which(which: "Which") -> str:
    life = f" (life {which.incarnation})" if which.incarnation > 1 else ""
    return f"{which.source}{life}, seq {which.seq}, at {which.at_s:.3f} s"


def shown(value: Any) -> str:
    """A value for people, short."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
