"""What a node takes in: of each sender and topic only what is whole, newer than before, and believable."""

import math
import zlib
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.errors import MessageError
from maniple.core.messages import Decided, LinkReport, Message
from maniple.core.scenario.types import Rates
from maniple.core.time import Duration, Time, to_seconds

Refusal: TypeAlias = Literal["corrupted", "sender", "unannounced", "leap", "old", "malformed"]
"""Why a message is not taken in: bits were flipped on the way; it is not its sender's to send; a life of the
sender that never showed itself; far ahead of what that life can have sent; not newer than the last; no
message of the topic's type."""

JITTER_S = 3.0
"""A message may be ahead of the last by what its sender sends in this time, and"""
HURRY = 2.0
"""in this much of the time since the last arrived, and"""
SPARE = 16
"""this many."""

MOST = 2**62
"""No limit."""

MOST_OPERATORS = 32
"""Senders that are heard on a topic that anybody may send on."""


MOST_NODES, MOST_LIVES = 4096, 64
"""Nodes, and the latest lives of each, that are known to have shown themselves."""


class _Inlet:
    """What a node takes from one sender on one topic."""

    __slots__ = ("arrived", "decode", "head", "injected", "missing", "newest", "received", "refused")

    def __init__(self, topic: str) -> None:
        self.decode: Callable[[bytes], Message] = codec.decoder(topic)
        self.head = codec.head(topic)
        self.newest = (-1, -1)
        self.arrived: Time = 0
        self.missing = self.received = self.injected = self.refused = 0

    def take(self, envelope: Envelope, now: Time) -> None:
        """Go on from this message."""
        incarnation, seq = self.newest
        if envelope.incarnation == incarnation:
            self.missing += envelope.seq - seq - 1
        self.newest = envelope.incarnation, envelope.seq
        self.arrived = now
        self.received += 1


class Inlets:
    """All that one node takes in; `rates` are those of the scenario."""

    def __init__(self, rates: Rates) -> None:
        self._rates = rates
        self._inlets: dict[tuple[str, str], _Inlet] = {}
        self._announced: dict[str, set[int]] = {}
        self.unknown_fields = 0
        """That were ignored in what was taken in."""

    @property
    def received(self) -> int:
        """Messages that were taken in."""
        return sum(inlet.received for inlet in self._inlets.values())

    def announced(self, node: str, incarnation: int) -> None:
        """A life of a node showed itself."""
        if node in self._announced or len(self._announced) < MOST_NODES:
            lives = self._announced.setdefault(node, set())
            lives.add(incarnation)
            if len(lives) > MOST_LIVES:
                lives.remove(min(lives))

    def is_news(self, envelope: Envelope) -> bool:
        """Whether nothing as new as this was taken from its sender on its topic."""
        inlet = self._inlets.get((envelope.topic, envelope.source))
        return inlet is None or (envelope.incarnation, envelope.seq) > inlet.newest

    def judge(self, envelope: Envelope, now: Time, latched: bool = False) -> Message | Refusal:
        """The message in an envelope that arrived `now` by the node's clock, or why it is not taken in.

        What is `latched` may be of a life that is over.
        """
        if envelope.altered and zlib.crc32(envelope.data) != envelope.crc32:
            return "corrupted"
        topic, source = envelope.topic, envelope.source
        inlet = self._inlets.get((topic, source)) or self._new_inlet(topic, source)
        if inlet is None:
            return "sender"
        incarnation, newest = inlet.newest
        if envelope.incarnation > incarnation:
            if not (latched or self._believed(topic, source, envelope.incarnation)):
                return "unannounced"
        elif envelope.incarnation < incarnation or envelope.seq <= newest:
            return "old"
        elif envelope.seq > newest + SPARE and envelope.seq > newest + self._most_ahead(
            topic, now - inlet.arrived
        ):
            return "leap"
        try:
            message = inlet.decode(envelope.data)
        except MessageError:
            return "malformed"
        if not envelope.data.startswith(inlet.head):
            self.unknown_fields += codec.unknown_fields(topic, envelope.data)
        inlet.take(envelope, now)
        return message

    def refused(self, topic: str, source: str) -> None:
        """A message was not taken in."""
        if inlet := self._inlets.get((topic, source)):
            inlet.refused += 1

    def decided(self, decided: Sequence[Decided]) -> None:
        """What fault injection did to messages."""
        for one in decided:
            if one.dropped and (inlet := self._inlets.get((one.topic, one.source))):
                inlet.injected += 1

    def report(self) -> tuple[LinkReport, ...]:
        """What was counted of the links that faults apply to."""
        return tuple(
            LinkReport(source, topic, inlet.received, inlet.missing, inlet.injected, inlet.refused)
            for (topic, source), inlet in sorted(self._inlets.items())
            if topics.topic(topic).faults
        )

    def _new_inlet(self, topic: str, source: str) -> _Inlet | None:
        """For a sender that may send on a topic."""
        known = topics.has_known_senders(topic)
        others = 0 if known else sum(name == topic for name, _ in self._inlets)
        if not topics.may_send(topic, source) or others >= MOST_OPERATORS:
            return None
        inlet = self._inlets[topic, source] = _Inlet(topic)
        return inlet

    def _believed(self, topic: str, source: str, incarnation: int) -> bool:
        """Whether a newer life may speak here: on the fleet network it has to have shown itself, where its
        name alone may send."""
        if topics.topic(topic).network != "fleet" or not topics.has_known_senders(topic):
            return True
        return incarnation in self._announced.get(source, ())

    def _most_ahead(self, topic: str, elapsed: Duration) -> int:
        """How far ahead of the last a message can be, `elapsed` after that arrived."""
        rate_hz = topics.rate_hz(topic, self._rates)
        if not rate_hz:
            return MOST
        return SPARE + math.ceil(rate_hz * (JITTER_S + HURRY * to_seconds(elapsed)))
