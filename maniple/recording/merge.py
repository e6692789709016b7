"""Recordings that several recorders made of one run, in one: each message once, on one clock."""

import zlib
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from heapq import merge as merge_sorted
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeAlias

import msgspec

from maniple.core.envelope import header_of
from maniple.core.errors import ArgumentError, MessageError, RecordingError
from maniple.core.time import Time
from maniple.recording.absence import CUT_NAME, EVER, PAUSES_NAME, Pause, pauses_of
from maniple.recording.offset import Offset, offset_of
from maniple.recording.reader import Recording
from maniple.recording.rewrite import Rewriter, beside
from maniple.recording.scan import Layout, RawMessage
from maniple.recording.split import GOES_ON_NAME
from maniple.recording.tally import GAPS_NAME
from maniple.recording.writer import METADATA_NAME, attachment_of

MERGED_NAME = "maniple.merged"
"""The metadata record of what a recording was merged from: `sources`, a JSON list of `Source`, and
`differing`, how many messages were not the same in all of them."""

_SHOWN = 10
_LEAP = 1 << 16
_NOBODY, _TAKEN = -1, -2

Identity: TypeAlias = tuple[str, str, int]
"""Topic, source and incarnation."""


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """One of the recordings."""

    files: tuple[str, ...]
    messages: int
    only_here: int
    """Messages that none of those before it has."""
    offset: Offset | None
    """None for the one whose clock is kept, and where recorders say that they have one clock."""


class Difference(msgspec.Struct, frozen=True):
    """A message of which there are two."""

    topic: str
    source: str
    incarnation: int
    seq: int
    file: str
    """Where it is not as in the recordings before."""


class Merged(msgspec.Struct, frozen=True, kw_only=True):
    """What came of it."""

    out: str
    """Empty where nothing was written."""
    messages: int
    sources: tuple[Source, ...]
    """The first is the one whose clock is kept."""
    differing: int
    """Messages that are not the same in two recordings: one of them was changed."""
    differences: tuple[Difference, ...]
    """The first of them."""
    missing: int
    """Messages that the new recording lacks, by sequence number and the senders' journals."""


def merge(
    recordings: Sequence[Recording], out: Path | None = None, reference: int = 0, take_reference: bool = False
) -> Merged:
    """Write one recording of several, by default FILE-merged.mcap, beside the first; the clock is that of the
    one at index `reference`. What was derived for viewers is taken from that one.

    Where a message is not the same in two recordings, nothing is written unless `take_reference`: then the
    one counts that is in the reference, or in the first that has it.

    Raises:
        ArgumentError: fewer than two recordings, or one twice.
        RecordingError: they are not of one run, nothing says what their clocks have to do with each other,
            one of them is damaged, or the new file exists or can't be made.
    """
    _require_one_run(recordings)
    ordered = [recordings[reference], *recordings[:reference], *recordings[reference + 1 :]]
    known = _Known()
    aligned: list[_Aligned] = []
    waiting = ordered
    while waiting:
        tried = chain(
            (_align(recording, known, aligned) for recording in waiting),
            (_of_one_clock(recording, aligned) for recording in waiting),
        )
        found = next((one for one in tried if one is not None), None)
        if found is None:
            raise RecordingError(
                f"{waiting[0].path} has no message in common with {aligned[0].recording.path}, and they do "
                "not say that their recorders had one clock: which time of one is which of the other is not "
                "known"
            )
        known.learn(found, len(aligned))
        aligned.append(found)
        waiting = [one for one in waiting if one is not found.recording]
    sources = tuple(
        Source(
            files=tuple(map(str, one.recording.paths)),
            messages=known.counts[index],
            only_here=known.new[index],
            offset=one.offset,
        )
        for index, one in enumerate(aligned)
    )
    differing = len(known.differences)
    target = out or beside(recordings[0].path, "merged")
    messages = missing = 0
    if take_reference or not differing:
        messages, missing = _write(target, aligned, known, sources)
    return Merged(
        out=str(target) if take_reference or not differing else "",
        messages=messages,
        sources=sources,
        differing=differing,
        differences=tuple(known.differences[:_SHOWN]),
        missing=missing,
    )


class _Aligned(NamedTuple):
    """A recording whose clock is understood."""

    recording: Recording
    offset: Offset | None

    def right(self, time: Time) -> Time:
        """A log time by the clock that is kept."""
        return time if self.offset is None else max(0, self.offset.right(time))


