"""Where things are in an MCAP file, from its front on: the same for finished, unfinished and damaged ones.

Nothing in a file is believed before it fits: a record's length must agree with the lengths within it, and a
chunk's content with its checksum. Where no record can be, the next place where one can is looked for.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
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

LARGEST_CHUNK = 1 << 30
"""Bytes of a chunk's content; one that claims more is taken for damaged."""

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_MESSAGE = struct.Struct("<HIQQ")
_PLACE = struct.Struct("<QQQQ")
_FOOTER = struct.Struct("<BQQQI")

_FIXED, _SHORT, _LONG = 0, 4, 8
_Shape = tuple[tuple[int, int], ...]
_SHAPES: Mapping[int, _Shape] = {
    Opcode.HEADER: ((_SHORT, 0), (_SHORT, 0)),
    Opcode.SCHEMA: ((_FIXED, 2), (_SHORT, 0), (_SHORT, 0), (_SHORT, 0)),
    Opcode.CHANNEL: ((_FIXED, 4), (_SHORT, 0), (_SHORT, 0), (_SHORT, 0)),
    Opcode.MESSAGE: ((_FIXED, 22),),
    Opcode.CHUNK: ((_FIXED, 28), (_SHORT, 0), (_LONG, 0)),
    Opcode.MESSAGE_INDEX: ((_FIXED, 2), (_SHORT, 0)),
    Opcode.ATTACHMENT: ((_FIXED, 16), (_SHORT, 0), (_SHORT, 0), (_LONG, 0), (_FIXED, 4)),
    Opcode.METADATA: ((_SHORT, 0), (_SHORT, 0)),
    Opcode.DATA_END: ((_FIXED, 4),),
}
"""What the content of a record before the summary is made of: so many bytes, or as many as a number of 4 or 8
bytes before them says."""

_CANDIDATE = re.compile(rb"(?=[\x03\x04\x06\x07\x09\x0c].{5}\0{3}|\x0f\x04\0{7})", re.DOTALL)
"""Where a record may begin, of those that come before the summary: none is longer than 1 TB."""
_WINDOW = 1 << 20


class NothingRecordedError(RecordingError):
    """A recorder ended before its first message."""


class ChunkPlace(NamedTuple):
    """A chunk: sorts in the order in which chunks are to be read."""

    start_ns: Time
    """Least log time in it."""
    part: int
    """Index of its file in the recording."""
    offset: int
    """Of its content in the file, in bytes."""
    length: int
    end_ns: Time
    """Greatest log time in it."""


class RawMessage(NamedTuple):
    """A message of a chunk: sorts by log time, then by place in the recording."""

    log_time_ns: Time
    part: int
    chunk_offset: int
    offset: int
    channel: int
    sequence: int
    publish_time_ns: Time
    data: bytes


class Damage(NamedTuple):
    """Something in a file that is not as it was written."""

    path: Path
    offset: int
    """Where it begins, in bytes."""
    length: int
    """Bytes that can't be read."""
    what: str

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


class Layout:
    """What an MCAP file holds and where; its messages stay in the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.complete = False
        """Whether it ends as a finished file does."""
        self.size = 0
        """Bytes of the file."""
        self.data_end = 0
        """Where the summary begins; 0 without one."""
        self.torn = 0
        """Bytes at the end of an unfinished file that are no whole record."""
        self.damage: list[Damage] = []
        """Stretches where no record can be, and what else doesn't fit."""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkPlace] = []
        """In the order of the file."""


def scan(path: Path, part: int = 0, lenient: bool = False) -> Layout:
    """The layout of a file, up to its end; damage is noted in it. A `lenient` scan takes a file whose first
    bytes are not those of an MCAP file, too.

    Raises:
        RecordingError: it can't be opened, or is no MCAP file, or holds messages outside chunks.
    """
    layout = Layout(path)
    with open_file(path) as file:
        layout.size = os.fstat(file.fileno()).st_size
        if layout.size == 0:
            raise NothingRecordedError(f"{path} is empty; a recording (MCAP file) is needed")
        if file.read(len(MAGIC)) != MAGIC:
            if not lenient:
                raise RecordingError(f"{path} is not an MCAP file; a recording made by maniple is needed")
            layout.damage.append(Damage(path, 0, len(MAGIC), "the first bytes are not those of an MCAP file"))
        for opcode, offset, length in _records(layout, file, lenient):
            _note(layout, file, part, opcode, offset, length)
        if not layout.complete and layout.chunks and not layout.damage:
            last = layout.chunks[-1]
            if not _is_whole(file, last):
                layout.chunks.pop()
                layout.torn += _HEAD.size + last.length
    return layout


def checksum_of(layout: Layout) -> Damage | None:
    """What is wrong with a finished file as a whole, by the checksum over all before its summary; this reads
    all of it.

    Raises:
        RecordingError: it can't be read any more.
    """
    if not layout.data_end:
        return None
    crc = 0
    with open_file(layout.path) as file:
        left = layout.data_end - _HEAD.size - 4
        while left and (block := file.read(min(left, _WINDOW))):
            crc = zlib.crc32(block, crc)
            left -= len(block)
        file.seek(layout.data_end - 4)
        told = int.from_bytes(file.read(4), "little")
    if told in (0, crc):
        return None
    return Damage(layout.path, 0, 0, "it does not match the checksum of the whole; all chunks match theirs")


