"""Times of which a recording says itself that it does not hold them, and topics that it leaves out."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec

from maniple.core.errors import ArgumentError
from maniple.core.time import Time, to_seconds
from maniple.recording.selection import Selection
from maniple.recording.writer import METADATA_NAME

PAUSES_NAME = "maniple.pauses"
"""The metadata record that says when nothing was recorded, and why: `pauses`, a JSON list of `Pause`."""

KEPT_NAME = "maniple.kept"
"""The metadata record of what a recorder that only remembers the last seconds was told to keep."""

CUT_NAME = "maniple.cut"
"""The metadata record of what was cut from a longer recording: `cuts`, a JSON list of `Selection`, one after
the other."""

EVER: Time = 1 << 64
"""Later than any log time."""


class Pause(msgspec.Struct):
    """A time in which nothing was recorded, because somebody asked for that."""

    from_ns: Time
    """Log time."""
    reason: str
    until_ns: Time | None = None
    """None while it lasts, and where the recorder died in it."""
    messages: int = 0
    """That arrived and were left out."""


class Absence(NamedTuple):
    """A span of log time."""

    from_ns: Time
    until_ns: Time
    why: str


class Absences:
    """What a recording leaves out on purpose, by the metadata of its parts; `start_ns` is its beginning."""

    def __init__(self, metadata: Sequence[Mapping[str, Mapping[str, str]]], start_ns: Time) -> None:
        self.spans: list[Absence] = []
        """When."""
        self.filters: list[tuple[Selection, str]] = []
        """What is taken, and what to say of the rest."""
        about = metadata[0].get(METADATA_NAME, {})
        if about.get("part", "1") != "1":
            self.spans.append(Absence(0, start_ns, "in earlier parts"))
        if KEPT_NAME in metadata[0]:
            self.spans.append(Absence(0, start_ns, "before what was kept"))
        for part in metadata:
            self._leave_out(_filter_of(part.get(METADATA_NAME, {})), "not recorded, as the recorder was told")
            for selection in cuts_of(part.get(CUT_NAME, {})):
                self._leave_out(selection, "cut off")
            for pause in pauses_of(part.get(PAUSES_NAME, {})):
                until = EVER if pause.until_ns is None else pause.until_ns
                self.spans.append(
                    Absence(pause.from_ns, until, f"paused: {pause.reason or 'no reason given'}")
                )
        self.spans = list(dict.fromkeys(self.spans))

    def holds(self, topic: str, from_ns: Time | None, until_ns: Time | None) -> bool:
        """Whether what is missing of a topic between two messages (None: before the first, after the last)
        was left out on purpose."""
        if not all(selection.takes(topic) for selection, _ in self.filters):
            return True
        first, last = from_ns or 0, EVER if until_ns is None else until_ns
        return any(span.from_ns < last and span.until_ns > first for span in self.spans)

    def texts(self, start_ns: Time) -> tuple[str, ...]:
        """The same for people; times count from `start_ns`."""
        found = []
        for span in self.spans:
            ends = []
            if span.from_ns > start_ns:
                ends.append(f"from {to_seconds(span.from_ns - start_ns):.3f} s")
            if span.until_ns < EVER:
                ends.append(f"until {to_seconds(span.until_ns - start_ns):.3f} s")
            found.append(f"{' '.join(ends)}: {span.why}")
        for selection, why in self.filters:
            others = [f"other topics than {', '.join(selection.topics)}"] if selection.topics else []
            found.append(f"{', '.join([*selection.without, *others])}: {why}")
        return tuple(found)

    def _leave_out(self, selection: Selection, why: str) -> None:
        if selection.start_ns is not None:
            self.spans.append(Absence(0, selection.start_ns, why))
        if selection.end_ns is not None:
            self.spans.append(Absence(selection.end_ns, EVER, why))
        if (selection.topics or selection.without) and (selection, why) not in self.filters:
            self.filters.append((selection, why))


def cuts_of(said: Mapping[str, str]) -> list[Selection]:
    """What was cut out of what, by the metadata record; none where it can't be read."""
    try:
        return msgspec.json.decode(said.get("cuts", "[]"), type=list[Selection])
    except (msgspec.MsgspecError, ArgumentError):
        return []


def pauses_of(said: Mapping[str, str]) -> list[Pause]:
    """When nothing was recorded, by the metadata record; never where it can't be read."""
    try:
        return msgspec.json.decode(said.get("pauses", "[]"), type=list[Pause])
    except msgspec.MsgspecError:
        return []


def _filter_of(said: Mapping[str, str]) -> Selection:
    """What a recorder was told to record."""
    try:
        return Selection(
            topics=tuple(said.get("topics", "").split()), without=tuple(said.get("without", "").split())
        )
    except ArgumentError:
        return Selection()
