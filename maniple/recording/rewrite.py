"""A recording made of others: what they hold, in a new file."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Self

from mcap.records import Attachment, Channel, Metadata

from maniple.core import codec
from maniple.core.envelope import header_of
from maniple.core.errors import MessageError, RecordingError
from maniple.core.messages import Journal
from maniple.core.time import Time
from maniple.recording.mcap_file import MAX_CHANNELS, ChannelBuffer, McapFile
from maniple.recording.scan import Layout, RawMessage
from maniple.recording.tally import GAPS_NAME, Tally
from maniple.recording.writer import CHUNK_PERIOD

_LIBRARY = "maniple"
_MAX_BUFFERED = 4 << 20


class Rewriter:
    """Writes messages of other files into a new one, with channels and schemas as they were. The same calls
    make the same bytes.

    As a context manager it finishes the file at the end; where something went wrong there is none.

    Raises:
        RecordingError: the file exists, or can't be made.
    """

    def __init__(
        self, path: Path, metadata: Mapping[str, Mapping[str, str]], attachments: Iterable[Attachment]
    ) -> None:
        self.path = path
        self.messages = 0
        """So far."""
        self.tally = Tally()
        """Of what was added with a topic."""
        self._due: Time | None = None
        self._channels: dict[tuple[int, int], ChannelBuffer] = {}
        self._known: dict[tuple[str, str, int, str], ChannelBuffer] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        try:
            self._raw = path.open("xb", buffering=0)
        except FileExistsError:
            raise RecordingError(f"{path} exists already; a recording is never overwritten") from None
        except OSError as error:
            raise RecordingError(f"can't create {path}: {error.strerror}") from None
        self._file = McapFile(self._raw, _LIBRARY, compress=True)
        for name, values in metadata.items():
            self.note(name, values)
        for attachment in attachments:
            self._file.add_attachment(attachment)

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record; of several of one name the last counts."""
        self._file.add_metadata(Metadata(name, dict(values)))

    def note_gaps(self) -> None:
        """Say what is missing, by sequence number, in what was added with a topic."""
        self.note(GAPS_NAME, self.tally.to_metadata())

    def add(self, layout: Layout, raw: RawMessage, topic: str, log_time_ns: Time | None = None) -> None:
        """Add a message of another file, at another log time where one is given; `topic` is empty for what
        was derived for viewers. Chunks are as long as a recorder's.

        Raises:
            RecordingError: the file can't grow, or there are too many channels.
        """
        now = raw.log_time_ns if log_time_ns is None else log_time_ns
        channel = self._channels.get((id(layout), raw.channel))
        if channel is None:
            channel = self._add_channel(layout, raw.channel)
        if self._due is None:
            self._due = now + CHUNK_PERIOD
        elif now >= self._due or self._file.buffered > _MAX_BUFFERED:
            self._due = now + CHUNK_PERIOD
            self.flush()
        self._file.add_message(channel, now, raw.publish_time_ns, raw.sequence, raw.data)
        self.messages += 1
        if topic:
            self._count(topic, raw.data)

    def flush(self) -> None:
        """Close the chunk in progress.

        Raises:
            RecordingError: the file can't grow.
        """
        try:
            self._file.flush()
        except OSError as error:
            self._fail(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._file.finish()
        except OSError as problem:
            self._raw.close()
            self.path.unlink(missing_ok=True)
            self._fail(problem)
        self._raw.close()
        if kind is not None:
            self.path.unlink(missing_ok=True)

    def _count(self, topic: str, data: bytes) -> None:
        try:
            header = header_of(topic, data)
            self.tally.note(topic, header.source, header.incarnation, header.seq)
            if topic.startswith("journal/"):
                message = codec.decode(topic, data)
                if isinstance(message, Journal):
                    self.tally.told(header.source, header.incarnation, message.sent)
        except MessageError:
            return

    def _add_channel(self, layout: Layout, id_: int) -> ChannelBuffer:
        channel = layout.channels[id_]
        schema = self._schema(layout, channel)
        metadata = channel.metadata
        mark = channel.topic, channel.message_encoding, schema, repr(sorted(metadata.items()))
        buffer = self._known.get(mark)
        if buffer is None:
            if len(self._known) >= MAX_CHANNELS:
                raise RecordingError(f"{self.path}: more than {MAX_CHANNELS} channels do not fit in one file")
            buffer = self._file.add_channel(channel.topic, channel.message_encoding, schema, metadata)
            self._known[mark] = buffer
        self._channels[id(layout), id_] = buffer
        return buffer

    def _schema(self, layout: Layout, channel: Channel) -> int:
        schema = layout.schemas.get(channel.schema_id)
        if schema is None:
            return 0
        mark = schema.name, schema.encoding, schema.data
        if mark not in self._schemas:
            self._schemas[mark] = self._file.add_schema(*mark)
        return self._schemas[mark]

    def _fail(self, error: OSError) -> NoReturn:
        raise RecordingError(f"can't write {self.path}: {error.strerror or error}") from error


def beside(file: Path, what: str) -> Path:
    """A name for a new file: FILE-what.mcap, in the folder of the other."""
    return file.with_name(f"{file.stem}-{what}{file.suffix}")
