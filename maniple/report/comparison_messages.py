"""The messages of two runs, one by one: those of the same topic, sender, life and number belong together."""

import re
from collections.abc import Iterable, Iterator
from functools import lru_cache
from heapq import merge
from operator import itemgetter
from typing import Any, Literal, TypeAlias

import msgspec

from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.time import Time, to_seconds
from maniple.recording.compare import differences
from maniple.recording.reader import Recorded
from maniple.report.comparison_tolerances import Tolerances

Side: TypeAlias = Literal["A", "B"]

BYTES = "bytes"
"""The field of a message that can't be decoded."""

_INDEX = re.compile(r"\[\d+\]")
_KEY = re.compile(r"\[(?!\d+\])([^]]*)\]")
_LENGTH = re.compile(r"len\((.*)\)")


class Which(msgspec.Struct, frozen=True):
    """One message."""

    source: str
    incarnation: int
    seq: int
    at_s: float
    """When it was sent, s since the start."""


class Value(msgspec.Struct, frozen=True):
    """One value in which two messages differ."""

    message: Which
    """In A."""
    field: str
    """With its indices; of an array of another length `.length`."""
    a: Any
    b: Any
    """None where there is no such value."""
    difference: float | None
    """|A - B|; None where they are no numbers."""


class FieldDifference(msgspec.Struct, frozen=True):
    """What differs in one field of the messages of a topic."""

    topic: str
    field: str
    """Without indices: of an array, or of a list, all entries together."""
    messages: int
    """In how many it differs at all."""
    beyond: int
    """In how many by more than its tolerance."""
    tolerance: float
    """Of the first value; entries may have others."""
    first: Value
    """The first that is beyond its tolerance; where none is, the first that differs."""
    largest: Value


class TopicDifference(msgspec.Struct, frozen=True):
    """How the messages of a topic compare."""

    topic: str
    a: int
    b: int
    """Messages of each."""
    identical: int
    """To the byte."""
    within: int
    """Others that are no more than their tolerances apart."""
    beyond: int
    only_a: int
    only_b: int
    first_only_a: Which | None
    first_only_b: Which | None
    fields: tuple[FieldDifference, ...]

    @property
    def same(self) -> bool:
        """Whether nothing is beyond its tolerance, and nothing missing."""
        return not (self.beyond or self.only_a or self.only_b)


class _Field:
    """What was found in one field."""

    __slots__ = ("beyond", "first", "is_beyond", "largest", "messages", "tolerance")

    def __init__(self, value: Value, tolerance: float) -> None:
        self.first = self.largest = value
        self.tolerance = tolerance
        self.messages = self.beyond = 0
        self.is_beyond = False

    def add(self, value: Value, is_beyond: bool) -> None:
        if is_beyond and not self.is_beyond:
            self.first, self.is_beyond = value, True
        if _size(value) > _size(self.largest):
            self.largest = value


class _Stream:
    """The messages of one life of a sender on a topic that have no counterpart yet."""

    __slots__ = ("ahead", "done", "waiting")

    def __init__(self) -> None:
        self.waiting: dict[int, tuple[Side, Recorded]] = {}
        self.done = -1
        self.ahead: set[int] = set()

    def matched(self, seq: int) -> None:
        self.ahead.add(seq)
        while self.done + 1 in self.ahead:
            self.done += 1
            self.ahead.remove(self.done)

    def has_matched(self, seq: int) -> bool:
        return seq <= self.done or seq in self.ahead


class _Topic:
    """What was found on one topic."""

    __slots__ = ("beyond", "counts", "fields", "identical", "within")

    def __init__(self) -> None:
        self.counts = {"A": 0, "B": 0}
        self.identical = self.within = self.beyond = 0
        self.fields: dict[str, _Field] = {}


