"""An MCAP file that grows by whole chunks.

The record types are the official library's. Its `Writer` is not used: it takes more than twice as long
(docs/decisions/0003-recording.md). Layout: header, metadata, attachment, schemas; then chunks, each preceded
by the channels that are new in it and followed by its message indexes; then the summary.
"""

import struct
import zlib
from collections.abc import Callable
from io import FileIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"

MAX_CHANNELS = 0xFFFF

LATEST = 0xFFFFFFFFFFFFFFFF
"""No time in a file is later, ns."""

_ZSTD_LEVEL = 1
_UINT32 = 0xFFFFFFFF
_FOOTER_SIZE = 20
_pack_message = struct.Struct("<BQHIQQ").pack
_MESSAGE_HEAD = 22
"""Bytes of a message record before the data, without opcode and length."""
_RECORD_HEAD = 9
"""Bytes of opcode and length."""


class ChannelBuffer:
    """One channel of the file, with where its messages are in the chunk in progress."""

    __slots__ = ("id", "index", "messages")

    def __init__(self, id: int) -> None:
        self.id = id
        self.messages = 0
        """Messages in finished chunks."""
        self.index: list[int] = []
        """Log time and offset of each message of the chunk in progress, flat."""


class McapFile:
    """Writes MCAP to a raw file that is empty at first. Nothing reaches the file before `flush`.

    Each flush is one append. Where it fails, the file is cut back to what was whole and the error is raised;
    what was buffered stays buffered.
    """

    def __init__(self, file: FileIO, library: str, compress: bool) -> None:
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL) if compress else None
        self._size = 0
        self._crc = 0
        self._front = [MAGIC, serialise(Header(profile="", library=library))]
        self._front_size = sum(map(len, self._front))
        self._parts: list[bytes] = []
        self._offset = 0
        self._buffers: list[ChannelBuffer] = []
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunk_indexes: list[bytes] = []
        self._attachment_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._start_time, self._end_time = LATEST, 0

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._size

    @property
    def buffered(self) -> int:
        """Bytes of messages in the chunk in progress."""
        return self._offset

    def add_metadata(self, metadata: Metadata) -> None:
        """Add key-value pairs."""
        offset, length = self._add_front(serialise(metadata))
        self._metadata_indexes.append(serialise(MetadataIndex(offset, length, metadata.name)))

    def add_attachment(self, attachment: Attachment) -> None:
        """Add a file within the file."""
        offset, length = self._add_front(serialise(attachment))
        index = AttachmentIndex(
            offset=offset,
            length=length,
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self._attachment_indexes.append(serialise(index))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its id."""
        schema = serialise(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        self._schemas.append(schema)
        self._add_front(schema)
        return len(self._schemas)

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> ChannelBuffer:
        """Add a channel; `schema_id` 0 is for none."""
        buffer = ChannelBuffer(len(self._buffers) + 1)
        channel = serialise(
            Channel(
                id=buffer.id,
                topic=topic,
                message_encoding=encoding,
                metadata=metadata,
                schema_id=schema_id,
            )
        )
        self._buffers.append(buffer)
        self._channels.append(channel)
        self._add_front(channel)
        return buffer

    def add_message(
        self, channel: ChannelBuffer, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Add a message to the chunk in progress; numbers that don't fit their field are clipped."""
        size = len(data) + _MESSAGE_HEAD
        try:
            head = _pack_message(5, size, channel.id, sequence, log_time, publish_time)
        except struct.error:
            log_time = min(max(log_time, 0), LATEST)
            publish_time = min(max(publish_time, 0), LATEST)
            head = _pack_message(5, size, channel.id, sequence & _UINT32, log_time, publish_time)
        self._parts += (head, data)
        channel.index += (log_time, self._offset)
        self._offset += size + _RECORD_HEAD

    def flush(self) -> None:
        """Close the chunk in progress and give the operating system all there is.

        Raises:
            OSError: the file can't grow.
        """
        front = b"".join(self._front)
        if not self._parts:
            self._append(front)
            self._clear_front()
            return
        used = [buffer for buffer in self._buffers if buffer.index]
        chunk = self._chunk(used)
        chunk_bytes = serialise(chunk)
        indexes = [_message_index(buffer) for buffer in used]
        place = _place_of(chunk, self._size + len(front), len(chunk_bytes), used, indexes)
        self._append(b"".join((front, chunk_bytes, *indexes)))
        self._chunk_indexes.append(serialise(place))
        self._clear_front()
        self._begin_chunk(used, chunk)

    def finish(self) -> None:
        """Flush, then write the summary. The file is whole after this; nothing may be added.

        Raises:
            OSError: the file can't grow.
        """
        self.flush()
        end = serialise(DataEnd(data_section_crc=self._crc))
        summary_start = self._size + len(end)
        groups = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [serialise(self._statistics())]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        )
        summary = b""
        offsets = b""
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += serialise(SummaryOffset(opcode, summary_start + len(summary), len(group)))
            summary += group
        offset_start = summary_start + len(summary)
        summary += offsets
        footer = struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_SIZE, summary_start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._append(end + summary + serialise(Footer(summary_start, offset_start, crc)) + MAGIC)

    def _add_front(self, record: bytes) -> tuple[int, int]:
        """Queue a record to go before the next chunk; returns its place in the file and its length."""
        offset = self._size + self._front_size
        self._front.append(record)
        self._front_size += len(record)
        return offset, len(record)

    def _clear_front(self) -> None:
        self._front.clear()
        self._front_size = 0

    def _chunk(self, used: list[ChannelBuffer]) -> Chunk:
        data = b"".join(self._parts)
        times = [time for buffer in used for time in buffer.index[::2]]
        return Chunk(
            compression="zstd" if self._compressor else "",
            data=self._compressor.compress(data) if self._compressor else data,
            message_end_time=max(times),
            message_start_time=min(times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )

    def _begin_chunk(self, used: list[ChannelBuffer], last: Chunk) -> None:
        self._start_time = min(self._start_time, last.message_start_time)
        self._end_time = max(self._end_time, last.message_end_time)
        for buffer in used:
            buffer.messages += len(buffer.index) // 2
            buffer.index.clear()
        self._parts.clear()
        self._offset = 0

    def _statistics(self) -> Statistics:
        counts = {buffer.id: buffer.messages for buffer in self._buffers}
        messages = sum(counts.values())
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunk_indexes),
            message_count=messages,
            message_end_time=self._end_time,
            message_start_time=self._start_time if messages else 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _append(self, data: bytes) -> None:
        """Write all of `data`, or leave the file as it was and raise."""
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
        except BaseException:
            self._file.seek(self._size)
            self._file.truncate()
            raise
        self._size += len(data)
        self._crc = zlib.crc32(data, self._crc)


def serialise(record: McapRecord) -> bytes:
    """A record's bytes, with opcode and length."""
    builder = RecordBuilder()
    record.write(builder)
    end: Callable[[], bytes] = builder.end
    return end()


def _message_index(buffer: ChannelBuffer) -> bytes:
    size = 8 * len(buffer.index)
    head = (Opcode.MESSAGE_INDEX, 6 + size, buffer.id, size)
    return struct.pack(f"<BQHI{len(buffer.index)}Q", *head, *buffer.index)


def _place_of(
    chunk: Chunk, start: int, length: int, used: list[ChannelBuffer], indexes: list[bytes]
) -> ChunkIndex:
    """The index of a chunk at byte `start` of the file that is followed by its message indexes."""
    offsets: dict[int, int] = {}
    position = start + length
    for buffer, index in zip(used, indexes, strict=True):
        offsets[buffer.id] = position
        position += len(index)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=position - start - length,
        message_index_offsets=offsets,
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )
