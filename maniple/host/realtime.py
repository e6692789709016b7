"""Realtime: one node in a process of its own, over Zenoh, by the wall clock.

Zenoh's threads only put what arrives into the inbox; one thread drains it and calls the node.
"""

from collections.abc import Sequence
from heapq import heappop, heappush
from queue import Empty, SimpleQueue
from typing import NamedTuple

from maniple.core import topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError
from maniple.core.faults import plan_of
from maniple.core.node import Node
from maniple.core.scenario.types import Scenario
from maniple.core.time import Duration, Time
from maniple.host.clock import Anchor
from maniple.host.runner import FLUSH_PERIOD, NodeRunner
from maniple.host.virtual import timer_phase
from maniple.transport.faulty import FaultyReceiver
from maniple.transport.zenoh import ZenohSession

_DELIVERY, _TIMER, _FLUSH = 0, 1, 2


class _Bytes(NamedTuple):
    topic: str
    data: bytes
    latched: bool = False
    """Asked for, so that it may be older than what came by itself."""


class _Life(NamedTuple):
    node: str
    incarnation: int
    alive: bool


class _Stop(NamedTuple):
    pass


class RealtimeHost:
    """Runs one life of one node until `stop` is called."""

    def __init__(
        self,
        node: Node,
        incarnation: int,
        scenario: Scenario,
        clock: Anchor,
        fleet: ZenohSession,
        hardware: ZenohSession,
    ) -> None:
        self._node = node
        self._runner = NodeRunner(node, incarnation, scenario.rates)
        self._seed = scenario.seed
        self._clock = clock
        self._fleet = fleet
        self._hardware = hardware
        self._sessions = {"fleet": fleet, "hardware": hardware}
        plan = plan_of(scenario, clock.epoch_ns)
        self._faulty = FaultyReceiver(node.name, scenario, plan, clock.epoch_ns)
        self._inbox: SimpleQueue[_Bytes | _Life | _Stop] = SimpleQueue()
        self._agenda: list[tuple[Time, int, int, str, Envelope | None]] = []
        self._pushed = 0
        self._flush_period: Duration = round(FLUSH_PERIOD * clock.speed)

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.put(_Stop())

    def run(self) -> None:
        """Connect the node, run it, and stop it in order."""
        self._connect()
        now = self._clock.now()
        for timer, period in sorted(self._node.timers.items()):
            self._push(now + timer_phase(self._seed, self._node.name, timer, period), _TIMER, timer)
        self._push(now + self._flush_period, _FLUSH)
        self._send(self._runner.start(now))
        running = True
        while running:
            running = self._take(self._wait())
            self._act(self._clock.now())
        now = self._clock.now()
        self._send(self._runner.stop(self._faulty.take_decided(), now))

    def _connect(self) -> None:
        """Subscribe, fetch what is latched, and show that the node lives. What only the node itself says is
        of interest as the last word of its former life."""
        wanted = sorted(self._node.subscriptions)
        for name in wanted:
            session = self._session(name)
            if session is not None and topics.sender_of(name) != self._node.name:
                session.subscribe(name, lambda topic, data: self._inbox.put(_Bytes(topic, data)))
        self._fleet.watch(lambda node, life, alive: self._inbox.put(_Life(node, life, alive)))
        for name in wanted:
            if topics.topic(name).latched and (session := self._session(name)) is not None:
                for topic, data in session.ask(name).items():
                    self._inbox.put(_Bytes(topic, data, latched=True))
        for session in (self._fleet, self._hardware):
            session.settle()
        self._fleet.announce(self._node.name, self._runner.incarnation)

    def _session(self, name: str) -> ZenohSession | None:
        return self._sessions.get(topics.topic(name).network)

    def _wait(self) -> Sequence[_Bytes | _Life | _Stop]:
        """Everything in the inbox; where it is empty, what comes first before the next thing is due."""
        left = self._clock.wall_seconds(self._agenda[0][0] - self._clock.now())
        try:
            first = self._inbox.get(timeout=left) if left > 0 else self._inbox.get_nowait()
        except Empty:
            return ()
        more = self._inbox.qsize()
        return (first, *(self._inbox.get_nowait() for _ in range(more))) if more else (first,)

    def _take(self, items: Sequence[_Bytes | _Life | _Stop]) -> bool:
        """Deal with what arrived; whether to go on."""
        for item in items:
            now = self._clock.now()
            if isinstance(item, _Bytes):
                self._arrived(item, now)
            elif isinstance(item, _Life):
                if item.alive:
                    self._runner.announced(item.node, item.incarnation)
                if item.node != self._node.name:
                    self._send(self._runner.alive(item.node, item.incarnation, item.alive, now))
            else:
                return False
        return True

    def _arrived(self, item: _Bytes, now: Time) -> None:
        try:
            envelope = envelope_of(item.topic, item.data)
        except MessageError:
            self._send(self._runner.refuse(item.topic, "", "malformed", now))
            return
        if item.latched and not self._runner.is_news(envelope):
            return
        if item.latched:
            self._send(self._runner.receive(envelope, now, latched=True))
            return
        for delay, arrived in self._faulty.admit(envelope):
            if delay == 0:
                self._send(self._runner.receive(arrived, now))
            else:
                self._push(now + delay, _DELIVERY, envelope=arrived)

    def _act(self, now: Time) -> None:
        """Do everything that is due."""
        while self._agenda[0][0] <= now:
            due, kind, _, name, envelope = heappop(self._agenda)
            if kind == _DELIVERY:
                assert envelope is not None
                self._send(self._runner.receive(envelope, now))
            elif kind == _TIMER:
                self._push(self._next(due, self._node.timers[name], now), _TIMER, name)
                self._send(self._runner.timer(name, now))
            else:
                self._push(self._next(due, self._flush_period, now), _FLUSH)
                self._send(self._runner.flush(self._faulty.take_decided(), now))

    def _next(self, due: Time, period: Duration, now: Time) -> Time:
        """When a timer is due again: it keeps its phase and skips what it missed."""
        missed = (now - due) // period
        if missed:
            self._runner.count("skipped_timers", missed)
        return due + (missed + 1) * period

    def _push(self, due: Time, kind: int, name: str = "", envelope: Envelope | None = None) -> None:
        self._pushed += 1
        heappush(self._agenda, (due, kind, self._pushed, name, envelope))

    def _send(self, envelopes: Sequence[Envelope]) -> None:
        for envelope in envelopes:
            session = self._session(envelope.topic)
            assert session is not None, f"{envelope.topic} never leaves its host"
            session.put(envelope.topic, envelope.data)
