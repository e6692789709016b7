"""Fault injection at a receiver: pure decisions for each message, remembered for the log."""

from typing import NamedTuple

from msgspec.structs import replace

from maniple.core.clocks import NodeClock, node_clock
from maniple.core.envelope import Envelope
from maniple.core.faults import beside
from maniple.core.links import Link, RateQueue
from maniple.core.messages import Decided, FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.core.time import Duration, Time
from maniple.core.topics import topic

_MOST_LINKS = 4096
"""Links that are remembered: senders with forged names cost no more than this."""


class Arrival(NamedTuple):
    """One copy of a message that gets through."""

    delay: Duration
    """How long it is held back, in ns."""
    envelope: Envelope
    """Where bits were flipped, `altered`, with these bytes and the CRC of what was sent."""


class FaultyReceiver:
    """What a plan does to the messages for one destination, but for those from the same computer.

    `epoch` is the start of the run in true scenario time: the clocks of senders that are off are off from
    there, and their stamps are set right by it.
    """

    def __init__(self, destination: str, scenario: Scenario, plan: FaultPlan, epoch: Time) -> None:
        self._destination = destination
        self._seed = scenario.seed
        self._local = beside(destination, scenario)
        self._clocks = {error.node: node_clock(scenario, error.node, epoch) for error in scenario.clocks}
        self._queues: dict[tuple[int, str], RateQueue] = {}
        self._links: dict[tuple[str, str], tuple[Link, NodeClock]] = {}
        self._decided: list[Decided] = []
        self._plan = plan
        self.replan(plan)

    def replan(self, plan: FaultPlan) -> None:
        """Act by this plan from now on. What waits before rules that stay as they are goes on waiting."""
        stays = {i for i, (a, b) in enumerate(zip(self._plan.faults, plan.faults, strict=False)) if a == b}
        self._queues = {key: queue for key, queue in self._queues.items() if key[0] in stays}
        self._links.clear()
        self._plan = plan
        self.idle = not (plan.faults or plan.partitions)
        """Whether the plan does nothing to any message."""

    def admit(self, envelope: Envelope) -> tuple[Arrival, ...]:
        """What arrives of a message: nothing where it is lost, two where it is duplicated."""
        if self.idle:
            return (Arrival(0, envelope),)
        link, clock = self._links.get((envelope.source, envelope.topic)) or self._link(envelope)
        if not link:
            return (Arrival(0, envelope),)
        life, seq = envelope.incarnation, envelope.seq
        cause, delay, copy_delay, corrupted = link.decide(
            life, seq, clock.true(envelope.stamp_ns), len(envelope.data)
        )
        self._decided.append(
            Decided(
                envelope.source,
                envelope.topic,
                life,
                seq,
                cause != "",
                delay,
                corrupted,
                -1 if copy_delay is None else copy_delay,
                cause,
            )
        )
        if cause:
            return ()
        if corrupted:
            envelope = replace(envelope, data=link.flipped(life, seq, envelope.data), altered=True)
        if copy_delay is None:
            return (Arrival(delay, envelope),)
        return Arrival(delay, envelope), Arrival(copy_delay, envelope)

    def delay(self, envelope: Envelope) -> Duration:
        """How long a latched value is held back that a router hands over: asking again would get it in the
        end, so it is not lost, but no sooner than over the link it came from."""
        link, clock = self._links.get((envelope.source, envelope.topic)) or self._link(envelope)
        true = clock.true(envelope.stamp_ns)
        return link.decide(envelope.incarnation, envelope.seq, true, len(envelope.data)).delay

    def take_decided(self) -> tuple[Decided, ...]:
        """The decisions since the last call."""
        decided = tuple(self._decided)
        self._decided.clear()
        return decided

    def _link(self, envelope: Envelope) -> tuple[Link, NodeClock]:
        if len(self._links) >= _MOST_LINKS:
            self._links.clear()
            self._queues.clear()
        source, name = envelope.source, envelope.topic
        exempt = source in self._local or not topic(name).faults
        plan = FaultPlan(since_ns=self._plan.since_ns) if exempt else self._plan
        link = Link(plan, self._seed, source, self._destination, name, self._queues)
        known = self._links[source, name] = link, self._clocks.get(source, NodeClock())
        return known