class _Stream:
    """What is known of the messages of one life of a sender on one topic, by sequence number."""

    def __init__(self) -> None:
        self._dense = array("Q"), array("q"), array("h")
        self._sparse: dict[int, tuple[int, Time, int]] = {}

    def get(self, seq: int) -> tuple[int, Time, int] | None:
        """Checksum, log time and who had it first."""
        crcs, times, owners = self._dense
        if seq < len(owners) and owners[seq] != _NOBODY:
            return crcs[seq], times[seq], owners[seq]
        return self._sparse.get(seq)

    def put(self, seq: int, crc: int, time: Time, owner: int) -> None:
        """Note a message."""
        crcs, times, owners = self._dense
        if seq > len(owners) + _LEAP or time >= 1 << 63:
            self._sparse[seq] = crc, time, owner
            return
        while len(owners) <= seq:
            crcs.append(0)
            times.append(0)
            owners.append(_NOBODY)
        crcs[seq], times[seq], owners[seq] = crc, time, owner


class _Known:
    """The messages of all recordings so far, by who sent them and their numbers."""

    def __init__(self) -> None:
        self._streams: defaultdict[Identity, _Stream] = defaultdict(_Stream)
        self._headless: dict[tuple[str, bytes], int] = {}
        self.counts: list[int] = []
        """Messages of each recording."""
        self.new: list[int] = []
        """Messages of each recording that none before it has."""
        self.differences: list[Difference] = []

    def times(self, recording: Recording) -> Iterator[tuple[Time, Time]]:
        """Of every message that is known and in a recording: its log times there, and as it is known."""
        for record in recording.messages():
            try:
                header = header_of(record.topic, record.data)
            except MessageError:
                continue
            stream = self._streams.get((record.topic, header.source, header.incarnation))
            if stream is not None and (known := stream.get(header.seq)) is not None:
                yield record.log_time_ns, known[1]

    def learn(self, one: "_Aligned", index: int) -> None:
        """Take in the messages of a recording, the `index`-th."""
        count = new = 0
        for record in one.recording.messages():
            count += 1
            topic, data = record.topic, record.data
            try:
                header = header_of(topic, data)
            except MessageError:
                new += self._headless.setdefault((topic, data), index) == index
                continue
            stream = self._streams[topic, header.source, header.incarnation]
            crc, known = zlib.crc32(data), stream.get(header.seq)
            if known is None:
                stream.put(header.seq, crc, one.right(record.log_time_ns), index)
                new += 1
            elif known[0] != crc:
                file = str(one.recording.path)
                mark = topic, header.source, header.incarnation, header.seq
                self.differences.append(Difference(*mark, file))
        self.counts.append(count)
        self.new.append(new)

    def take(self, topic: str, data: bytes, index: int) -> bool:
        """Whether this is the copy of a message that counts; each is taken once."""
        try:
            header = header_of(topic, data)
        except MessageError:
            return self._headless.get((topic, data)) == index
        stream = self._streams[topic, header.source, header.incarnation]
        known = stream.get(header.seq)
        if known is None or known[2] != index or known[0] != zlib.crc32(data):
            return False
        stream.put(header.seq, known[0], known[1], _TAKEN)
        return True


def _align(recording: Recording, known: _Known, aligned: Sequence[_Aligned]) -> _Aligned | None:
    """A recording with what its clock is ahead by; None where no message tells yet."""
    if not aligned:
        return _Aligned(recording, None)
    theirs, ours = array("q"), array("q")
    for there, here in known.times(recording):
        if there < 1 << 63:
            theirs.append(there)
            ours.append(here)
    if theirs:
        return _Aligned(recording, offset_of(theirs, ours))
    return None


def _of_one_clock(recording: Recording, aligned: Sequence[_Aligned]) -> _Aligned | None:
    """A recording without a message in common, if it says that its clock is that of the first."""
    about, first = recording.metadata, aligned[0].recording.metadata
    virtual = about.get("mode") == first.get("mode") == "virtual"
    anchor = about.get("anchor")
    if virtual or (anchor and anchor == first.get("anchor")):
        return _Aligned(recording, None)
    return None


def _require_one_run(recordings: Sequence[Recording]) -> None:
    """See that recordings can be of one run.

    Raises:
        ArgumentError: there are fewer than two, or one is there twice.
        RecordingError: they are of different runs.
    """
    if len(recordings) < 2:
        raise ArgumentError("to merge takes two recordings or more")
    paths = [path.resolve() for recording in recordings for path in recording.paths]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise ArgumentError(
            f"{twice} is there twice; the parts of a recording (FILE, FILE-2, ...) come with it"
        )
    first = recordings[0]
    for other in recordings[1:]:
        both = f"{first.path} and {other.path}"
        if other.scenario_json != first.scenario_json or other.prefix != first.prefix:
            raise RecordingError(f"{both} are not of one run: their scenarios differ")
        for name in ("mode", "anchor"):
            values = [one.metadata.get(name) for one in (first, other)]
            if None not in values and values[0] != values[1]:
                raise RecordingError(f"{both} are not of one run: {name} {values[0]} and {values[1]}")


