"""Fault injection at a receiver: pure decisions for each message, remembered for the log."""

from collections.abc import Collection, Sequence

from maniple.core.envelope import Envelope
from maniple.core.faults import Link
from maniple.core.messages import Decided
from maniple.core.scenario.types import Fault
from maniple.core.time import Duration
from maniple.core.topics import topic


class FaultyReceiver:
    """What the network's faults do to the messages for one destination, but for those from `local` nodes."""

    def __init__(
        self, destination: str, plan: Sequence[Fault], seed: int, local: Collection[str] = ()
    ) -> None:
        self._destination = destination
        self._plan = tuple(plan)
        self._seed = seed
        self._local = local
        self._links: dict[tuple[str, str], Link] = {}
        self._decided: list[Decided] = []

    def admit(self, envelope: Envelope) -> Duration | None:
        """How long the message is held back, in ns, or None where it is lost."""
        if not self._plan:
            return 0
        link = self._links.get((envelope.source, envelope.topic))
        if link is None:
            exempt = envelope.source in self._local or not topic(envelope.topic).faults
            applies = () if exempt else self._plan
            link = Link(applies, self._seed, envelope.source, self._destination, envelope.topic)
            self._links[envelope.source, envelope.topic] = link
        if not link:
            return 0
        decision = link.decide(envelope.incarnation, envelope.seq)
        self._decided.append(
            Decided(
                envelope.source,
                envelope.topic,
                envelope.incarnation,
                envelope.seq,
                decision.dropped,
                decision.delay,
            )
        )
        return None if decision.dropped else decision.delay

    def take_decided(self) -> tuple[Decided, ...]:
        """The decisions since the last call."""
        decided = tuple(self._decided)
        self._decided.clear()
        return decided
