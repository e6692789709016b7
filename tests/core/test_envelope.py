import zlib

import msgspec
import pytest

from maniple.core.codec import encode
from maniple.core.envelope import envelope_of
from maniple.core.errors import MessageError
from maniple.core.messages import Message


def test_the_header_is_that_of_the_message(example: tuple[str, Message]) -> None:
    name, message = example
    data = encode(message)
    envelope = envelope_of(name, data)
    found = (envelope.topic, envelope.source, envelope.incarnation, envelope.seq, envelope.stamp_ns)
    assert found == (name, message.source, message.incarnation, message.seq, message.stamp_ns)
    assert envelope.data is data
    assert envelope.crc32 == zlib.crc32(data)
    assert not envelope.altered


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x90",
        msgspec.msgpack.encode({"source": "r1"}),
        msgspec.msgpack.encode({"source": 1, "incarnation": 1, "seq": 1, "stamp_ns": 1}),
        msgspec.msgpack.encode({"source": "r1", "incarnation": 1, "seq": -1, "stamp_ns": 1}),
        msgspec.msgpack.encode({"source": "r1", "incarnation": 1, "seq": 2**63, "stamp_ns": 1}),
        msgspec.msgpack.encode({"source": "r1", "incarnation": 2**64 - 1, "seq": 1, "stamp_ns": 1}),
        msgspec.msgpack.encode({"source": "r1", "incarnation": 1, "seq": 1, "stamp_ns": 1}).replace(
            b"r1", b"\xff\xfe"
        ),
        b"\x91" * 100_000,
    ],
)
def test_bytes_without_a_header_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError, match="robot/r1/odometry: no header"):
        envelope_of("robot/r1/odometry", data)
