"""Realtime: one node in a process of its own, over Zenoh, by the wall clock.

Zenoh's threads only put what arrives into the inbox; one thread drains it and calls the node. The host acts
in true scenario time; the node is shown its own clock, which may be off.
"""

import time
import traceback
from collections.abc import Sequence
from heapq import heappop, heappush

from maniple.core import codec, topics
from maniple.core.clocks import node_clock
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError, RunError
from maniple.core.faults import NEVER, beside, dies_by, next_change, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.node import Node
from maniple.core.scenario.parse import digest_of, to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND, Duration, Time, from_seconds
from maniple.host.clock import Anchor
from maniple.host.fate import Fate, Meet, meet
from maniple.host.inbox import Arrived, Inbox, Item, Stop, Unfit
from maniple.host.joining import restore
from maniple.host.latched import Lives, mark_of
from maniple.host.liveness import ROUTER, Life, Liveness
from maniple.host.runner import FLUSH_PERIOD, NodeRunner
from maniple.host.virtual import timer_phase
from maniple.transport.faulty import FaultyReceiver
from maniple.transport.zenoh import ZenohSession

SETTLE_S, GRACE_S = 0.3, 3.0
"""A life is believed to be over after so long; when the router has been away, after the other; wall time."""

_DELIVERY, _HANDOVER, _TIMER, _FLUSH, _FATE = range(5)


