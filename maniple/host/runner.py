"""Runs one node, whatever the clock: numbers what it sends, refuses what it must not see, keeps its journal.

Both hosts use it, so a node can't tell them apart. No I/O here.
"""

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.messages import Alive, Counters, Decided, Decisions, Journal, LinkReports, Message, Refused
from maniple.core.node import Node, Outgoing, Received
from maniple.core.scenario.types import Rates
from maniple.core.time import MILLISECOND, SECOND, Duration, Time
from maniple.host.inlets import Inlets
from maniple.host.journal import JournalBuffer
from maniple.host.stamper import Stamper

FLUSH_PERIOD: Duration = 200 * MILLISECOND
"""How often a host sends a node's journal: what a killed process had not yet journaled."""

HOST = "host"
"""Who makes what a host tells its node."""

_COUNTERS_PERIOD: Duration = SECOND

_KINDS_TOLD = 64
"""Kinds of refusals that are told apart between two flushes; more are garbage with forged names."""
_NAME_LENGTH = 64


class NodeRunner:
    """One life of one node; `rates` are those of the scenario, `scenario` is its digest."""

    def __init__(self, node: Node, incarnation: int, rates: Rates | None = None, scenario: str = "") -> None:
        self.node = node
        self.incarnation = incarnation
        stamper = Stamper(node.name, incarnation)
        self._stamp = stamper.stamp
        self._sent = stamper.sent
        self._told_sent: dict[str, int] = {}
        self._inlets = Inlets(rates or Rates())
        self._scenario = scenario
        self._journal = JournalBuffer()
        self._counters: Counter[str] = Counter()
        self._refused: dict[tuple[str, str, str], int] = {}
        self._stopped = False
        self._counters_due: Time = 0

    def start(self, now: Time) -> list[Envelope]:
        """Begin; returns what the node sends."""
        self._counters_due = now + _COUNTERS_PERIOD
        self._journal.started(now, self._scenario)
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

    def announced(self, node: str, incarnation: int) -> None:
        """A liveliness token of this life was seen: what it says on the fleet network is believed."""
        self._inlets.announced(node, incarnation)

    def is_news(self, envelope: Envelope) -> bool:
        """Whether nothing as new as this was received from its sender on its topic."""
        return self._inlets.is_news(envelope)

    def receive(self, envelope: Envelope, now: Time, latched: bool = False) -> list[Envelope]:
        """A message arrived, or was `latched` and asked for. Invalid, old or foreign ones reach the node as a
        `Refused` only."""
        judged = self._inlets.judge(envelope, now, latched)
        if isinstance(judged, str):
            return self.refuse(envelope.topic, envelope.source, judged, now)
        self._journal.received(envelope, now)
        return self._outgoing(self.node.on_message(Received(envelope.topic, judged), now), now)

    def refuse(self, topic: str, sender: str, reason: str, now: Time) -> list[Envelope]:
        """Count an input that the node must not see, and tell it so: of each kind the first at once, what
        follows with the next flush."""
        self._counters[f"refused_{reason}"] += 1
        self._inlets.refused(topic, sender)
        kind = topic, sender[:_NAME_LENGTH], reason
        if kind not in self._refused and len(self._refused) >= _KINDS_TOLD:
            kind = topic, "", reason
        if kind in self._refused:
            self._refused[kind] += 1
            return []
        self._refused[kind] = 0
        return self._tell(topics.HOST_REFUSED, Refused(topic=kind[0], sender=kind[1], reason=reason), now)

    def alive(self, node: str, incarnation: int, alive: bool, now: Time) -> list[Envelope]:
        """Tell the node who is alive."""
        return self._tell(topics.HOST_ALIVE, Alive(node=node, node_incarnation=incarnation, alive=alive), now)

    def count(self, what: str, by: int = 1) -> None:
        """Count something about this host."""
        self._counters[what] += by

    def flush(self, decided: Sequence[Decided], now: Time) -> list[Envelope]:
        """What the host itself sends: the journal, the fault decisions since the last flush, and what it
        counted."""
        sent: list[Envelope] = []
        self._inlets.decided(decided)
        if not self._stopped:
            sent += self._tell_refused(now)
            if now >= self._counters_due:
                sent += self._report(now)
        if decided:
            sent.append(self._stamp(topics.DECISIONS, Decisions(decided=tuple(decided)), now))
        calls, counts = self._journal.take(), self._newly_sent()
        if calls or counts:
            journal = topics.journal(self.node.name)
            sent.append(self._stamp(journal, Journal(calls=calls, sent=counts), now))
        return sent

    def _newly_sent(self) -> dict[str, int]:
        """How many messages went out on each topic on which some did since this was last asked."""
        changed = {
            topic: count
            for topic, count in self._sent.items()
            if self._told_sent.get(topic) != count and _is_counted(topic)
        }
        self._told_sent |= changed
        return changed

    def _report(self, now: Time) -> list[Envelope]:
        """What was counted: to the node, and of the links to everybody."""
        self._counters_due = now + _COUNTERS_PERIOD
        counters = {"received": self._inlets.received, **self._counters}
        if unknown := self._inlets.unknown_fields:
            counters["unknown_fields"] = unknown
        sent = self._tell(topics.HOST_COUNTERS, Counters(counters=counters), now)
        if links := self._inlets.report():
            sent.append(self._stamp(topics.links(self.node.name), LinkReports(links=links), now))
        return sent

    def _tell_refused(self, now: Time) -> list[Envelope]:
        """Tell the node what was refused since the first of each kind."""
        waiting, self._refused = self._refused, {}
        return [
            envelope
            for (topic, sender, reason), count in waiting.items()
            if count
            for envelope in self._tell(
                topics.HOST_REFUSED, Refused(topic=topic, sender=sender, reason=reason, count=count), now
            )
        ]

    def _tell(self, topic: str, message: Message, now: Time) -> list[Envelope]:
        """Give the node a message that this host made; the journal keeps its bytes."""
        if topic not in self.node.subscriptions:
            return []
        made = self._stamp(topic, message, now, host=HOST)
        self._journal.received(made, now)
        received = Received(topic, codec.decode(topic, made.data))
        return self._outgoing(self.node.on_message(received, now), now)

    def _outgoing(self, outgoing: Sequence[Outgoing], now: Time) -> list[Envelope]:
        return [self._stamp(topic, message, now) for topic, message in outgoing]


@lru_cache(4096)
def _is_counted(topic: str) -> bool:
    """Whether the journal says how many were sent: not of itself, nor of what never leaves the host."""
    row = topics.topic(topic)
    return row.network != "host" and row.type is not Journal
