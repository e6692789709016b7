"""Runs one node, whatever the clock: numbers what it sends, refuses what it must not see, keeps its journal.

Both hosts use it, so a node can't tell them apart. No I/O here.
"""

import zlib
from collections import Counter
from collections.abc import Sequence

import msgspec

from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.errors import MessageError
from maniple.core.messages import Alive, Counters, Decided, Decisions, Journal, Message, Refused
from maniple.core.node import Node, Outgoing, Received
from maniple.core.time import MILLISECOND, SECOND, Duration, Time
from maniple.host.journal import JournalBuffer

FLUSH_PERIOD: Duration = 200 * MILLISECOND
"""How often a host sends a node's journal: what a killed process had not yet journaled."""

_COUNTERS_PERIOD: Duration = SECOND
_HOST = "host"


class _Inlet:
    """What a node takes from one sender on one topic."""

    __slots__ = ("decode", "foreign", "newest")

    def __init__(self, topic: str, source: str) -> None:
        self.newest = (-1, -1)
        self.decode = codec.decoder(topic)
        self.foreign = topics.sender_of(topic) not in ("", source)


class NodeRunner:
    """One life of one node."""

    def __init__(self, node: Node, incarnation: int) -> None:
        self.node = node
        self.incarnation = incarnation
        self._sent: dict[str, int] = {}
        self._inlets: dict[tuple[str, str], _Inlet] = {}
        self._journal = JournalBuffer()
        self._counters: Counter[str] = Counter()
        self._received = 0
        self._stopped = False
        self._counters_due: Time = 0

    def start(self, now: Time) -> list[Envelope]:
        """Begin; returns what the node sends."""
        self._counters_due = now + _COUNTERS_PERIOD
        self._journal.started(now)
        return self._outgoing(self.node.on_start(now), now)

    def stop(self, decided: Sequence[Decided], now: Time) -> list[Envelope]:
        """End; returns what the node sends last and the rest of its journal."""
        self._stopped = True
        self._journal.stopped(now)
        sent = self._outgoing(self.node.on_stop(now), now)
        return sent + self.flush(decided, now)

    def timer(self, name: str, now: Time) -> list[Envelope]:
        """A timer of the node is due."""
        self._journal.timer(name, now)
        return self._outgoing(self.node.on_timer(name, now), now)

    def is_news(self, envelope: Envelope) -> bool:
        """Whether nothing as new as this was received from its sender on its topic."""
        inlet = self._inlets.get((envelope.topic, envelope.source))
        return inlet is None or (envelope.incarnation, envelope.seq) > inlet.newest

    def receive(self, envelope: Envelope, now: Time) -> list[Envelope]:
        """A message arrived. Invalid, old or foreign ones reach the node as a `Refused` only."""
        topic, source = envelope.topic, envelope.source
        inlet = self._inlets.get((topic, source))
        if inlet is None:
            inlet = self._inlets[topic, source] = _Inlet(topic, source)
        mark = (envelope.incarnation, envelope.seq)
        if mark <= inlet.newest:
            return self.refuse(topic, source, "old", now)
        if inlet.foreign:
            return self.refuse(topic, source, "sender", now)
        try:
            message = inlet.decode(envelope.data)
        except MessageError:
            return self.refuse(topic, source, "malformed", now)
        inlet.newest = mark
        self._received += 1
        self._journal.received(envelope, now)
        return self._outgoing(self.node.on_message(Received(topic, message), now), now)

    def refuse(self, topic: str, sender: str, reason: str, now: Time) -> list[Envelope]:
        """Count an input that the node must not see, and tell it so."""
        self._counters[f"refused_{reason}"] += 1
        return self._tell(topics.HOST_REFUSED, Refused(topic=topic, sender=sender, reason=reason), now)

    def alive(self, node: str, incarnation: int, alive: bool, now: Time) -> list[Envelope]:
        """Tell the node who is alive."""
        return self._tell(topics.HOST_ALIVE, Alive(node=node, node_incarnation=incarnation, alive=alive), now)

    def count(self, what: str, by: int = 1) -> None:
        """Count something about this host."""
        self._counters[what] += by

    def flush(self, decided: Sequence[Decided], now: Time) -> list[Envelope]:
        """What the host itself sends: the journal and the fault decisions since the last flush."""
        sent: list[Envelope] = []
        if not self._stopped and now >= self._counters_due:
            self._counters_due = now + _COUNTERS_PERIOD
            sent += self._tell(
                topics.HOST_COUNTERS, Counters(counters={"received": self._received, **self._counters}), now
            )
        if decided:
            sent.append(self._stamp(topics.DECISIONS, Decisions(decided=tuple(decided)), now))
        if calls := self._journal.take():
            sent.append(self._stamp(topics.journal(self.node.name), Journal(calls=calls), now))
        return sent

    def _tell(self, topic: str, message: Message, now: Time) -> list[Envelope]:
        """Give the node a message that this host made; the journal keeps its bytes."""
        if topic not in self.node.subscriptions:
            return []
        made = self._stamp(topic, message, now, source=_HOST)
        self._journal.received(made, now)
        received = Received(topic, codec.decode(topic, made.data))
        return self._outgoing(self.node.on_message(received, now), now)

    def _outgoing(self, outgoing: Sequence[Outgoing], now: Time) -> list[Envelope]:
        return [self._stamp(topic, message, now) for topic, message in outgoing]

    def _stamp(self, topic: str, message: Message, now: Time, source: str | None = None) -> Envelope:
        seq = self._sent.get(topic, 0)
        self._sent[topic] = seq + 1
        name = self.node.name if source is None else source
        stamped = msgspec.structs.replace(
            message, source=name, incarnation=self.incarnation, seq=seq, stamp_ns=now
        )
        data = codec.encode(stamped)
        return Envelope(topic, name, self.incarnation, seq, now, data, zlib.crc32(data), source is not None)