class RealtimeHost:
    """Runs one life of one node until `stop` is called, or a newer life of it takes over."""

    def __init__(
        self,
        node: Node,
        incarnation: int,
        scenario: Scenario,
        clock: Anchor,
        fleet: ZenohSession,
        hardware: ZenohSession,
        meet: Meet = meet,
    ) -> None:
        self._node = node
        self._runner = NodeRunner(node, incarnation, scenario.rates, digest_of(to_json(scenario)))
        self._seed = scenario.seed
        self._clock = clock
        self._own_clock = node_clock(scenario, node.name, clock.epoch_ns)
        self._fleet = fleet
        self._hardware = hardware
        self._sessions = {"fleet": fleet, "hardware": hardware}
        self._plan = plan_of(scenario, NEVER)
        self._plan_mark = (-1, -1)
        self._faulty = FaultyReceiver(node.name, scenario, self._plan, clock.epoch_ns)
        self._fate = Fate(node.name, dies_by(node.name, scenario), clock.now())
        self._meet = meet
        self._liveness = Liveness(
            node.name,
            from_seconds(scenario.network.lease_s),
            from_seconds(SETTLE_S * clock.speed),
            from_seconds(GRACE_S * clock.speed),
            beside(node.name, scenario),
        )
        self._lives = Lives()
        self._held: dict[str, Envelope] = {}
        self._router_went = False
        self._newer = 0
        self._inbox = Inbox()
        self._agenda: list[tuple[Time, int, int, str, Envelope | None]] = []
        self._pushed = 0
        self._fate_number = 0
        self._flush_period: Duration = round(FLUSH_PERIOD * clock.speed)

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self) -> None:
        """Connect the node, run it, and stop it in order.

        Raises:
            RunError: the node failed, or a newer life of it has taken over; it was stopped all the same.
        """
        name, life = self._node.name, self._runner.incarnation
        latched = self._connect()
        try:
            self._go(latched)
        except Exception as error:  # noqa: BLE001 - whatever a node does, its robot must not drive on
            traceback.print_exc()
            self._end_broken()
            raise RunError(f"{name} (incarnation {life}) failed: {type(error).__name__}: {error}") from None
        self._end()
        if self._newer:
            raise RunError(
                f"{name} (incarnation {life}) steps back: incarnation {self._newer} has taken over"
            )

    def _connect(self) -> Sequence[Arrived]:
        """Subscribe, fetch what is latched, and show that the node lives; returns what is latched. What only
        the node itself says is of interest as the last word of its former life."""
        wanted = sorted({*self._node.subscriptions, topics.PLAN})
        self._fleet.watch(self._inbox.life)  # first: who spoke already is known when the first word arrives
        for name in wanted:
            session = self._session(name)
            if session is not None and topics.sender_of(name) != self._node.name:
                session.subscribe(name, self._inbox.arrived, self._inbox.unfit, topics.has_known_senders)
        latched = [
            Arrived(topic, data, time.monotonic_ns())
            for name in wanted
            if topics.topic(name).latched and (session := self._session(name)) is not None
            for topic, data in session.ask(name).items()
        ]
        for session in (self._fleet, self._hardware):
            session.settle()
        self._fleet.announce(self._node.name, self._runner.incarnation)
        return latched

    def _session(self, name: str) -> ZenohSession | None:
        return self._sessions.get(topics.topic(name).network)

    def _go(self, latched: Sequence[Arrived]) -> None:
        """Run the node until the end is asked for, or a newer life is seen."""
        now = self._clock.now()
        shown = self._own_clock.shown(now)
        for timer, period in sorted(self._node.timers.items()):
            phase = timer_phase(self._seed, self._node.name, timer, period)
            self._push(self._own_clock.true(shown + phase), _TIMER, timer)
        self._push(now + self._flush_period, _FLUSH)
        self._send(self._runner.start(shown))
        for item in latched:
            self._arrived(item, now, latched=True)
        self._act(self._clock.now())
        while self._take(self._inbox.take(self._wait_s())):
            self._act(self._clock.now())

    def _end(self) -> None:
        shown = self._own_clock.shown(self._clock.now())
        self._send(self._runner.stop(self._faulty.take_decided(), shown))

    def _end_broken(self) -> None:
        """Let a node that has failed say its last, as far as it can."""
        try:
            self._end()
        except Exception:  # noqa: BLE001 - it has failed already
            traceback.print_exc()

    def _wait_s(self) -> float:
        """Wall time until the next thing is due."""
        return self._clock.wall_seconds(self._agenda[0][0] - self._clock.now())

    def _take(self, items: Sequence[Item]) -> bool:
        """Deal with what arrived; whether to go on."""
        for item in items:
            now = self._clock.now()
            if isinstance(item, Arrived):
                self._arrived(item, now)
            elif isinstance(item, Unfit):
                self._refuse(item.topic, "", item.reason, now)
            elif isinstance(item, Life):
                self._heard(item, now)
            elif isinstance(item, Stop):
                return False
            if self._newer:
                return False
        return True

    def _arrived(self, item: Arrived, now: Time, latched: bool = False) -> None:
        try:
            envelope = envelope_of(item.topic, item.data)
        except MessageError:
            self._refuse(item.topic, "", "malformed", now)
            return
        if (held := self._held.get(item.topic)) is not None and held.data == item.data:
            return  # said again, for a router that came back
        if item.topic == topics.PLAN:
            self._replan(envelope, now)
        if item.topic not in self._node.subscriptions:
            return
        if latched:
            self._push(now + self._faulty.delay(envelope), _HANDOVER, envelope=envelope)
            return
        for delay, copy in self._faulty.admit(envelope):
            if delay == 0:
                self._receive(copy, now)
            else:
                self._push(now + delay, _DELIVERY, envelope=copy)

    def _receive(self, envelope: Envelope, now: Time, latched: bool = False) -> None:
        """Give the node a message, and hold it for a router that comes back, if it is taken in."""
        is_news = self._runner.is_news(envelope)
        self._send(self._runner.receive(envelope, self._own_clock.shown(now), latched))
        if is_news and topics.topic(envelope.topic).latched and not self._runner.is_news(envelope):
            self._held[envelope.topic] = envelope

    def _refuse(self, topic: str, sender: str, reason: str, now: Time) -> None:
        self._send(self._runner.refuse(topic, sender, reason, self._own_clock.shown(now)))

    def _replan(self, envelope: Envelope, now: Time) -> None:
        """Act by a newer fault plan from now on."""
        if mark_of(envelope) <= self._plan_mark:
            self._refuse(envelope.topic, envelope.source, "old", now)
            return
        try:
            plan = codec.decode(envelope.topic, envelope.data)
        except MessageError:
            self._refuse(envelope.topic, envelope.source, "malformed", now)
            return
        assert isinstance(plan, FaultPlan)
        self._plan, self._plan_mark = plan, mark_of(envelope)
        self._held[envelope.topic] = envelope
        self._faulty.replan(plan)
        self._push_fate(now)

    def _heard(self, life: Life, now: Time) -> None:
        """A liveliness token appeared, or is gone."""
        node, incarnation, alive = life
        if node == ROUTER:
            if alive and self._router_went:
                restore(self._fleet, self._clock, self._held.values(), self._lives)
            self._router_went = not alive
        else:
            self._lives.seen(node, incarnation)
        if alive:
            self._runner.announced(node, incarnation)
        if node != self._node.name:
            self._liveness.heard(node, incarnation, alive, now)
            self._tell_lives(now)
        elif alive and incarnation > self._runner.incarnation:
            self._newer = incarnation

    def _tell_lives(self, now: Time) -> None:
        """Tell the node what it can know of who lives."""
        for life in self._liveness.visible(self._plan, now):
            self._send(self._runner.alive(*life, self._own_clock.shown(now)))

    def _act(self, now: Time) -> None:
        """Do everything that is due."""
        while self._agenda[0][0] <= now:
            due, kind, number, name, envelope = heappop(self._agenda)
            if kind == _DELIVERY:
                assert envelope is not None
                self._receive(envelope, now)
            elif kind == _HANDOVER:
                assert envelope is not None
                if self._runner.is_news(envelope):
                    self._receive(envelope, now, latched=True)
            elif kind == _TIMER:
                shown = self._own_clock.shown(now)
                next_due = self._next(self._own_clock.shown(due), self._node.timers[name], shown)
                self._push(self._own_clock.true(next_due), _TIMER, name)
                self._send(self._runner.timer(name, shown))
            elif kind == _FATE:
                now = self._meet_fate(now) if number == self._fate_number else now
            else:
                self._push(self._next(due, self._flush_period, now), _FLUSH)
                self._tell_lives(now)
                shown = self._own_clock.shown(now)
                self._send(self._runner.flush(self._faulty.take_decided(), shown))

    def _meet_fate(self, now: Time) -> Time:
        """Do what the plan has in store for this process, and look again at its next change. Returns the time
        then."""
        if event := self._fate.due(self._plan, now):
            self._meet(event, self._clock)
            now = self._clock.now()
            self._push_fate(now + MILLISECOND)
        elif (change := next_change(self._plan, now)) is not None:
            self._push_fate(change)
        self._tell_lives(now)
        return now

    def _next(self, due: Time, period: Duration, now: Time) -> Time:
        """When a timer is due again: it keeps its phase and skips what it missed."""
        missed = max((now - due) // period, 0)
        if missed:
            self._runner.count("skipped_timers", missed)
        return due + (missed + 1) * period

    def _push(self, due: Time, kind: int, name: str = "", envelope: Envelope | None = None) -> None:
        self._pushed += 1
        heappush(self._agenda, (due, kind, self._pushed, name, envelope))

    def _push_fate(self, due: Time) -> None:
        """Look at the plan then, and not at what was pushed so before."""
        self._push(due, _FATE)
        self._fate_number = self._pushed

    def _send(self, envelopes: Sequence[Envelope]) -> None:
        for envelope in envelopes:
            session = self._session(envelope.topic)
            assert session is not None, f"{envelope.topic} never leaves its host"
            session.put(envelope.topic, envelope.data)
            if topics.topic(envelope.topic).latched:
                self._held[envelope.topic] = envelope