class MessageComparison:
    """Takes the messages of both runs in any order; those without a counterpart yet are held in memory.

    `start` is the time that `at_s` counts from, on the clocks of the senders. A message that is there twice
    counts once.
    """

    def __init__(self, tolerances: Tolerances, start: Time) -> None:
        self._tolerances = tolerances
        self._start = start
        self._topics: dict[str, _Topic] = {}
        self._streams: dict[tuple[str, str, int], _Stream] = {}
        self._rules: dict[tuple[str, str], tuple[str, float | None]] = {}

    def add(self, side: Side, record: Recorded) -> None:
        """Take a message of one run."""
        try:
            header = header_of(record.topic, record.data)
            key, seq = (record.topic, header.source, header.incarnation), header.seq
        except MessageError:
            key, seq = (record.topic, "", 0), record.sequence
        stream = self._streams.get(key)
        if stream is None:
            if self._tolerances.ignores(record.topic):
                return
            stream = self._streams[key] = _Stream()
        waiting = stream.waiting.get(seq)
        if (waiting is not None and waiting[0] == side) or stream.has_matched(seq):
            return
        topic = self._topics.get(record.topic) or self._topics.setdefault(record.topic, _Topic())
        topic.counts[side] += 1
        if waiting is None:
            stream.waiting[seq] = side, record
            return
        del stream.waiting[seq]
        stream.matched(seq)
        a, b = (waiting[1], record) if side == "B" else (record, waiting[1])
        if a.data == b.data:
            topic.identical += 1
        else:
            self._compare(topic, a, b, Which(key[1], key[2], seq, self._at(a)))

    def result(self) -> tuple[TopicDifference, ...]:
        """What was found so far, by topic; what has no counterpart is missing in the other run."""
        only: dict[tuple[str, Side], list[Which]] = {}
        for (topic, source, life), stream in self._streams.items():
            for seq, (side, record) in stream.waiting.items():
                only.setdefault((topic, side), []).append(Which(source, life, seq, self._at(record)))
        return tuple(
            TopicDifference(
                topic=name,
                a=found.counts["A"],
                b=found.counts["B"],
                identical=found.identical,
                within=found.within,
                beyond=found.beyond,
                only_a=len(only.get((name, "A"), ())),
                only_b=len(only.get((name, "B"), ())),
                first_only_a=min(only.get((name, "A"), ()), key=_when, default=None),
                first_only_b=min(only.get((name, "B"), ()), key=_when, default=None),
                fields=tuple(
                    FieldDifference(
                        name, field, one.messages, one.beyond, one.tolerance, one.first, one.largest
                    )
                    for field, one in found.fields.items()
                ),
            )
            for name, found in sorted(self._topics.items())
        )

    def _at(self, record: Recorded) -> float:
        return to_seconds(record.publish_time_ns - self._start)

    def _compare(self, topic: _Topic, a: Recorded, b: Recorded, which: Which) -> None:
        """Compare two messages whose bytes differ."""
        differing, beyond = set[str](), set[str]()
        for path, one, other in _values(a, b):
            field, tolerance = self._rules.get((a.topic, path)) or self._rule(a.topic, path)
            if tolerance is None:
                continue
            size = abs(float(one) - float(other)) if _is_number(one) and _is_number(other) else None
            value = Value(which, path, one, other, size)
            found = topic.fields.get(field)
            if found is None:
                found = topic.fields[field] = _Field(value, tolerance)
            differing.add(field)
            if is_beyond := size is None or size > tolerance:
                beyond.add(field)
            found.add(value, is_beyond)
        for field in differing:
            topic.fields[field].messages += 1
        for field in beyond:
            topic.fields[field].beyond += 1
        if beyond:
            topic.beyond += 1
        else:
            topic.within += 1

    def _rule(self, topic: str, path: str) -> tuple[str, float | None]:
        """A field without indices, and its tolerance; None where it is ignored."""
        ignored = self._tolerances.ignores(topic, path)
        rule = _INDEX.sub("", path), None if ignored else self._tolerances.of(topic, path)
        self._rules[topic, path] = rule
        return rule


def compared(
    a: Iterable[Recorded], b: Iterable[Recorded], starts: tuple[Time, Time], tolerances: Tolerances
) -> tuple[TopicDifference, ...]:
    """The messages of two runs compared; `starts` are the times at which they began."""
    comparison = MessageComparison(tolerances, starts[0])
    for _, side, record in merge(_timed("A", a, starts[0]), _timed("B", b, starts[1]), key=itemgetter(0)):
        comparison.add(side, record)
    return comparison.result()


def _timed(side: Side, records: Iterable[Recorded], start: Time) -> Iterator[tuple[Time, Side, Recorded]]:
    return ((record.log_time_ns - start, side, record) for record in records)


def _values(a: Recorded, b: Recorded) -> Iterator[tuple[str, Any, Any]]:
    """Paths and values in which two messages differ: as bytes where one can't be decoded."""
    one, other = a.message, b.message
    if one is None or other is None or type(one) is not type(other):
        yield BYTES, a.data.hex(), b.data.hex()
    else:
        for path, first, second in differences(one, other):
            yield _named(path), first, second


@lru_cache(65536)
def _named(path: str) -> str:
    """A path as tolerances have it: `counters.received`, `errors.length`."""
    return _KEY.sub(r".\1", _LENGTH.sub(r"\1.length", path))


def _size(value: Value) -> float:
    return -1.0 if value.difference is None else value.difference


def _when(which: Which) -> float:
    return which.at_s


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
