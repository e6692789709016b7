"""The network of virtual time: who receives what and when, faults included. Carries real wire bytes."""

from collections.abc import Mapping
from typing import TypeAlias

from maniple.core.envelope import Envelope
from maniple.core.faults import beside
from maniple.core.messages import Decided
from maniple.core.scenario.types import Scenario
from maniple.core.time import Duration, Time, from_seconds
from maniple.core.topics import topic
from maniple.transport.faulty import FaultyReceiver

Delivery: TypeAlias = tuple[Time, str]
"""One copy of a message: when it arrives, and at which node."""

_Route: TypeAlias = tuple[tuple[str, Duration, FaultyReceiver], ...]


class MemoryNetwork:
    """Routes envelopes by topic name; links take at least the least latency of their network, and within one
    computer that of the hardware."""

    def __init__(self, scenario: Scenario, subscriptions: Mapping[str, frozenset[str]]) -> None:
        self._latency: dict[str, Duration] = {
            "fleet": from_seconds(scenario.network.fleet_latency_s),
            "hardware": from_seconds(scenario.network.hardware_latency_s),
        }
        self._faulty = bool(scenario.faults)
        self._routes: dict[tuple[str, str], _Route] = {}
        self._subscriptions = {name: subscriptions[name] for name in sorted(subscriptions)}
        self._beside = {name: beside(name, scenario) for name in self._subscriptions}
        self._receivers = {
            name: FaultyReceiver(name, scenario.faults, scenario.seed, self._beside[name])
            for name in self._subscriptions
        }

    def send(self, envelope: Envelope, now: Time) -> list[Delivery]:
        """Where a message sent now arrives, and when."""
        route = self._routes.get((envelope.topic, envelope.source))
        if route is None:
            route = self._route(envelope.topic, envelope.source)
            self._routes[envelope.topic, envelope.source] = route
        if not self._faulty:
            return [(now + latency, name) for name, latency, _ in route]
        deliveries = []
        for name, latency, receiver in route:
            delay = receiver.admit(envelope)
            if delay is not None:
                deliveries.append((now + latency + delay, name))
        return deliveries

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
