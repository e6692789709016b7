"""How much of what was sent arrived, over time, message by message."""

from array import array
from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maniple.core import topics
from maniple.core.envelope import Header
from maniple.core.geometry import Floats
from maniple.core.messages import Decisions, Journal
from maniple.core.time import SECOND, Time
from maniple.report.links import LinkCounts
from maniple.report.samples import Samples, Stamps

Taken = NDArray[np.bool_]

SPANS = 80
"""At most this many spans of time,"""
SHORTEST_S = 2.0
"""of at least this length."""


class Share(NamedTuple):
    """How much of one kind of message was delivered, over the links it is sent on."""

    kind: str
    links: int
    t: Floats
    """(k,), s: the middles of spans of time."""
    shares: Floats
    """(links, k): of what was sent in the span; NaN where nothing was."""


class Delivery:
    """Compares what was sent with what receivers say that they took in."""

    def __init__(self) -> None:
        self.links = LinkCounts()
        self._sent: defaultdict[tuple[str, str, int], Samples] = defaultdict(lambda: Samples(1))
        self._taken: defaultdict[tuple[str, str, str, int], array[int]] = defaultdict(lambda: array("q"))

    def sent(self, topic: str, header: Header) -> None:
        """A message was recorded."""
        self._sent[header.source, topic, header.incarnation].add(header.stamp_ns, (header.seq,))

    def journal(self, journal: Journal) -> None:
        """A receiver's journal."""
        self.links.journal(journal)
        for call in journal.calls:
            if call.kind == "message" and call.source != journal.source and call.name != topics.HOST_REFUSED:
                self._taken[journal.source, call.source, call.name, call.incarnation].append(call.seq)

    def decisions(self, decisions: Decisions) -> None:
        """What a receiver's fault injection did."""
        self.links.decisions(decisions)

    def shares(self, begin: Time) -> tuple[Share, ...]:
        """By kind of message. A message counts when it was sent, if its receiver was there to hear of it."""
        flows: defaultdict[str, dict[tuple[str, str, str], list[tuple[Stamps, Taken]]]]
        flows = defaultdict(lambda: defaultdict(list))
        for (receiver, source, topic, life), (first, last) in self.links.spans().items():
            stamps, rows = self._sent[source, topic, life].arrays()
            seqs = rows[:, 0].astype(np.int64)
            heard = (seqs >= first) & (seqs <= last)
            taken = np.isin(seqs[heard], np.array(self._taken[receiver, source, topic, life], dtype=np.int64))
            kind = topics.topic(topic).pattern.rsplit("/", 1)[-1]
            flows[kind][receiver, source, topic].append((stamps[heard], taken))
        lives = (lives for links in flows.values() for lives in links.values())
        sent = np.concatenate([np.empty(0), *(stamps for link in lives for stamps, _ in link)])
        if not len(sent):
            return ()
        span = max(SHORTEST_S, float(np.ptp(sent)) / SECOND / SPANS) * SECOND
        edges = np.arange(sent.min(), sent.max() + span, span)
        middles = (edges[:-1] + 0.5 * span - begin) / SECOND
        return tuple(
            Share(kind, len(links), middles, np.array([_share(lives, edges) for lives in links.values()]))
            for kind, links in sorted(flows.items())
        )


def _share(lives: list[tuple[Stamps, Taken]], edges: Floats) -> Floats:
    """Delivered of sent of one link in each span."""
    stamps = np.concatenate([stamps for stamps, _ in lives])
    taken = np.concatenate([taken for _, taken in lives])
    sent, _ = np.histogram(stamps, edges)
    delivered, _ = np.histogram(stamps[taken], edges)
    return np.where(sent > 0, delivered / np.maximum(sent, 1), np.nan)