def open_file(path: Path) -> BinaryIO:
    """The file, opened for reading.

    Raises:
        RecordingError: it can't be.
    """
    try:
        if path.is_fifo() or path.is_socket() or path.is_char_device():
            raise RecordingError(f"can't read {path}: it is not a file; parts of it are read several times")
        return path.open("rb")
    except (OSError, ValueError) as error:
        raise RecordingError(f"can't read {path}: {getattr(error, 'strerror', None) or error}") from None


def read_chunk(
    file: BinaryIO,
    place: ChunkPlace,
    channels: dict[int, Channel],
    wanted: Mapping[int, object] | None = None,
    times: bool = True,
) -> list[RawMessage]:
    """The messages of a chunk as they are in the file, of the channels of which `wanted` is true; channels
    found in it are added to `channels` before they are asked for. With `times`, those that the chunk claims
    are checked too.

    Raises:
        Exception: one of `DAMAGE`.
    """
    file.seek(place.offset)
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(place.length))))
    data = _content(chunk)
    size = len(data)
    _, part, chunk_offset, _, _ = place
    messages: list[RawMessage] = []
    first, last = 1 << 64, 0
    position = 0
    while position < size:
        opcode, length = _HEAD.unpack_from(data, position)
        start = position + 9
        position = start + length
        if position > size:
            raise ValueError("a record reaches beyond its chunk")
        if opcode == 5:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            if log_time < first:
                first = log_time
            if log_time > last:
                last = log_time
            if wanted is None or wanted[channel]:
                content = data[start + 22 : position]
                messages.append(
                    RawMessage(log_time, part, chunk_offset, start, channel, sequence, publish_time, content)
                )
        elif opcode == Opcode.CHANNEL:
            _add_channel(channels, data[start:position])
    if times and last and (first, last) != (chunk.message_start_time, chunk.message_end_time):
        raise ValueError("its times are not those of its messages")
    return messages


def _content(chunk: Chunk) -> bytes:
    """The content of a chunk, checked.

    Raises:
        Exception: one of `DAMAGE`.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise ValueError(f"it claims to hold {size} bytes")
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) not in (size, -1):
        raise ValueError("its content has not the length that it claims")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != size:
        raise ValueError("its content has not the length that it claims")
    return stream.read(size) if size else b""


def _records(layout: Layout, file: BinaryIO, lenient: bool) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset and length of the content) of every record before the summary that fits; the rest goes
    into the layout as damage.

    Raises:
        RecordingError: there are messages outside chunks, and the scan is not lenient.
    """
    position, size = len(MAGIC), layout.size
    while position < size:
        found = _record_at(file, position, size)
        if found and found[0] == Opcode.MESSAGE:
            if not lenient and _channel_of(file, position) in layout.channels:
                raise RecordingError(
                    f"{layout.path} has messages outside chunks (at byte {position}), which no recorder of "
                    "maniple writes"
                )
            found = None
        if found is None and (found := _salvaged(file, position, size)):
            what = f"the length of the chunk at byte {position + _HEAD.size} is wrong"
            layout.damage.append(Damage(layout.path, position, _HEAD.size, what))
        if found is None:
            resumed = _resume(file, position + 1, size)
            finished = _ends_finished(file, size)
            if resumed is None and not finished:
                layout.torn = size - position
                return
            end = size if resumed is None else resumed
            what = f"nothing that can be read from byte {position} to {end}"
            layout.damage.append(Damage(layout.path, position, end - position, what))
            position = end
            continue
        opcode, length = found
        position += _HEAD.size
        yield opcode, position, length
        position += length
        if opcode == Opcode.DATA_END:
            layout.data_end = position
            _note_summary(layout, file, position)
            return


def _record_at(file: BinaryIO, position: int, size: int) -> tuple[int, int] | None:
    """Opcode and length of the record at a place; None where none can be."""
    file.seek(position)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    start = position + _HEAD.size
    shape = _SHAPES.get(opcode)
    if shape is None or start + length > size:
        return None
    inner = _inner_length(file, start, shape, length)
    if inner is None or (inner != length and opcode != Opcode.MESSAGE):
        return None
    return opcode, length


def _inner_length(file: BinaryIO, start: int, shape: _Shape, most: int) -> int | None:
    """How long the content at a place is by the lengths within it; None where that is more than `most`."""
    at = 0
    for width, fixed in shape:
        if width:
            file.seek(start + at)
            number = file.read(width)
            if len(number) < width:
                return None
            at += width + int.from_bytes(number, "little")
        else:
            at += fixed
        if at > most:
            return None
    return at


