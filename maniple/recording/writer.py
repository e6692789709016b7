"""Writes a recording: every message's wire bytes, with the scenario in front."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, NoReturn, Self, TypeAlias

import msgspec
from mcap.records import Attachment, Metadata

from maniple.core import codec, topics
from maniple.core.errors import MessageError, RecordingError
from maniple.core.messages import Message
from maniple.core.time import MILLISECOND, Duration, Time
from maniple.recording.mcap_file import LATEST, MAX_CHANNELS, ChannelBuffer, McapFile

Compression: TypeAlias = Literal["zstd", "none"]

METADATA_NAME = "maniple"
"""The metadata record that makes an MCAP file one of maniple's."""

SCENARIO_NAME = "scenario.json"
"""The attachment with the resolved scenario."""

LATCHED_NAME = "latched/"
"""With the topic behind it: the attachment with the wire bytes of what was latched before the file began."""

CHUNK_PERIOD: Duration = 400 * MILLISECOND
"""How long a message may wait in memory; with a tick every 0.1 s none waits longer than 0.5 s."""

_MAX_BUFFERED = 4 << 20
_ENCODING = "msgpack"
_LIBRARY = "maniple"


class Latched(NamedTuple):
    """The last message of a latched topic from before a file."""

    topic: str
    data: bytes
    log_time_ns: Time
    publish_time_ns: Time


