"""The last seconds of what is said, in memory, and written out when somebody asks."""

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from maniple.core.errors import RecordingError
from maniple.core.time import Duration, Time
from maniple.recording.split import Begin, Counts, ViewerChannel, count_in, finish, is_latched
from maniple.recording.tally import Tally
from maniple.recording.writer import Latched, RecordingWriter

MOST_BYTES = 512 << 20
"""What the ring takes of memory at most, about."""

_EACH = 350
"""Bytes that a message takes beside its own."""


class Entry(NamedTuple):
    """A message in the ring, or what was derived from one for viewers."""

    topic: str
    data: bytes
    log_time_ns: Time
    publish_time_ns: Time
    sequence: int
    drawn: bool = False


class Ring:
    """What was said in the last `duration` of log time, as far as `most` bytes have room for it."""

    def __init__(self, duration: Duration, most: int = MOST_BYTES) -> None:
        self._duration = duration
        self._most = most
        self._entries: deque[Entry] = deque()
        self._bytes = 0
        self._newest: Time = 0
        self.latched: dict[str, Latched] = {}
        """What held when the first entry came."""
        self.squeezed = False
        """Whether memory ever was what ended it."""

    def add(self, entry: Entry) -> None:
        """Take an entry in, and let go of what is too old for it."""
        self._entries.append(entry)
        self._bytes += len(entry.data) + _EACH
        self.trim(entry.log_time_ns)
        while self._bytes > self._most and len(self._entries) > 1:
            self.squeezed = True
            self._let_go()

    def trim(self, now: Time) -> None:
        """Let go of what is too old at this time."""
        self._newest = max(self._newest, now)
        oldest = self._newest - self._duration
        while self._entries and self._entries[0].log_time_ns < oldest:
            self._let_go()

    def entries(self) -> tuple[Entry, ...]:
        """All of it, in order."""
        return tuple(self._entries)

    def _let_go(self) -> None:
        entry = self._entries.popleft()
        self._bytes -= len(entry.data) + _EACH
        if not entry.drawn and is_latched(entry.topic):
            self.latched[entry.topic] = Latched(
                entry.topic, entry.data, entry.log_time_ns, entry.publish_time_ns
            )


class Kept(NamedTuple):
    """What was written out of the ring."""

    path: Path
    messages: int
    first_ns: Time
    """Log time of the first message; 0 without any."""
    last_ns: Time


class RollingWriter:
    """Holds the last seconds and writes them to a new file when told to `keep` them. To what it is told it
    answers as `PartsWriter` does; nothing reaches a file but by `keep`. Each file says at its end what it
    lacks.
    """

    def __init__(self, begin: Begin, ring: Ring, counts: Counts = lambda _: True) -> None:
        self._begin = begin
        self._ring = ring
        self._counts = counts
        self._tally = Tally()
        self._writer: RecordingWriter | None = None
        self._notes: dict[str, Mapping[str, str]] = {}
        self._viewer_channels: list[ViewerChannel] = []
        self._messages = 0
        self._first: Time = 0
        self._last: Time = -1
        self.paths: list[Path] = []
        """The files it has written, in order."""

    def write(self, topic: str, data: bytes, log_time_ns: Time, publish_time_ns: Time, sequence: int) -> None:
        """Take a message into the ring, and into the file that is being written, if any.

        Raises:
            RecordingError: that file can't grow.
        """
        self._add(Entry(topic, data, log_time_ns, publish_time_ns, sequence))

    def draw(self, key: str, data: bytes, log_time_ns: Time, publish_time_ns: Time) -> None:
        """The same for what was derived for viewers.

        Raises:
            RecordingError: that file can't grow.
        """
        self._add(Entry(key, data, log_time_ns, publish_time_ns, 0, drawn=True))

    def add_viewer_channel(self, channel: ViewerChannel) -> None:
        """Add a channel of what is derived for viewers, to all files."""
        self._viewer_channels.append(channel)
        if self._writer is not None:
            self._writer.add_viewer_channel(*channel)

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, to all files that are or will be written."""
        self._notes[name] = values
        if self._writer is not None:
            self._writer.note(name, values)

    def note_here(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record to the file that is being written."""
        if self._writer is not None:
            self._writer.note(name, values)

    def tick(self, now: Time) -> None:
        """Say what time it is, on any one clock.

        Raises:
            RecordingError: the file that is being written can't grow.
        """
        if self._writer is not None:
            with self._given_up(self._writer):
                self._writer.tick(now)

    def flush(self) -> None:
        """Close the chunk in progress.

        Raises:
            RecordingError: the file that is being written can't grow.
        """
        if self._writer is not None:
            with self._given_up(self._writer):
                self._writer.flush()

    tally = None
    """What is missing is counted for each file."""

    @property
    def writing(self) -> bool:
        """Whether a file is being written."""
        return self._writer is not None

    @property
    def waiting(self) -> int:
        """Messages in the ring that are in no file."""
        entries = self._ring.entries()
        return sum(not entry.drawn and entry.log_time_ns > self._last for entry in entries)

    def keep(self, now: Time) -> Kept:
        """Write out what there is at this log time. What comes from then on is written too, until `end`.
        While a file is being written that one goes on.

        Raises:
            RecordingError: it can't be written; the ring is as it was.
        """
        if self._writer is None:
            self._ring.trim(now)
            self._writer = self._begin(tuple(self._ring.latched.values()))
            self.paths.append(self._writer.path)
            self._messages, self._first, self._tally = 0, 0, Tally()
            for channel in self._viewer_channels:
                self._writer.add_viewer_channel(*channel)
            for name, values in self._notes.items():
                self._writer.note(name, values)
            for entry in self._ring.entries():
                self._put(self._writer, entry)
            self.flush()
        return self._kept(self._writer.path)

    def end(self) -> Kept | None:
        """Finish the file that is being written, if any.

        Raises:
            RecordingError: it can't grow.
        """
        if (writer := self._writer) is None:
            return None
        self._writer = None
        finish(writer, self._tally)
        return self._kept(writer.path)

    def close(self) -> None:
        """The same."""
        self.end()

    def _kept(self, path: Path) -> Kept:
        return Kept(path, self._messages, self._first, self._last if self._messages else 0)

    def _add(self, entry: Entry) -> None:
        self._ring.add(entry)
        if self._writer is not None:
            self._put(self._writer, entry)

    def _put(self, writer: RecordingWriter, entry: Entry) -> None:
        topic, data, log_time, publish_time, sequence, drawn = entry
        with self._given_up(writer):
            if drawn:
                writer.draw(topic, data, log_time, publish_time)
                return
            writer.write(topic, data, log_time, publish_time, sequence)
        count_in(self._tally, topic, data, self._counts)
        self._first = self._first if self._messages else log_time
        self._messages, self._last = self._messages + 1, log_time

    @contextmanager
    def _given_up(self, writer: RecordingWriter) -> Iterator[None]:
        """Where this fails, the file is left as it is; the ring goes on."""
        try:
            yield
        except RecordingError:
            self._writer = None
            writer.close()
            raise
