"""A recording in parts: LOG.mcap, LOG-2.mcap, ... Each stands alone, and no message is in two of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import msgspec

from maniple.core import topics
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError
from maniple.core.time import Duration, Time
from maniple.recording.tally import GAPS_NAME, Tally
from maniple.recording.writer import Latched, RecordingWriter

GOES_ON_NAME = "maniple.goes_on"
"""The metadata record of a part after which there is another: `file`, how that was named."""

LEAST_BYTES = 1_000_000
LEAST_DURATION: Duration = 1_000_000_000

Begin: TypeAlias = Callable[[Sequence[Latched]], RecordingWriter]
"""Makes the next file, given what is latched when it begins."""


Counts: TypeAlias = Callable[[str], bool]
"""Whether what is missing of a topic matters."""

_JOURNALS = topics.journal("")


class _Sent(msgspec.Struct):
    """Of a journal: what its sender has sent."""

    source: str
    incarnation: int
    sent: dict[str, int] = {}


_read_journal = msgspec.msgpack.Decoder(_Sent).decode


class Splits(msgspec.Struct, frozen=True):
    """Where a part ends. It is over with the first of the two."""

    bytes: int | None = None
    """It is over once it has so many; at least `LEAST_BYTES`."""
    duration: Duration | None = None
    """It is over so long after its first message, by log time; at least `LEAST_DURATION`."""


ONE_PART = Splits()


class ViewerChannel(NamedTuple):
    """The arguments of `RecordingWriter.add_viewer_channel`."""

    key: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


class PartsWriter:
    """Writes a recording as `RecordingWriter` does, in one part or several. With `counts`, which says
    what topics matter, each part says at its end what the whole recording lacks up to there.

    Raises:
        RecordingError: the first part can't be made.
    """

    def __init__(self, begin: Begin, splits: Splits = ONE_PART, counts: Counts | None = None) -> None:
        self._begin = begin
        self._splits = splits
        self._several = splits != ONE_PART
        self._counts = counts
        self.tally = None if counts is None else Tally()
        """What there is, by sequence number."""
        self._writer = begin(())
        self._started: Time | None = None
        self._latched: dict[str, Latched] = {}
        self._is_latched: dict[str, bool] = {}
        self._notes: dict[str, Mapping[str, str]] = {}
        self._viewer_channels: dict[str, ViewerChannel] = {}
        self.paths = [self._writer.path]
        """The parts so far, in order."""

    @property
    def writing(self) -> bool:
        """Whether a file is being written: always."""
        return True

    def write(self, topic: str, data: bytes, log_time_ns: Time, publish_time_ns: Time, sequence: int) -> None:
        """Record the wire bytes of a message.

        Raises:
            RecordingError: the file can't grow, a new part can't be made, or it is closed.
        """
        if self._several:
            if self._is_over(log_time_ns):
                self._go_on()
            if self._started is None:
                self._started = log_time_ns
            if self._holds(topic):
                self._latched[topic] = Latched(topic, data, log_time_ns, publish_time_ns)
        self._writer.write(topic, data, log_time_ns, publish_time_ns, sequence)
        if self.tally is not None and self._counts is not None:
            count_in(self.tally, topic, data, self._counts)

    def draw(self, key: str, data: bytes, log_time_ns: Time, publish_time_ns: Time) -> None:
        """Record what was derived for viewers.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        self._writer.draw(key, data, log_time_ns, publish_time_ns)

    def add_viewer_channel(self, channel: ViewerChannel) -> None:
        """Add a channel of what is derived for viewers, to this part and all that follow.

        Raises:
            RecordingError: too many channels.
        """
        self._viewer_channels[channel.key] = channel
        self._writer.add_viewer_channel(*channel)

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, to this part and all that follow; the last of a name counts."""
        self._notes[name] = values
        self._writer.note(name, values)

    def tick(self, now: Time) -> None:
        """Say what time it is, on any one clock.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        self._writer.tick(now)

    def flush(self) -> None:
        """Close the chunk in progress.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        self._writer.flush()

    def close(self) -> None:
        """Finish the part in progress.

        Raises:
            RecordingError: the file can't grow.
        """
        finish(self._writer, self.tally)

    def _is_over(self, now: Time) -> bool:
        most, longest = self._splits.bytes, self._splits.duration
        if most is not None and self._writer.size >= most:
            return True
        return longest is not None and self._started is not None and now - self._started >= longest

    def _go_on(self) -> None:
        """Begin the next part, then finish this one: where the first fails, this one is still whole."""
        following = self._begin(tuple(self._latched.values()))
        for channel in self._viewer_channels.values():
            following.add_viewer_channel(*channel)
        for name, values in self._notes.items():
            following.note(name, values)
        done, self._writer, self._started = self._writer, following, None
        self.paths.append(following.path)
        done.note(GOES_ON_NAME, {"file": following.path.name})
        finish(done, self.tally)

    def _holds(self, topic: str) -> bool:
        """Whether a topic is latched."""
        known = self._is_latched.get(topic)
        if known is None:
            known = self._is_latched[topic] = is_latched(topic)
        return known


def is_latched(topic: str) -> bool:
    """Whether the table of topics says that the last message of a topic holds."""
    try:
        return topics.topic(topic).latched
    except MessageError:
        return False


def count_in(tally: Tally, topic: str, data: bytes, counts: Counts) -> None:
    """Count a message, and what it tells of others if it is a journal. One without a header is of nobody."""
    try:
        if topic.startswith(_JOURNALS):
            journal = _read_journal(data)
            sent = {name: number for name, number in journal.sent.items() if counts(name)}
            tally.told(journal.source, journal.incarnation, sent)
        header = header_of(topic, data)
    except (MessageError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return
    tally.note(topic, header.source, header.incarnation, header.seq)


def finish(writer: RecordingWriter, tally: Tally | None) -> None:
    """Write what is missing at the end of a file, and finish it.

    Raises:
        RecordingError: it can't grow.
    """
    if tally is not None:
        writer.note(GAPS_NAME, tally.to_metadata())
    writer.close()