class RecordingWriter:
    """Writes one recording. The same calls make the same bytes.

    `metadata` says how the recording came about (version, seed, mode, ...). `prefix` is the first part of
    every key on the network. `now` is the time noted for the scenario, on the clock of the messages.
    `latched` is what held before; it is attached, so that no message is there twice.

    As a context manager it finishes the file at the end, whatever happened.

    Raises:
        RecordingError: the file exists, or can't be made.
    """

    def __init__(
        self,
        path: str | Path,
        scenario_json: bytes,
        metadata: Mapping[str, str],
        *,
        prefix: str,
        now: Time = 0,
        compression: Compression = "zstd",
        chunk_period_ns: Duration = CHUNK_PERIOD,
        latched: Iterable[Latched] = (),
    ) -> None:
        self.path = Path(path)
        self._prefix = prefix
        self._period = chunk_period_ns
        self._due: Time | None = None
        self._failure = ""
        self._channels: dict[str, ChannelBuffer] = {}
        self._viewer_channels: dict[str, ChannelBuffer] = {}
        self._viewer_schemas: dict[str, int] = {}
        self._raw = _create(self.path)
        self._mcap = McapFile(self._raw, _LIBRARY, compression == "zstd")
        self._mcap.add_metadata(Metadata(METADATA_NAME, {**metadata, "prefix": prefix}))
        self._mcap.add_attachment(Attachment(now, now, SCENARIO_NAME, "application/json", scenario_json))
        for one in latched:
            self._mcap.add_attachment(attachment_of(one))
        self._schemas = {
            kind: self._mcap.add_schema(f"maniple.{kind.__name__}", "jsonschema", schema_of(kind))
            for kind in dict.fromkeys(row.type for row in topics.TOPICS)
        }
        try:
            self.flush()
        except RecordingError:
            self._raw.close()
            self.path.unlink()
            raise

    def write(self, topic: str, data: bytes, log_time_ns: Time, publish_time_ns: Time, sequence: int) -> None:
        """Record the wire bytes of a message. A topic that is not in the table is recorded without a schema.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        if self._failure:
            raise RecordingError(self._failure)
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._add_channel(topic)
        self._mcap.add_message(channel, log_time_ns, publish_time_ns, sequence, data)
        if self._mcap.buffered > _MAX_BUFFERED:
            self.flush()

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return self._mcap.size

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record; of several of one name the last counts."""
        self._mcap.add_metadata(Metadata(name, dict(values)))

    def add_viewer_channel(
        self, key: str, encoding: str, schema_name: str, schema_encoding: str, schema: bytes
    ) -> None:
        """Add a channel of what is derived for viewers; its `key` is not under the prefix. A second time for
        the same key does nothing.

        Raises:
            RecordingError: too many channels.
        """
        if key in self._viewer_channels:
            return
        self._require_room(key)
        if schema_name not in self._viewer_schemas:
            self._viewer_schemas[schema_name] = self._mcap.add_schema(schema_name, schema_encoding, schema)
        channel = self._mcap.add_channel(key, encoding, self._viewer_schemas[schema_name], {})
        self._viewer_channels[key] = channel

    def draw(self, key: str, data: bytes, log_time_ns: Time, publish_time_ns: Time) -> None:
        """Record what was derived for viewers, on a channel that was added.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        if self._failure:
            raise RecordingError(self._failure)
        channel = self._viewer_channels[key]
        self._mcap.add_message(channel, log_time_ns, publish_time_ns, 0, data)

    def tick(self, now: Time) -> None:
        """Say what time it is, on any one clock: where a chunk period has passed since the last flush, flush.

        The realtime recorder passes wall time, a virtual run virtual time.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        if self._due is None:
            self._due = now + self._period
        elif now >= self._due:
            self._due = now + self._period
            self.flush()

    def flush(self) -> None:
        """Close the chunk in progress; what was written so far survives the end of this process.

        Raises:
            RecordingError: the file can't grow, or is closed.
        """
        if self._failure:
            raise RecordingError(self._failure)
        try:
            self._mcap.flush()
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Finish the file. A second call, and one after a failed write, does nothing.

        Raises:
            RecordingError: the file can't grow; what was flushed before can be read.
        """
        if self._raw.closed:
            return
        try:
            if not self._failure:
                self._mcap.finish()
                self._failure = f"{self.path} is closed"
        except OSError as error:
            self._fail(error)
        finally:
            self._raw.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _add_channel(self, name: str) -> ChannelBuffer:
        self._require_room(name)
        key = f"{self._prefix}/{name}"
        try:
            schema, metadata = self._schemas[topics.topic(name).type], {"encoding": codec.encoding(name)}
        except MessageError:
            schema, metadata = 0, {}
        channel = self._channels[name] = self._mcap.add_channel(key, _ENCODING, schema, metadata)
        return channel

    def _require_room(self, name: str) -> None:
        if len(self._channels) + len(self._viewer_channels) >= MAX_CHANNELS:
            raise RecordingError(
                f"{self.path}: no room for topic {name!r}: {MAX_CHANNELS} topics are the most"
            )

    def _fail(self, error: OSError) -> NoReturn:
        self._failure = f"can't write {self.path}: {error.strerror}; what was recorded before can be read"
        raise RecordingError(self._failure) from error


def attachment_of(latched: Latched) -> Attachment:
    """How a latched message from before a file is in it: created when it was sent."""
    topic, data, log_time, publish_time = latched
    return Attachment(
        create_time=min(max(publish_time, 0), LATEST),
        log_time=min(max(log_time, 0), LATEST),
        name=f"{LATCHED_NAME}{topic}",
        media_type="application/msgpack",
        data=data,
    )


def schema_of(kind: type[Message]) -> bytes:
    """The JSON schema of a message type; for a float array its dtype and shape."""
    schema: dict[str, Any] = msgspec.json.schema(kind)
    definitions = schema["$defs"]
    root = definitions.pop(kind.__name__)
    return msgspec.json.encode({**root, "$defs": definitions} if definitions else root)


def _create(path: Path) -> Any:
    try:
        return path.open("xb", buffering=0)
    except FileExistsError:
        raise RecordingError(f"{path} exists already; a recording is never overwritten") from None
    except OSError as error:
        raise RecordingError(f"can't create {path}: {error.strerror}") from None


def part(log: Path, number: int) -> Path:
    """Where the part of this number of a recording goes: LOG.mcap, LOG-2.mcap, ..."""
    return log if number == 1 else log.with_name(f"{log.stem}-{number}{log.suffix}")


def parts_of(log: Path) -> list[Path]:
    """The files there are whose names are those of parts of a recording, in order."""
    found = {}
    with suppress(OSError):
        for path in log.parent.iterdir():
            number = path.name.removeprefix(f"{log.stem}-").removesuffix(log.suffix)
            if number.isdecimal() and part(log, int(number)) == path:
                found[int(number)] = path
        if log.exists():
            found[1] = log
    return [path for _, path in sorted(found.items())]
