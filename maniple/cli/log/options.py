"""Options that the commands of `maniple log` share: which part of a recording is meant."""

from collections.abc import Sequence
from typing import Annotated, TypeAlias

import typer

from maniple.core.errors import ArgumentError
from maniple.core.time import Time, from_seconds, to_seconds
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection, matches

_LONGEST_S = 1e9

From: TypeAlias = Annotated[
    float | None,
    typer.Option("--from", metavar="SECONDS", help="From so many seconds after the first message on."),
]
Until: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--until",
        metavar="SECONDS",
        help="Only what is earlier than so many seconds after the first message.",
    ),
]
Topics: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="PATTERN",
        help="Only topics that match (robot/*/odometry, hw/**); may be repeated.",
        show_default=False,
    ),
]
Without: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--without",
        metavar="PATTERN",
        help="Leave out topics that match; may be repeated.",
        show_default=False,
    ),
]


def selection_of(
    recording: Recording,
    start_s: float | None = None,
    until_s: float | None = None,
    topics: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    others: Sequence[str] = (),
) -> Selection:
    """What these options select of the topics of a recording, and of `others`.

    Raises:
        ArgumentError: a pattern is not valid or matches no topic of the recording, or a time is not in it.
        RecordingError: the recording is damaged.
    """
    chosen = Selection(topics=tuple(topics or ()), without=tuple(without or ()))
    known = (*recording.topics, *others)
    for pattern in (*chosen.topics, *chosen.without):
        if not any(matches(pattern, topic) for topic in known):
            there = ", ".join(known) or "none"
            raise ArgumentError(f"no topic of {recording.path} matches {pattern!r}; there are {there}")
    if known and not any(map(chosen.takes, known)):
        raise ArgumentError(f"--topic and --without together leave nothing of {recording.path}")
    if start_s is None and until_s is None:
        return chosen
    start, end = (_moment(recording, *given) for given in (("--from", start_s), ("--until", until_s)))
    if start is not None and start > recording.end_ns:
        length = to_seconds(recording.end_ns - recording.start_ns)
        raise ArgumentError(f"--from {start_s:g}: {recording.path} ends after {length:.3f} s")
    if start_s is not None and until_s is not None and until_s <= start_s:
        raise ArgumentError(f"--from {start_s:g} --until {until_s:g}: must end after it begins")
    return Selection(start, end, chosen.topics, chosen.without)


def _moment(recording: Recording, option: str, seconds: float | None) -> Time | None:
    if seconds is None:
        return None
    least = "at least" if option == "--from" else "above"
    if not 0 <= seconds <= _LONGEST_S or (seconds == 0 and option == "--until"):
        raise ArgumentError(f"{option} {seconds:g}: must be {least} 0 and at most {_LONGEST_S:g} s")
    return recording.start_ns + from_seconds(seconds)
