"""What a recording holds: channels, counts, rates, and what is missing by sequence number."""

from collections import defaultdict
from functools import cached_property

import msgspec
from msgspec import structs

from maniple.core import topics
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.messages import Journal
from maniple.core.time import Time, to_seconds
from maniple.recording.absence import Absences
from maniple.recording.other_scenarios import OtherScenarios
from maniple.recording.reader import Recorded, Recording
from maniple.recording.scan import Damage, checksum_of
from maniple.recording.tally import Gap, Stream, Tally


class StreamInfo(Stream, frozen=True, kw_only=True):
    """The same, with what is missing on purpose told apart."""

    left_out: int
    """Missing because of a pause, a filter or a cut; not counted in `missing`, but in `gaps`."""


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
    left_out: int
    headless: int
    """Messages that can't be attributed: no valid header."""
    unreadable: int
    """Messages that are none of the topic's type, as this version has it; those of unknown topics not among
    them."""
    streams: tuple[StreamInfo, ...]


class Info(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording holds."""

    scenario: str
    version: str
    """Of the maniple that made it."""
    mode: str
    seed: str
    parts: tuple[str, ...]
    """Its files, in order."""
    passed_over: tuple[str, ...]
    """What there is to say of parts in which nothing is."""
    lacking: str
    """What there is to say of a part that ought to follow and is not there; empty where none ought to."""
    complete: bool
    """Whether the recorder finished the file, or all of them."""
    torn_bytes: int
    """At the end of an unfinished file, of a message or chunk that was being written."""
    damage: tuple[str, ...]
    """What is not as it was written."""
    start_ns: Time
    """Log time of the first message; 0 without any."""
    end_ns: Time
    duration_s: float
    messages: int
    bytes: int
    missing: int
    """By sequence number and the senders' journals, without what was left out on purpose."""
    left_out: int
    absences: tuple[str, ...]
    """What was left out on purpose."""
    other_scenarios: tuple[str, ...]
    """What there is to say of nodes that ran another scenario than the one in the recording."""
    viewer_channels: int
    """Channels of what was derived for viewers, beside those of the messages."""
    channels: tuple[ChannelInfo, ...]
    """By topic, sorted."""
    metadata: dict[str, str]


def describe(recording: Recording) -> Info:
    """Read all of a recording and say what it holds. Damage is reported; what is whole is counted.

    Raises:
        RecordingError: a file can't be read any more.
    """
    damage: list[Damage] = []
    reading = _Reading(recording)
    for record in recording.messages(skipped=damage.append):
        reading.add(record)
    if not damage:
        damage += filter(None, map(checksum_of, recording.layouts))
    channels = reading.channels()
    metadata = recording.metadata
    return Info(
        scenario=metadata.get("scenario", ""),
        version=metadata.get("maniple", ""),
        mode=metadata.get("mode", ""),
        seed=metadata.get("seed", ""),
        parts=tuple(map(str, recording.paths)),
        passed_over=recording.passed_over,
        lacking=recording.lacking,
        complete=recording.complete,
        torn_bytes=sum(layout.torn for layout in recording.layouts),
        damage=tuple(map(str, damage)),
        start_ns=reading.start_ns,
        end_ns=reading.end_ns,
        duration_s=to_seconds(reading.end_ns - reading.start_ns),
        messages=sum(channel.messages for channel in channels),
        bytes=sum(channel.bytes for channel in channels),
        missing=sum(channel.missing for channel in channels),
        left_out=sum(channel.left_out for channel in channels),
        absences=reading.absences.texts(reading.start_ns),
        other_scenarios=reading.others.texts,
        viewer_channels=len(recording.viewer_keys),
        channels=channels,
        metadata=dict(metadata),
    )


class _Reading:
    """What is counted while reading; messages come in the order of log time."""

    def __init__(self, recording: Recording) -> None:
        self.start_ns: Time = 0
        self.end_ns: Time = 0
        self._recording = recording
        self._tally = Tally()
        self.others = OtherScenarios(recording.scenario_json)
        """Who ran another scenario."""
        self._channels: defaultdict[str, _Channel] = defaultdict(_Channel)
        self._last: dict[tuple[str, str, int], tuple[int, Time]] = {}
        """The number after the highest of each stream, and when that arrived."""
        self._left_out: defaultdict[tuple[str, str, int], list[Gap]] = defaultdict(list)

    @cached_property
    def absences(self) -> Absences:
        """What the recording leaves out on purpose."""
        return Absences(self._recording.all_metadata, self.start_ns)

    def add(self, record: Recorded) -> None:
        """Count a message."""
        self.end_ns = record.log_time_ns
        if not self._channels:
            self.start_ns = record.log_time_ns
        channel = self._channels[record.topic]
        channel.add(record)
        try:
            header = header_of(record.topic, record.data)
        except MessageError:
            channel.headless += 1
            return
        self._note((record.topic, header.source, header.incarnation), header.seq, record.log_time_ns)
        message = record.message
        if message is None:
            channel.unreadable += 1
        elif isinstance(message, Journal):
            self._tally.told(header.source, header.incarnation, message.sent)
            self.others.heard(message)

    def channels(self) -> tuple[ChannelInfo, ...]:
        """All topics of which something is there, or ought to be."""
        streams: defaultdict[str, list[StreamInfo]] = defaultdict(list)
        for stream in self._tally.streams():
            streams[stream.topic].append(self._explained(stream))
        return tuple(
            self._channels[name].info(name, tuple(streams[name]))
            for name in sorted(self._channels.keys() | streams.keys())
        )

    def _note(self, key: tuple[str, str, int], seq: int, now: Time) -> None:
        self._tally.note(*key, seq)
        following, last = self._last.get(key, (0, None))
        if seq >= following:
            if seq > following and self.absences.holds(key[0], last, now):
                self._left_out[key].append(Gap(following, seq - 1))
            self._last[key] = seq + 1, now

    def _explained(self, stream: Stream) -> StreamInfo:
        key = stream.topic, stream.source, stream.incarnation
        spans = self._left_out[key]
        following, last = self._last.get(key, (0, None))
        if stream.sent > following and self.absences.holds(stream.topic, last, None):
            spans.append(Gap(following, stream.sent - 1))
        left_out = sum(
            max(0, min(gap.last, span.last) - max(gap.first, span.first) + 1)
            for gap in stream.gaps
            for span in spans
        )
        return StreamInfo(
            **{**structs.asdict(stream), "missing": stream.missing - left_out}, left_out=left_out
        )


class _Channel:
    """What is counted of one topic while reading."""

    def __init__(self) -> None:
        self.headless = self.unreadable = 0
        self._start_ns: Time = 0
        self._end_ns: Time = 0
        self._messages = self._bytes = 0

    def add(self, record: Recorded) -> None:
        """Count a message."""
        if not self._messages:
            self._start_ns = record.log_time_ns
        self._end_ns = record.log_time_ns
        self._messages += 1
        self._bytes += len(record.data)

    def info(self, name: str, streams: tuple[StreamInfo, ...]) -> ChannelInfo:
        """The counts so far."""
        span = to_seconds(self._end_ns - self._start_ns)
        type_name = _type_name(name)
        return ChannelInfo(
            topic=name,
            type=type_name,
            messages=self._messages,
            rate_hz=(self._messages - 1) / span if span else 0.0,
            bytes=self._bytes,
            missing=sum(stream.missing for stream in streams),
            left_out=sum(stream.left_out for stream in streams),
            headless=self.headless,
            unreadable=self.unreadable if type_name else 0,
            streams=streams,
        )


def _type_name(topic: str) -> str:
    try:
        return topics.topic(topic).type.__name__
    except MessageError:
        return ""
