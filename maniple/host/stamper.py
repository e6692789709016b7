"""Numbers and encodes what a node says: the same in a run and when it is run again."""

import zlib

import msgspec

from maniple.core import codec
from maniple.core.envelope import Envelope
from maniple.core.messages import Message
from maniple.core.time import Time


class Stamper:
    """For one life of one node."""

    def __init__(self, node: str, incarnation: int) -> None:
        self._node = node
        self._incarnation = incarnation
        self.sent: dict[str, int] = {}
        """How many were stamped on each topic."""

    def stamp(self, topic: str, message: Message, now: Time, host: str = "") -> Envelope:
        """The next message on a topic, sent `now` by the node's clock; of `host` where the node did not make
        it and it never leaves."""
        seq = self.sent.get(topic, 0)
        self.sent[topic] = seq + 1
        name = host or self._node
        stamped = msgspec.structs.replace(
            message, source=name, incarnation=self._incarnation, seq=seq, stamp_ns=now
        )
        data = codec.encode(stamped)
        return Envelope(topic, name, self._incarnation, seq, now, data, zlib.crc32(data), host != "")
