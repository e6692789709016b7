"""Two recordings compared: their scenarios, outcomes, quantities over time, and messages."""

from pathlib import Path
from typing import Literal, TypeAlias

import msgspec

from maniple.core.errors import ArgumentError, MissingExtraError
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection
from maniple.report.comparison import (
    OUTCOME,
    Apart,
    FieldChange,
    FigureRow,
    Pair,
    apart,
    outcome_rows,
    pairs_of,
    quantities,
    scenario_changes,
)
from maniple.report.comparison_messages import TopicDifference, compared
from maniple.report.comparison_tolerances import Tolerances
from maniple.report.series import series_of

By: TypeAlias = Literal["message", "time"]


class Diff(msgspec.Struct, frozen=True):
    """What two recordings have in common and what not."""

    a: str
    b: str
    by: By
    """By what they were judged: message by message, or by quantities over time and the outcome."""
    same: bool
    """Whether nothing is beyond its tolerance."""
    scenario: tuple[FieldChange, ...]
    made: tuple[FieldChange, ...]
    """In what they came about otherwise: version, mode, machine, ..."""
    outcome: tuple[FigureRow, ...]
    series: tuple[Apart, ...]
    messages: tuple[TopicDifference, ...]
    """Empty where they were judged by time."""
    pictures: tuple[str, ...] = ()


class Compared(msgspec.Struct, frozen=True):
    """A comparison, with what pictures are drawn from."""

    diff: Diff
    pairs: tuple[Pair, ...]


def usual_way(a: Recording, b: Recording) -> By:
    """By what two recordings are judged unless somebody says otherwise: the numbers of messages mean the same
    in virtual time only."""
    return "message" if all(one.metadata.get("mode") == "virtual" for one in (a, b)) else "time"


def compare(
    a: Recording,
    b: Recording,
    tolerances: Tolerances,
    by: By | None = None,
    selection: Selection | None = None,
) -> Compared:
    """Compare two recordings; `selection` is of A, and chooses the messages that count.

    Raises:
        RecordingError: one is damaged, or its scenario can't be read.
    """
    way = by or usual_way(a, b)
    series = series_of(a), series_of(b)
    pairs = pairs_of(*(quantities(*both) for both in zip((a, b), series, strict=True)))
    outcome = outcome_rows(series[0].figures, series[1].figures, tolerances)
    over_time = tuple(apart(pairs, tolerances))
    messages: tuple[TopicDifference, ...] = ()
    if way == "message":
        chosen = selection or Selection()
        starts = a.start_ns, b.start_ns
        messages = compared(
            a.selected(chosen), b.selected(_shifted(chosen, starts[1] - starts[0])), starts, tolerances
        )
        same = all(topic.same for topic in messages)
    else:
        same = all(row.within for row in outcome) and all(row.within for row in over_time)
    made = a.metadata.keys() | b.metadata.keys()
    return Compared(
        Diff(
            a=str(a.path),
            b=str(b.path),
            by=way,
            same=same,
            scenario=scenario_changes(a.scenario, b.scenario),
            made=tuple(
                FieldChange(name, a.metadata.get(name), b.metadata.get(name))
                for name in sorted(made)
                if a.metadata.get(name) != b.metadata.get(name)
            ),
            outcome=outcome,
            series=over_time,
            messages=messages,
        ),
        pairs,
    )


def names_of(found: Compared, a: Recording, b: Recording) -> frozenset[str]:
    """The names that tolerances can be for."""
    if found.diff.by == "message":
        return frozenset({*a.topics, *b.topics})
    return frozenset({OUTCOME, *(pair.name for pair in found.pairs)})


def draw(pairs: tuple[Pair, ...], names: tuple[str, str], folder: Path) -> tuple[str, ...]:
    """Draw pictures of a comparison into a folder; returns their paths.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ArgumentError: the folder is none.
        ManipleError: they can't be written.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingExtraError("--plot", "report") from None
    from maniple.report.comparison_plot import write

    return tuple(map(str, write(pairs, names, folder)))


def require_by_message(by: By, **options: object) -> None:
    """Refuse options that choose messages where none are compared.

    Raises:
        ArgumentError: one is given; says which.
    """
    for name, value in options.items():
        if by == "time" and value not in (None, [], ()):
            raise ArgumentError(
                f"--{name} chooses messages, and these recordings are compared by time; "
                "use --ignore, or --by message"
            )


def _shifted(selection: Selection, by_ns: int) -> Selection:
    start, end = selection.start_ns, selection.end_ns
    return msgspec.structs.replace(
        selection,
        start_ns=None if start is None else start + by_ns,
        end_ns=None if end is None else end + by_ns,
    )
