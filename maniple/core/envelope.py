"""A message on its way: its wire bytes and what is known of them without decoding."""

import zlib

import msgspec

from maniple.core.errors import MessageError
from maniple.core.messages import Count
from maniple.core.time import Time


class Envelope(msgspec.Struct, frozen=True, gc=False):
    """Bytes on a topic, with the header that identifies them."""

    topic: str
    source: str
    incarnation: int
    seq: int
    stamp_ns: Time
    data: bytes
    crc32: int
    altered: bool = False
    """Whether the bytes are not what the source sent: made by a host, or corrupted on the way."""


class Header(msgspec.Struct, frozen=True, gc=False):
    """What identifies a message: the fields that every message begins with."""

    source: str
    incarnation: Count
    seq: Count
    stamp_ns: Count


_read_header = msgspec.msgpack.Decoder(Header).decode


def header_of(topic: str, data: bytes) -> Header:
    """The header in wire bytes.

    Raises:
        MessageError: they hold none.
    """
    try:
        return _read_header(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"{topic}: no header: {error}") from None


def envelope_of(topic: str, data: bytes) -> Envelope:
    """The envelope of wire bytes that arrived on a topic.

    Raises:
        MessageError: they hold no header.
    """
    header = header_of(topic, data)
    return Envelope(
        topic, header.source, header.incarnation, header.seq, header.stamp_ns, data, zlib.crc32(data)
    )
