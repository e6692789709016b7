"""Virtual time: all nodes in one process, one event after the other, as fast as the machine can.

Events are ordered by (time, deliveries before timers, receiver, sender, topic, seq), so the same scenario
and seed give the same messages, byte for byte.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import heappop, heappush

from maniple.core.envelope import Envelope
from maniple.core.faults import dies_with
from maniple.core.node import Node
from maniple.core.scenario.types import Crash, Scenario
from maniple.core.streams import stream
from maniple.core.time import VIRTUAL_EPOCH, Duration, Time, from_seconds
from maniple.core.topics import topic
from maniple.host.runner import FLUSH_PERIOD, NodeRunner
from maniple.transport.memory import MemoryNetwork

Tap = Callable[[Envelope, Time], None]
"""Sees every envelope as it is sent, with the time it arrives at the recorder."""

Factory = Callable[[int], Node]
"""Makes a node, given its incarnation."""

_DELIVERY, _TIMER, _FLUSH, _CRASH, _RESTART = 0, 1, 2, 3, 4


class VirtualHost:
    """Runs nodes against an in-process network. Those that die by the scenario live again by `factories`."""

    def __init__(
        self,
        nodes: Sequence[Node],
        scenario: Scenario,
        tap: Tap,
        factories: Mapping[str, Factory] | None = None,
    ) -> None:
        self.now: Time = VIRTUAL_EPOCH
        self._scenario = scenario
        self._factories = dict(factories or {})
        self._incarnations = {node.name: 1 for node in nodes}
        self._latched: dict[str, Envelope] = {}
        self._runners = {node.name: NodeRunner(node, 1, scenario.rates) for node in nodes}
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
            for other in sorted(self._runners):
                self._runners[name].announced(other, 1)
        for name in sorted(self._runners):
            self._start(name)
        for name in sorted(self._runners):
            for other in sorted(self._runners.keys() - {name}):
                self._send(self._runners[name].alive(other, 1, True, self.now))
        for index, crash in enumerate(self._scenario.crashes):
            self._push(self.now + from_seconds(crash.at_s), _CRASH, crash.node, life=index)

    def run(self, until: Time) -> None:
        """Go on until the time `until`, or until `halt` is called; at once if it was called before."""
        events = self._events
        while not self._halt and events and events[0][0] <= until:
            time, kind, receiver, _, name, number, _, envelope = heappop(events)
            self.now = time
            runner = self._runners.get(receiver)
            if kind == _RESTART:
                self._restart(receiver)
            elif runner is None:
                continue
            elif kind == _DELIVERY:
                assert envelope is not None
                self._send(runner.receive(envelope, time))
            elif kind == _CRASH:
                self._crash(self._scenario.crashes[number])
            elif number != runner.incarnation:
                continue  # a timer of a former life
            elif kind == _TIMER:
                self._push(time + runner.node.timers[name], _TIMER, receiver, name, number)
                self._send(runner.timer(name, time))
            else:
                self._push(time + FLUSH_PERIOD, _FLUSH, receiver, life=number)
                self._send(runner.flush(self._network.take_decided(receiver), time))
        if not self._halt:
            self.now = max(self.now, until)
        self._halt = False

    def halt(self) -> None:
        """Make `run` return after the event it is at."""
        self._halt = True

    def stop(self, names: Iterable[str]) -> None:
        """Stop some nodes, in this order, for good."""
        for name in names:
            self._factories.pop(name, None)
            if (runner := self._runners.pop(name, None)) is not None:
                self._send(runner.stop(self._network.take_decided(name), self.now))
                self._tell_life(name, False)

    def _start(self, name: str) -> None:
        """Begin a life of a node."""
        runner = self._runners[name]
        life = runner.incarnation
        for timer, period in sorted(runner.node.timers.items()):
            phase = timer_phase(self._seed, name, timer, period)
            self._push(self.now + phase, _TIMER, name, timer, life)
        self._push(self.now + FLUSH_PERIOD, _FLUSH, name, life=life)
        self._send(runner.start(self.now))

    def _crash(self, crash: Crash) -> None:
        """End the life of a node, and of those on the same computer, without a word."""
        for name in dies_with(crash.node, self._scenario):
            if self._runners.pop(name, None) is None:
                continue
            self._network.take_decided(name)
            self._tell_life(name, False)
            if crash.restart_after_s is not None and name in self._factories:
                self._push(self.now + from_seconds(crash.restart_after_s), _RESTART, name)

    def _restart(self, name: str) -> None:
        """Begin the next life of a node that has died: it gets what is latched."""
        if name not in self._factories:
            return
        self._network.take_decided(name)  # of what nobody was there to receive
        life = self._incarnations[name] = self._incarnations[name] + 1
        runner = self._runners[name] = NodeRunner(self._factories[name](life), life, self._scenario.rates)
        self._start(name)
        self._tell_life(name, True)
        for other in sorted(self._runners.keys() - {name}):
            self._send(runner.alive(other, self._incarnations[other], True, self.now))
        for wanted in sorted(runner.node.subscriptions & self._latched.keys()):
            self._deliver(self._latched[wanted], self.now + self._tap_latency, name)

    def _tell_life(self, name: str, lives: bool) -> None:
        for other in sorted(self._runners.keys() - {name}):
            self._send(self._runners[other].alive(name, self._incarnations[name], lives, self.now))

    def _send(self, envelopes: Iterable[Envelope]) -> None:
        now = self.now
        for envelope in envelopes:
            self._tap(envelope, now + self._tap_latency)
            if self._scenario.crashes and topic(envelope.topic).latched:
                self._latched[envelope.topic] = envelope
            for due, receiver, arrived in self._network.send(envelope, now):
                self._deliver(arrived, due, receiver)

    def _deliver(self, envelope: Envelope, due: Time, receiver: str) -> None:
        self._count += 1
        event = (
            due,
            _DELIVERY,
            receiver,
            envelope.source,
            envelope.topic,
            envelope.seq,
            self._count,
            envelope,
        )
        heappush(self._events, event)

    def _push(self, due: Time, kind: int, receiver: str, name: str = "", life: int = 0) -> None:
        self._count += 1
        heappush(self._events, (due, kind, receiver, "", name, life, self._count, None))


def timer_phase(seed: int, node: str, timer: str, period: Duration) -> Duration:
    """When a timer is first due after the start: evenly spread over its period, from a named stream."""
    return int(stream(seed, f"timer/{node}/{timer}").integers(period))
