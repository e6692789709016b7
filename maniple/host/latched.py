"""What a platoon remembers of itself: the last value of every latched topic, and who has lived. Pure: told
what arrives, asked what is known."""

from collections.abc import Iterable, Mapping
from typing import Literal, TypeAlias

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError
from maniple.core.messages import Message

Kept: TypeAlias = Literal["news", "old", "unannounced", "sender", "malformed"]
"""What became of a message: it is the last value now; there is one as new; its life never showed itself, so
that it waits for that; it is not its sender's to send; it is no message of a latched topic."""

_MOST_WAITING = 256
_MOST_NODES = 4096


class Lives:
    """The highest incarnation of every node that was ever seen."""

    def __init__(self) -> None:
        self._highest: dict[str, int] = {}

    def seen(self, node: str, incarnation: int) -> None:
        """A life of a node is there, or was."""
        if node in self._highest or len(self._highest) < _MOST_NODES:
            self._highest[node] = max(incarnation, self._highest.get(node, 0))

    def next(self, node: str) -> int:
        """The number of the next life of a node."""
        return self._highest.get(node, 0) + 1

    def claim(self, node: str, wanted: int | None = None) -> int:
        """The number a new life of a node has from now on: the next, or a higher one that it wants. One that
        was there already is not given twice."""
        life = self.next(node) if wanted is None else max(wanted, self.next(node))
        if wanted in (None, life):
            self.seen(node, life)
        return life

    def all(self) -> Mapping[str, int]:
        """The highest incarnation by node."""
        return dict(self._highest)


class LatchedStore:
    """The newest message of every latched topic. Where the network lets only one node send, lives are
    believed that `lives` has seen; without it, all."""

    def __init__(self, lives: Lives | None = None) -> None:
        self._lives = lives
        self._newest: dict[str, Envelope] = {}
        self._waiting: dict[str, Envelope] = {}
        self._decoded: dict[str, tuple[Envelope, Message]] = {}

    def keep(self, topic: str, data: bytes) -> Kept:
        """Remember a message, unless it is garbage or one as new is known."""
        try:
            if not topics.topic(topic).latched:
                return "malformed"
            codec.decode(topic, data)
            envelope = envelope_of(topic, data)
        except MessageError:
            return "malformed"
        return self._keep(envelope)

    def announced(self) -> None:
        """A life has shown itself: what waited for it is kept."""
        waiting, self._waiting = self._waiting, {}
        for envelope in waiting.values():
            self._keep(envelope)

    def newest(self, topic: str) -> Envelope | None:
        """The last message of a topic."""
        return self._newest.get(topic)

    def message(self, topic: str) -> Message | None:
        """The same, decoded."""
        known = self._newest.get(topic)
        if known is None:
            return None
        if self._decoded.get(topic, (None,))[0] is not known:
            self._decoded[topic] = known, codec.decode(topic, known.data)
        return self._decoded[topic][1]

    def all(self) -> Iterable[Envelope]:
        """The last message of every topic."""
        return tuple(self._newest.values())

    def answer(self, topic: str) -> dict[str, bytes]:
        """What is known of a topic: its bytes by its name, or nothing."""
        known = self._newest.get(topic)
        return {} if known is None else {topic: known.data}

    def _keep(self, envelope: Envelope) -> Kept:
        topic, sender = envelope.topic, topics.sender_of(envelope.topic)
        if sender not in ("", envelope.source):
            return "sender"
        known = self._newest.get(topic)
        if known is not None and mark_of(envelope) <= mark_of(known):
            return "old"
        if sender and self._lives is not None and envelope.incarnation >= self._lives.next(sender):
            if topic in self._waiting or len(self._waiting) < _MOST_WAITING:
                self._waiting[topic] = envelope
            return "unannounced"
        self._newest[topic] = envelope
        return "news"


def mark_of(envelope: Envelope) -> tuple[int, int]:
    """What orders the messages of a topic: incarnation, then sequence number."""
    return envelope.incarnation, envelope.seq
