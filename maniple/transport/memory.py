"""The network of virtual time: who receives what and when, faults included. Carries real wire bytes."""

from collections.abc import Mapping
from typing import TypeAlias

from maniple.core.envelope import Envelope
from maniple.core.faults import beside, plan_of
from maniple.core.messages import Decided, FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.core.time import VIRTUAL_EPOCH, Duration, Time, from_seconds
from maniple.core.topics import topic
from maniple.transport.faulty import FaultyReceiver

Delivery: TypeAlias = tuple[Time, str, Envelope]
"""One copy of a message: when it arrives, at which node, and what arrives."""

_Route: TypeAlias = tuple[tuple[str, Duration, FaultyReceiver], ...]


class MemoryNetwork:
    """Routes envelopes by topic name; links take at least the least latency of their network, and within one
    computer that of the hardware. All times are of true scenario time, but for the stamps of senders whose
    clocks are off. The plan is that of the scenario until another takes its place."""

    def __init__(self, scenario: Scenario, subscriptions: Mapping[str, frozenset[str]]) -> None:
        self._latency: dict[str, Duration] = {
            "fleet": from_seconds(scenario.network.fleet_latency_s),
            "hardware": from_seconds(scenario.network.hardware_latency_s),
        }
        self._routes: dict[tuple[str, str], _Route] = {}
        self._subscriptions = {name: subscriptions[name] for name in sorted(subscriptions)}
        self._beside = {name: beside(name, scenario) for name in self._subscriptions}
        plan = plan_of(scenario, VIRTUAL_EPOCH)
        self._receivers = {
            name: FaultyReceiver(name, scenario, plan, VIRTUAL_EPOCH) for name in self._subscriptions
        }

    def replan(self, plan: FaultPlan) -> None:
        """Act by this plan from now on."""
        for receiver in self._receivers.values():
            receiver.replan(plan)

    def send(self, envelope: Envelope, now: Time) -> list[Delivery]:
        """What arrives of a message sent now: where, and when."""
        route = self._routes.get((envelope.topic, envelope.source))
        if route is None:
            route = self._route(envelope.topic, envelope.source)
            self._routes[envelope.topic, envelope.source] = route
        deliveries = []
        for name, latency, receiver in route:
            if receiver.idle:
                deliveries.append((now + latency, name, envelope))
                continue
            for delay, arrived in receiver.admit(envelope):
                deliveries.append((now + latency + delay, name, arrived))
        return deliveries

    def hand_over(self, envelope: Envelope, receiver: str, now: Time) -> Time:
        """When a latched value arrives at a node that asks for it now."""
        near = envelope.source == receiver or envelope.source in self._beside[receiver]
        latency = self._latency["hardware" if near else topic(envelope.topic).network]
        return now + latency + self._receivers[receiver].delay(envelope)

    def take_decided(self, receiver: str) -> tuple[Decided, ...]:
        """The fault decisions at one receiver since the last call."""
        return self._receivers[receiver].take_decided()

    def _route(self, name: str, source: str) -> _Route:
        network = topic(name).network
        return tuple(
            (
                receiver,
                self._latency["hardware" if source in self._beside[receiver] else network],
                self._receivers[receiver],
            )
            for receiver, wanted in self._subscriptions.items()
            if name in wanted and receiver != source
        )
