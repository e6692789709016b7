"""What a recording holds: channels, counts, rates, and gaps by sequence number."""

from collections import defaultdict
from collections.abc import Iterable

import msgspec

from maniple.core import topics
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.time import Time, to_seconds
from maniple.recording.reader import Recorded, Recording


class Gap(msgspec.Struct, frozen=True):
    """Sequence numbers that are missing, both ends included."""

    first: int
    last: int


class Stream(msgspec.Struct, frozen=True, kw_only=True):
    """The messages of one life of one sender on one topic; its `seq` counts from 0."""

    source: str
    incarnation: int
    received: int
    expected: int
    """From 0 to the highest `seq` seen; what was lost after that leaves no sign."""
    missing: int
    missed_first: int
    """How many are missing before the first one seen."""
    repeated: int
    """Messages whose `seq` had been seen before."""
    gaps: tuple[Gap, ...]
    """All that is missing, in order."""


class ChannelInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One topic of the recording."""

    topic: str
    type: str
    """Of its messages; empty for a topic that is not in the table."""
    messages: int
    rate_hz: float
    """Mean between its first message and its last; 0 for fewer than two."""
    bytes: int
    """Of the messages as they were on the wire."""
    missing: int
    headless: int
    """Messages that can't be attributed: no valid header."""
    streams: tuple[Stream, ...]


class Info(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording holds."""

    scenario: str
    version: str
    """Of the maniple that made it."""
    mode: str
    seed: str
    complete: bool
    """Whether the recorder finished the file."""
    start_ns: Time
    """Log time of the first message; 0 without any."""
    end_ns: Time
    duration_s: float
    messages: int
    bytes: int
    missing: int
    channels: tuple[ChannelInfo, ...]
    """By topic, sorted."""
    metadata: dict[str, str]


def describe(recording: Recording) -> Info:
    """Read all of a recording and say what it holds.

    Raises:
        RecordingError: the file is damaged.
    """
    tallies: defaultdict[str, _Channel] = defaultdict(_Channel)
    for record in recording.messages():
        tallies[record.topic].add(record)
    channels = tuple(tallies[name].info(name) for name in sorted(tallies))
    start = min((tally.start_ns for tally in tallies.values()), default=0)
    end = max((tally.end_ns for tally in tallies.values()), default=0)
    metadata = recording.metadata
    return Info(
        scenario=metadata.get("scenario", ""),
        version=metadata.get("maniple", ""),
        mode=metadata.get("mode", ""),
        seed=metadata.get("seed", ""),
        complete=recording.complete,
        start_ns=start,
        end_ns=end,
        duration_s=to_seconds(end - start),
        messages=sum(channel.messages for channel in channels),
        bytes=sum(channel.bytes for channel in channels),
        missing=sum(channel.missing for channel in channels),
        channels=channels,
        metadata=dict(metadata),
    )


def missing(parts: Iterable[Recording]) -> int:
    """How many messages are missing, by their sequence numbers, in the parts of one recording together.

    Raises:
        RecordingError: a file is damaged.
    """
    tallies: defaultdict[str, _Channel] = defaultdict(_Channel)
    for part in parts:
        for record in part.messages():
            tallies[record.topic].add(record)
    return sum(tally.info(name).missing for name, tally in tallies.items())


class _Channel:
    """What is counted of one topic while reading."""

    def __init__(self) -> None:
        self.start_ns: Time = 0
        self.end_ns: Time = 0
        self._messages = self._bytes = self._headless = 0
        self._streams: defaultdict[tuple[str, int], _Stream] = defaultdict(_Stream)

    def add(self, record: Recorded) -> None:
        """Count a message; they come in the order of log time."""
        if not self._messages:
            self.start_ns = record.log_time_ns
        self.end_ns = record.log_time_ns
        self._messages += 1
        self._bytes += len(record.data)
        try:
            header = header_of(record.topic, record.data)
        except MessageError:
            self._headless += 1
            return
        self._streams[header.source, header.incarnation].add(header.seq)

    def info(self, name: str) -> ChannelInfo:
        """The counts so far."""
        streams = tuple(stream.info(*key) for key, stream in sorted(self._streams.items()))
        span = to_seconds(self.end_ns - self.start_ns)
        return ChannelInfo(
            topic=name,
            type=_type_name(name),
            messages=self._messages,
            rate_hz=(self._messages - 1) / span if span else 0.0,
            bytes=self._bytes,
            missing=sum(stream.missing for stream in streams),
            headless=self._headless,
            streams=streams,
        )


class _Stream:
    """Which sequence numbers have been seen: all below `_next` but those in the gaps."""

    def __init__(self) -> None:
        self._next = self._received = self._repeated = 0
        self._gaps: list[Gap] = []

    def add(self, seq: int) -> None:
        """Note a sequence number, in whatever order they come."""
        self._received += 1
        if seq == self._next:
            self._next += 1
        elif seq > self._next:
            self._gaps.append(Gap(self._next, seq - 1))
            self._next = seq + 1
        elif not self._fill(seq):
            self._repeated += 1

    def _fill(self, seq: int) -> bool:
        """Take a late number out of its gap; False where it is in none."""
        for i in range(len(self._gaps) - 1, -1, -1):
            gap = self._gaps[i]
            if gap.first <= seq <= gap.last:
                parts = (Gap(gap.first, seq - 1), Gap(seq + 1, gap.last))
                self._gaps[i : i + 1] = [part for part in parts if part.first <= part.last]
                return True
        return False

    def info(self, source: str, incarnation: int) -> Stream:
        """The counts so far."""
        gaps = tuple(self._gaps)
        return Stream(
            source=source,
            incarnation=incarnation,
            received=self._received,
            expected=self._next,
            missing=sum(gap.last - gap.first + 1 for gap in gaps),
            missed_first=gaps[0].last + 1 if gaps and gaps[0].first == 0 else 0,
            repeated=self._repeated,
            gaps=gaps,
        )


def _type_name(topic: str) -> str:
    try:
        return topics.topic(topic).type.__name__
    except MessageError:
        return ""
