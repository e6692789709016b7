"""Where things are in an MCAP file, found from its front: the same for finished and unfinished files."""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream

from maniple.core.errors import RecordingError
from maniple.core.time import Time
from maniple.recording.mcap_file import MAGIC

DAMAGE = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,
    EOFError,
    MemoryError,
    OverflowError,
)
"""What decoding the records of a damaged file may raise."""

_KEPT = (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.CHANNEL)
_HEAD = struct.Struct("<BQ")
_TIMES = struct.Struct("<QQ")
_MESSAGE = struct.Struct("<HIQQ")


class ChunkPlace(NamedTuple):
    """A chunk: sorts in the order in which chunks are to be read."""

    start_ns: Time
    """Least log time in it."""
    offset: int
    """Of its content in the file, in bytes."""
    length: int


class RawMessage(NamedTuple):
    """A message of a chunk: sorts by log time, then by place in the file."""

    log_time_ns: Time
    chunk_offset: int
    offset: int
    channel: int
    sequence: int
    publish_time_ns: Time
    data: bytes


class Layout:
    """What an MCAP file holds and where; its messages stay in the file."""

    def __init__(self) -> None:
        self.complete = False
        """Whether it ends as a finished file does."""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkPlace] = []


def scan(path: Path) -> Layout:
    """The layout of a file, up to its end or to where it stops being whole.

    Raises:
        RecordingError: it can't be opened, is no MCAP file, or what comes before its messages is damaged.
    """
    layout = Layout()
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise RecordingError(f"{path} is empty; a recording (MCAP file) is needed")
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path} is not an MCAP file; a recording made by maniple is needed")
        try:
            for opcode, offset, length in _records(file, size):
                _note(layout, file, opcode, offset, length)
        except DAMAGE as error:
            raise RecordingError(f"{path} is damaged: {error}") from None
        if not layout.complete and layout.chunks and not _is_whole(file, layout.chunks[-1]):
            layout.chunks.pop()
    return layout


def open_file(path: Path) -> BinaryIO:
    """The file, opened for reading.

    Raises:
        RecordingError: it can't be.
    """
    try:
        return path.open("rb")
    except OSError as error:
        raise RecordingError(f"can't read {path}: {error.strerror}") from None


def read_chunk(file: BinaryIO, place: ChunkPlace, channels: dict[int, Channel]) -> Iterator[RawMessage]:
    """The messages of a chunk as they are in the file; channels found in it are added to `channels`.

    Raises:
        Exception: one of `DAMAGE`.
    """
    file.seek(place.offset)
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(place.length))))
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    data = stream.read(size)
    position = 0
    while position < size:
        opcode, length = _HEAD.unpack_from(data, position)
        start = position + _HEAD.size
        position = start + length
        if position > size:
            raise ValueError("a record reaches beyond its chunk")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            content = data[start + _MESSAGE.size : position]
            yield RawMessage(log_time, place.offset, start, channel, sequence, publish_time, content)
        elif opcode == Opcode.CHANNEL:
            _add_channel(channels, data[start:position])


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset and length of the content) of every whole record of the file."""
    position = len(MAGIC)
    while position + _HEAD.size <= size:
        file.seek(position)
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        position += _HEAD.size
        if opcode == 0 or position + length > size:
            return
        yield opcode, position, length
        if opcode == Opcode.FOOTER:
            return
        position += length


def _note(layout: Layout, file: BinaryIO, opcode: int, offset: int, length: int) -> None:
    """Add one record to the layout; the file stands at its content."""
    if opcode == Opcode.CHUNK:
        start, _ = _TIMES.unpack(file.read(_TIMES.size))
        layout.chunks.append(ChunkPlace(start, offset, length))
    elif opcode == Opcode.MESSAGE:
        raise ValueError("it has messages outside chunks, which no recorder of maniple writes")
    elif opcode == Opcode.FOOTER:
        file.seek(offset + length)
        layout.complete = file.read() == MAGIC
    elif opcode in _KEPT:
        content = file.read(length)
        if opcode == Opcode.CHANNEL:
            _add_channel(layout.channels, content)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(ReadDataStream(BytesIO(content)))
            layout.metadata.setdefault(metadata.name, metadata.metadata)
        elif zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little"):
            attachment = Attachment.read(ReadDataStream(BytesIO(content)))
            layout.attachments.setdefault(attachment.name, attachment.data)


def _add_channel(channels: dict[int, Channel], content: bytes) -> None:
    channel = Channel.read(ReadDataStream(BytesIO(content)))
    channels.setdefault(channel.id, channel)


def _is_whole(file: BinaryIO, place: ChunkPlace) -> bool:
    """Whether a chunk can be read; the last one before a power failure may be there in length only."""
    try:
        for _ in read_chunk(file, place, {}):
            pass
    except DAMAGE:
        return False
    return True