def _salvaged(file: BinaryIO, position: int, size: int) -> tuple[int, int] | None:
    """Opcode and length of the chunk at a place of which everything fits but the length of its record."""
    file.seek(position)
    start = position + _HEAD.size
    if file.read(1) != bytes([Opcode.CHUNK]):
        return None
    length = _inner_length(file, start, _SHAPES[Opcode.CHUNK], size - start)
    if length is None or not _is_whole(file, ChunkPlace(0, 0, start, length, 0)):
        return None
    return Opcode.CHUNK, length


def _channel_of(file: BinaryIO, position: int) -> int:
    """The channel of the message record at a place."""
    file.seek(position + _HEAD.size)
    return int.from_bytes(file.read(2), "little")


def _resume(file: BinaryIO, position: int, size: int) -> int | None:
    """The next place where a record can be that is neither a header nor a message."""
    while position < size:
        file.seek(position)
        window = file.read(_WINDOW + _HEAD.size)
        for match in _CANDIDATE.finditer(window):
            place = position + match.start()
            if match.start() < _WINDOW and _record_at(file, place, size):
                return place
        position += _WINDOW
    return None


def _ends_finished(file: BinaryIO, size: int) -> bool:
    file.seek(max(0, size - len(MAGIC)))
    return file.read() == MAGIC


def _note(layout: Layout, file: BinaryIO, part: int, opcode: int, offset: int, length: int) -> None:
    """Add one record to the layout."""
    file.seek(offset)
    if opcode == Opcode.CHUNK:
        start, end, *_ = _CHUNK.unpack(file.read(_CHUNK.size))
        layout.chunks.append(ChunkPlace(start, part, offset, length, end))
        return
    if opcode not in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.CHANNEL, Opcode.SCHEMA):
        return
    content = file.read(length)
    stream = ReadDataStream(BytesIO(content))
    try:
        if opcode == Opcode.CHANNEL:
            _add_channel(layout.channels, content)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            layout.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            layout.metadata[metadata.name] = metadata.metadata
        elif zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little"):
            attachment = Attachment.read(stream)
            layout.attachments.setdefault(attachment.name, attachment)
        else:
            raise ValueError("it does not match its checksum")
    except DAMAGE as error:
        what = f"the {Opcode(opcode).name.lower()} at byte {offset} is damaged: {error}"
        layout.damage.append(Damage(layout.path, offset, length, what))


def _note_summary(layout: Layout, file: BinaryIO, start: int) -> None:
    """Compare what the summary says with what was found: it has a checksum, most of what it repeats not."""
    file.seek(start)
    summary = file.read(layout.size - start)
    end = len(summary) - len(MAGIC) - _FOOTER.size
    if end < 0 or not summary.endswith(MAGIC):
        layout.torn = len(summary)
        return
    layout.complete = True
    opcode, length, begin, _, crc = _FOOTER.unpack_from(summary, end)
    intact = opcode == Opcode.FOOTER and length == 20 and begin in (0, start)
    if not intact or (crc and zlib.crc32(summary[: -len(MAGIC) - 4]) != crc):
        what = f"the summary from byte {start} on is damaged (no message is in it)"
        layout.damage.append(Damage(layout.path, start, len(summary), what))
        return
    if crc:
        try:
            _compare_summary(layout, summary[:end], start)
        except DAMAGE as error:
            what = f"the summary from byte {start} on is damaged: {error}"
            layout.damage.append(Damage(layout.path, start, len(summary), what))


def _compare_summary(layout: Layout, summary: bytes, start: int) -> None:
    """Believe the summary, which matches its checksum, about channels and schemas.

    Raises:
        Exception: one of `DAMAGE`.
    """
    channels: dict[int, Channel] = {}
    told: dict[int, tuple[int, int]] = {}
    position = 0
    while position < len(summary):
        opcode, length = _HEAD.unpack_from(summary, position)
        position += _HEAD.size
        content = summary[position : position + length]
        if opcode == Opcode.CHANNEL:
            _add_channel(channels, content)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content)))
            layout.schemas[schema.id] = schema
        elif opcode == Opcode.CHUNK_INDEX:
            first, last, offset, _ = _PLACE.unpack_from(content)
            told[offset + _HEAD.size] = first, last
        position += length
    found = {place.offset: (place.start_ns, place.end_ns) for place in layout.chunks}
    if told != found and not layout.damage:
        offset, _ = min(told.items() ^ found.items())
        what = f"the chunk at byte {offset} is not where or when the summary says"
        layout.damage.append(Damage(layout.path, offset, 0, what))
    for id, channel in channels.items():
        if layout.channels.setdefault(id, channel) != channel:
            what = f"channel {id} is not what the summary says of it ({channel.topic})"
            layout.damage.append(Damage(layout.path, start, 0, what))
    layout.channels |= channels


def _add_channel(channels: dict[int, Channel], content: bytes) -> None:
    channel = Channel.read(ReadDataStream(BytesIO(content)))
    channels.setdefault(channel.id, channel)


def _is_whole(file: BinaryIO, place: ChunkPlace) -> bool:
    """Whether a chunk can be read; the last one before a power failure may be there in length only."""
    try:
        read_chunk(file, place, {}, times=False)
    except DAMAGE:
        return False
    return True
