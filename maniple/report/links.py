"""What became of the messages on links that faults apply to, counted from journals and decisions."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from maniple.core import codec, topics
from maniple.core.errors import MessageError
from maniple.core.messages import Call, Cause, Decided, Decisions, Journal, Refused
from maniple.core.time import Time


class _Flow:
    """One directed link: a sender's life, a topic, a receiver."""

    __slots__ = ("causes", "due", "extra_due", "first", "last", "passed", "refused", "spoilt_due", "taken")

    def __init__(self) -> None:
        self.first = -1
        self.last = -1
        self.taken, self.passed, self.due = array("q"), array("q"), array("q")
        self.spoilt_due, self.extra_due = array("q"), array("q")
        self.causes: Counter[Cause] = Counter()
        self.refused = 0

    @property
    def sent(self) -> int:
        """From the first that the receiver knew of to the last."""
        return self.last - self.first + 1

    @property
    def dropped(self) -> int:
        """Lost by fault injection."""
        return self.causes.total()

    @property
    def accepted(self) -> int:
        """Of which the receiver took in."""
        return len(self.taken)

    def missing(self, until: Time) -> int:
        """What never arrived, though nobody dropped it. What fault injection let pass is still held back if
        it is newer than all that arrived, or due after `until`, when the receiver did its last; what it
        corrupted is refused when it is due."""
        newest = max(self.taken, default=-1)
        late = {seq for seq, due in zip(self.passed, self.due, strict=True) if seq > newest or due > until}
        held = len(late.difference(self.taken)) if late else 0
        held += sum(due > until for due in self.spoilt_due)
        refused = self.refused - self.copies(until)
        return max(self.sent - self.accepted - self.dropped - refused - held, 0)

    def copies(self, until: Time) -> int:
        """Second copies that arrived by then, and were refused: they are no messages of their own."""
        return min(self.refused, sum(due <= until for due in self.extra_due))

    def decided(self, decided: Decided, now: Time) -> None:
        """Fault injection decided, and said so at `now`."""
        self.saw(decided.seq)
        if decided.dropped:
            self.causes[decided.cause or "loss"] += 1  # recordings of before there were causes
            return
        if decided.corrupted:
            self.spoilt_due.append(now + decided.delay_ns)
        else:
            self.passed.append(decided.seq)
            self.due.append(now + decided.delay_ns)
        if decided.copy_delay_ns >= 0:
            self.extra_due.append(now + decided.copy_delay_ns)

    def saw(self, seq: int) -> None:
        self.first = seq if self.first < 0 else min(self.first, seq)
        self.last = max(self.last, seq)


class LinkTotals(NamedTuple):
    """What became of the messages of one link, over all lives of its sender."""

    source: str
    destination: str
    topic: str
    sent: int
    delivered: int
    lost_injected: int
    lost_other: int
    refused: int
    causes: tuple[tuple[Cause, int], ...] = ()
    """Of what injection lost: how much by each cause, the largest first."""


class LinkCounts:
    """Counts messages over links, each from the first message its receiver knew of to the last."""

    def __init__(self) -> None:
        self._flows: dict[tuple[str, str, str, int], _Flow] = {}
        self._until: defaultdict[str, Time] = defaultdict(int)
        self._refused = 0

    def journal(self, journal: Journal) -> None:
        """A receiver's journal; what it said itself in an earlier life came over no link."""
        receiver = journal.source
        self._until[receiver] = max(self._until[receiver], *(call.now_ns for call in journal.calls), 0)
        for call in journal.calls:
            if call.kind != "message":
                continue
            if call.name == topics.HOST_REFUSED:
                self._refusal(call, receiver)
            elif call.source != receiver and _faults_apply(call.name):
                flow = self._flow(receiver, call.source, call.name, call.incarnation)
                flow.saw(call.seq)
                flow.taken.append(call.seq)

    def decisions(self, decisions: Decisions) -> None:
        """What a receiver's fault injection did."""
        receiver = decisions.source
        for decided in decisions.decided:
            flow = self._flow(receiver, decided.source, decided.topic, decided.incarnation)
            flow.decided(decided, decisions.stamp_ns)

    def totals(self) -> dict[str, int]:
        """`sent`, `delivered`, `lost_injected`, `lost_other` and `refused` over all links.

        What is still held back by an injected delay at the end is sent, and none of the others.
        """
        sent = delivered = injected = missing = copies = 0
        for (receiver, *_), flow in self._flows.items():
            sent += flow.sent
            delivered += flow.accepted
            injected += flow.dropped
            missing += flow.missing(self._until[receiver])
            copies += flow.copies(self._until[receiver])
        return {
            "sent": sent,
            "delivered": delivered,
            "lost_injected": injected,
            "lost_other": missing,
            "refused": self._refused - copies,
        }

    def links(self) -> list[LinkTotals]:
        """The same of every link, sorted by topic, source and destination."""
        flows: defaultdict[tuple[str, str, str], list[_Flow]] = defaultdict(list)
        for (receiver, source, topic, _), flow in self._flows.items():
            flows[topic, source, receiver].append(flow)
        return [
            LinkTotals(
                source=source,
                destination=receiver,
                topic=topic,
                sent=sum(life.sent for life in lives),
                delivered=sum(life.accepted for life in lives),
                lost_injected=sum(life.dropped for life in lives),
                lost_other=sum(life.missing(self._until[receiver]) for life in lives),
                refused=max(life.refused - life.copies(self._until[receiver]) for life in lives),
                causes=tuple(sum((life.causes for life in lives), Counter[Cause]()).most_common()),
            )
            for (topic, source, receiver), lives in sorted(flows.items())
        ]

    def spans(self) -> dict[tuple[str, str, str, int], tuple[int, int]]:
        """First and last `seq` that the receiver knew of, by (receiver, source, topic, incarnation)."""
        return {key: (flow.first, flow.last) for key, flow in self._flows.items()}

    def _refusal(self, call: Call, receiver: str) -> None:
        for refused in _refused_in(call):
            if not refused.topic or not _faults_apply(refused.topic):
                continue
            self._refused += refused.count
            for (to, sender, topic, _), flow in self._flows.items():
                if (to, sender, topic) == (receiver, refused.sender, refused.topic):
                    flow.refused += refused.count

    def _flow(self, receiver: str, source: str, topic: str, incarnation: int) -> _Flow:
        key = (receiver, source, topic, incarnation)
        flow = self._flows.get(key)
        if flow is None:
            flow = self._flows[key] = _Flow()
        return flow


def _refused_in(call: Call) -> Iterator[Refused]:
    try:
        message = codec.decode(call.name, call.data or b"")
    except MessageError:
        return
    if isinstance(message, Refused):
        yield message


@cache
def _faults_apply(name: str) -> bool:
    try:
        return topics.topic(name).faults
    except MessageError:
        return False