def _write(
    target: Path, aligned: Sequence[_Aligned], known: _Known, sources: Sequence[Source]
) -> tuple[int, int]:
    """Write the new recording; returns its messages and how many are missing."""
    metadata = _common([one.recording for one in aligned])
    if pauses := _pauses(aligned):
        metadata[PAUSES_NAME] = {"pauses": msgspec.json.encode(pauses).decode()}
    metadata[MERGED_NAME] = {
        "sources": msgspec.json.encode(sources).decode(),
        "differing": str(len(known.differences)),
    }
    earliest = min(aligned, key=lambda one: one.right(one.recording.start_ns))
    latched = [
        attachment_of(held._replace(log_time_ns=earliest.right(held.log_time_ns)))
        for held in earliest.recording.latched
    ]
    messages = 0
    attachments = [*aligned[0].recording.attachments, *latched]
    with Rewriter(target, metadata, attachments) as writer:
        everything = (_timed(one, index) for index, one in enumerate(aligned))
        for time, index, layout, raw, topic in merge_sorted(*everything, key=itemgetter(0, 1)):
            if not topic:
                writer.add(layout, raw, topic, time)
            elif known.take(topic, raw.data, index):
                messages += 1
                writer.add(layout, raw, topic, time)
        writer.note_gaps()
        return messages, sum(stream.missing for stream in writer.tally.streams())


def _timed(one: _Aligned, index: int) -> Iterator[tuple[Time, int, Layout, RawMessage, str]]:
    """The messages of a recording by the clock that is kept; only of the first what viewers draw, too."""
    recording = one.recording
    for layout, raw, topic in recording.raw(lambda key: index == 0 or recording.topic_of(key) != ""):
        yield one.right(raw.log_time_ns), index, layout, raw, topic


def _pauses(aligned: Sequence[_Aligned]) -> list[Pause]:
    """What is left of the pauses, by the clock that is kept: the times in which no other recorded."""
    silent = [_silent(one) for one in aligned]
    found: dict[tuple[Time, Time], Pause] = {}
    for index, (one, pauses) in enumerate(zip(aligned, map(_own_pauses, aligned), strict=True)):
        for pause in pauses:
            spans = [_span(one, pause)]
            for times in (*silent[:index], *silent[index + 1 :]):
                common = ((max(a, c), min(b, d)) for a, b in spans for c, d in times)
                spans = [span for span in common if span[0] < span[1]]
            for start, end in spans:
                until = None if end == EVER else end
                found.setdefault((start, end), Pause(start, pause.reason, until, pause.messages))
    return [found[span] for span in sorted(found)]


def _own_pauses(one: _Aligned) -> list[Pause]:
    """By the clock of the recording."""
    return list(
        {
            pause.from_ns: pause
            for said in one.recording.all_metadata
            for pause in pauses_of(said.get(PAUSES_NAME, {}))
        }.values()
    )


def _silent(one: _Aligned) -> list[tuple[Time, Time]]:
    """When a recorder did not record: paused, not there yet, not there any more."""
    recording = one.recording
    pauses = [_span(one, pause) for pause in _own_pauses(one)]
    return [*pauses, (0, one.right(recording.start_ns)), (one.right(recording.end_ns), EVER)]


def _span(one: _Aligned, pause: Pause) -> tuple[Time, Time]:
    """By the clock that is kept."""
    return one.right(pause.from_ns), EVER if pause.until_ns is None else one.right(pause.until_ns)


def _common(recordings: Sequence[Recording]) -> dict[str, Mapping[str, str]]:
    """The metadata of the first, without what does not hold for all: part, and what was left out."""
    all_said = []
    for recording in recordings:
        said: dict[str, Mapping[str, str]] = {}
        for part in recording.all_metadata:
            said |= part
        all_said.append(said | {METADATA_NAME: recording.metadata})
    first = all_said[0]
    found = {
        name: values
        for name, values in first.items()
        if name not in (GAPS_NAME, GOES_ON_NAME, PAUSES_NAME)
        and (name != CUT_NAME or all(said.get(name) == values for said in all_said))
    }
    about = first[METADATA_NAME]
    found[METADATA_NAME] = {
        name: value
        for name, value in about.items()
        if name not in ("part", "topics", "without")
        or all(said[METADATA_NAME].get(name) == value for said in all_said)
    }
    return found
