"""Virtual time: all nodes in one process, one event after the other, as fast as the machine can.

Events are ordered by (time, deliveries before timers, receiver, sender, topic, seq), so the same scenario
and seed give the same messages, byte for byte.
"""

from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush

from maniple.core.envelope import Envelope
from maniple.core.node import Node
from maniple.core.scenario.types import Scenario
from maniple.core.streams import stream
from maniple.core.time import VIRTUAL_EPOCH, Duration, Time, from_seconds
from maniple.host.runner import FLUSH_PERIOD, NodeRunner
from maniple.transport.memory import MemoryNetwork

Tap = Callable[[Envelope, Time], None]
"""Sees every envelope as it is sent, with the time it arrives at the recorder."""

_DELIVERY, _TIMER, _FLUSH = 0, 1, 2


class VirtualHost:
    """Runs nodes against an in-process network."""

    def __init__(self, nodes: Sequence[Node], scenario: Scenario, tap: Tap) -> None:
        self.now: Time = VIRTUAL_EPOCH
        self._runners = {node.name: NodeRunner(node, incarnation=1) for node in nodes}
        self._network = MemoryNetwork(scenario, {node.name: node.subscriptions for node in nodes})
        self._tap = tap
        self._tap_latency = from_seconds(scenario.network.fleet_latency_s)
        self._seed = scenario.seed
        self._events: list[tuple[Time, int, str, str, str, int, int, Envelope | None]] = []
        self._count = 0
        self._halt = False

    def start(self) -> None:
        """Start all nodes, in the order of their names, and tell each who lives."""
        for name in sorted(self._runners):
            runner = self._runners[name]
            for timer, period in sorted(runner.node.timers.items()):
                self._push(self.now + timer_phase(self._seed, name, timer, period), _TIMER, name, timer)
            self._push(self.now + FLUSH_PERIOD, _FLUSH, name)
            self._send(runner.start(self.now))
        for name in sorted(self._runners):
            for other in sorted(self._runners.keys() - {name}):
                self._send(self._runners[name].alive(other, 1, True, self.now))

    def run(self, until: Time) -> None:
        """Go on until the time `until`, or until `halt` is called; at once if it was called before."""
        events = self._events
        while not self._halt and events and events[0][0] <= until:
            time, kind, receiver, _, name, _, _, envelope = heappop(events)
            self.now = time
            runner = self._runners.get(receiver)
            if runner is None:
                continue
            if kind == _DELIVERY:
                assert envelope is not None
                self._send(runner.receive(envelope, time))
            elif kind == _TIMER:
                self._push(time + runner.node.timers[name], _TIMER, receiver, name)
                self._send(runner.timer(name, time))
            else:
                self._push(time + FLUSH_PERIOD, _FLUSH, receiver)
                self._send(runner.flush(self._network.take_decided(receiver), time))
        if not self._halt:
            self.now = max(self.now, until)
        self._halt = False

    def halt(self) -> None:
        """Make `run` return after the event it is at."""
        self._halt = True

    def stop(self, names: Iterable[str]) -> None:
        """Stop some nodes, in this order."""
        for name in names:
            runner = self._runners.pop(name)
            self._send(runner.stop(self._network.take_decided(name), self.now))
            for other in sorted(self._runners):
                self._send(self._runners[other].alive(name, runner.incarnation, False, self.now))

    def _send(self, envelopes: Iterable[Envelope]) -> None:
        now = self.now
        for envelope in envelopes:
            self._tap(envelope, now + self._tap_latency)
            for due, receiver in self._network.send(envelope, now):
                self._count += 1
                heappush(
                    self._events,
                    (
                        due,
                        _DELIVERY,
                        receiver,
                        envelope.source,
                        envelope.topic,
                        envelope.seq,
                        self._count,
                        envelope,
                    ),
                )

    def _push(self, due: Time, kind: int, receiver: str, name: str = "") -> None:
        self._count += 1
        heappush(self._events, (due, kind, receiver, "", name, 0, self._count, None))


def timer_phase(seed: int, node: str, timer: str, period: Duration) -> Duration:
    """When a timer is first due after the start: evenly spread over its period, from a named stream."""
    return int(stream(seed, f"timer/{node}/{timer}").integers(period))
