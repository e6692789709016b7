"""Virtual time: all nodes in one process, one event after the other, as fast as the machine can.

Events are ordered by (time, deliveries before timers, receiver, sender, topic, seq), so the same scenario
and seed give the same messages, byte for byte. All times here are true scenario time; each node is only told
what its own clock shows.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import heappop, heappush

from maniple.core import codec
from maniple.core.clocks import NodeClock, node_clock
from maniple.core.envelope import Envelope
from maniple.core.faults import NEVER, back_at, beside, dead, dies_by, dies_with, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.node import Node
from maniple.core.scenario.parse import digest_of, to_json
from maniple.core.scenario.types import Crash, Freeze, Scenario
from maniple.core.streams import stream
from maniple.core.time import VIRTUAL_EPOCH, Duration, Time, from_seconds
from maniple.core.topics import PLAN, topic
from maniple.host.latched import mark_of
from maniple.host.liveness import Liveness
from maniple.host.runner import FLUSH_PERIOD, NodeRunner
from maniple.transport.memory import MemoryNetwork

Tap = Callable[[Envelope, Time], None]
"""Sees every envelope as it is sent, with the time it arrives at the recorder."""

Factory = Callable[[int], Node]
"""Makes a node, given its incarnation."""

_DELIVERY, _TIMER, _FLUSH, _CRASH, _RESTART, _FREEZE, _LEASE, _THAW, _HANDOVER, _INPUT = range(10)


class _Seat:
    """One life of a node in this host: its runner, its clock, and what it is told of the others."""

    __slots__ = ("began", "clock", "froze", "frozen_until", "liveness", "runner")

    def __init__(
        self, node: Node, life: int, scenario: Scenario, digest: str, clock: NodeClock | None, now: Time
    ) -> None:
        self.runner = NodeRunner(node, life, scenario.rates, digest)
        self.clock = clock
        self.liveness = Liveness(
            node.name, from_seconds(scenario.network.lease_s), local=beside(node.name, scenario)
        )
        self.began = self.froze = now
        """Since when it lives, and when its last freeze was due."""
        self.frozen_until: Time = 0

    def shows(self, now: Time) -> Time:
        """What its clock shows."""
        return now if self.clock is None else self.clock.shown(now)

    def after(self, now: Time, period: Duration) -> Time:
        """When a period of its clock that begins now is over."""
        return now + period if self.clock is None else self.clock.true(self.clock.shown(now) + period)


class VirtualHost:
    """Runs nodes against an in-process network. Those that die by the fault plan live again by `factories`.

    `inputs` come from outside, each at its time: what operators say. A fault plan among them takes the place
    of the one in force, if it is newer.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        scenario: Scenario,
        tap: Tap,
        factories: Mapping[str, Factory] | None = None,
        inputs: Sequence[tuple[Time, Envelope]] = (),
    ) -> None:
        self.now: Time = VIRTUAL_EPOCH
        self._scenario = scenario
        self._digest = digest_of(to_json(scenario))
        self._plan = plan_of(scenario, VIRTUAL_EPOCH)
        self._plan_mark = (-1, -1)
        self._plans = 0
        self._fates: list[Crash | Freeze] = []
        self._first_fate = 0
        """Those before are of plans that no longer hold."""
        self._inputs = inputs
        self._lease = from_seconds(scenario.network.lease_s)
        self._factories = dict(factories or {})
        self._incarnations = {node.name: 1 for node in nodes}
        self._latched: dict[str, Envelope] = {}
        off = {error.node for error in scenario.clocks}
        self._clocks = {name: node_clock(scenario, name, VIRTUAL_EPOCH) for name in sorted(off)}
        self._seats = {node.name: self._seat(node, 1) for node in nodes}
        self._network = MemoryNetwork(scenario, {node.name: node.subscriptions for node in nodes})
        self._tap = tap
        self._tap_latency = from_seconds(scenario.network.fleet_latency_s)
        self._seed = scenario.seed
        self._events: list[tuple[Time, int, str, str, str, int, int, Envelope | None]] = []
        self._count = 0
        self._halt = False

    def start(self) -> None:
        """Start all nodes, in the order of their names, and tell each who lives."""
        names = sorted(self._seats)
        for name in names:
            for other in names:
                self._hear(name, other, 1, True)
        for name in names:
            self._start(name)
        for name in names:
            self._tell(name)
        for event in _fates(self._plan):
            self._await_fate(event, self.now + from_seconds(event.at_s))
        for due, envelope in self._inputs:
            self._push(due, _INPUT, "", envelope=envelope)

    def run(self, until: Time) -> None:
        """Go on until the time `until`, or until `halt` is called; at once if it was called before."""
        events = self._events
        while not self._halt and events and events[0][0] <= until:
            time, kind, receiver, source, name, number, _, envelope = heappop(events)
            self.now = time
            seat = self._seats.get(receiver)
            if kind == _RESTART:
                if number == self._plans:
                    self._restart(receiver)
            elif kind == _INPUT:
                assert envelope is not None
                self._input(envelope)
            elif seat is None:
                continue
            elif kind <= _FLUSH and time < seat.frozen_until:
                self._defer(seat, time, kind, receiver, source, name, number, envelope)
            elif kind == _DELIVERY:
                assert envelope is not None
                self._send(seat.runner.receive(envelope, seat.shows(time)))
            elif kind in (_CRASH, _FREEZE):
                if number >= self._first_fate:
                    self._meet(seat, self._fates[number])
            elif number != seat.runner.incarnation:
                continue  # of a former life
            elif kind == _TIMER:
                self._push(seat.after(time, seat.runner.node.timers[name]), _TIMER, receiver, name, number)
                self._send(seat.runner.timer(name, seat.shows(time)))
            elif kind == _FLUSH:
                self._push(time + FLUSH_PERIOD, _FLUSH, receiver, life=number)
                self._tell(receiver)
                self._send(seat.runner.flush(self._network.take_decided(receiver), seat.shows(time)))
            elif kind == _HANDOVER:
                assert envelope is not None
                if seat.runner.is_news(envelope):
                    self._send(seat.runner.receive(envelope, seat.shows(time), latched=True))
            elif kind == _LEASE:
                self._tell_life(receiver, False)
            elif kind == _THAW and time >= seat.frozen_until:
                self._tell_life(receiver, True)
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
            if (seat := self._seats.pop(name, None)) is not None:
                self._send(seat.runner.stop(self._network.take_decided(name), seat.shows(self.now)))
                self._tell_life(name, False)

    def _seat(self, node: Node, life: int) -> _Seat:
        return _Seat(node, life, self._scenario, self._digest, self._clocks.get(node.name), self.now)

    def _start(self, name: str) -> None:
        """Begin a life of a node."""
        seat = self._seats[name]
        life = seat.runner.incarnation
        for timer, period in sorted(seat.runner.node.timers.items()):
            phase = timer_phase(self._seed, name, timer, period)
            self._push(seat.after(self.now, phase), _TIMER, name, timer, life)
        self._push(self.now + FLUSH_PERIOD, _FLUSH, name, life=life)
        self._send(seat.runner.start(seat.shows(self.now)))

    def _input(self, envelope: Envelope) -> None:
        """Let somebody outside say something."""
        if envelope.topic == PLAN and mark_of(envelope) > self._plan_mark:
            plan = codec.decode(PLAN, envelope.data)
            assert isinstance(plan, FaultPlan)
            self._plan_mark = mark_of(envelope)
            self._replan(plan)
        self._send((envelope,))

    def _replan(self, plan: FaultPlan) -> None:
        """Act by this plan from now on. What it says late is done late: a crash that a node has lived to see,
        and what is left of a freeze."""
        self._plan = plan
        self._network.replan(plan)
        self._plans += 1
        self._first_fate = len(self._fates)
        for name in sorted(self._factories.keys() - self._seats.keys()):
            self._await_return(name)
        for event in _fates(plan):
            at, seat = plan.since_ns + from_seconds(event.at_s), self._seats.get(event.node)
            over = seat is None or at <= (seat.began if isinstance(event, Crash) else seat.froze)
            if at > self.now or not over:
                self._await_fate(event, max(at, self.now))

    def _await_fate(self, event: Crash | Freeze, due: Time) -> None:
        kind = _CRASH if isinstance(event, Crash) else _FREEZE
        self._push(due, kind, event.node, life=len(self._fates))
        self._fates.append(event)

    def _meet(self, seat: _Seat, event: Crash | Freeze) -> None:
        """Let a node crash or freeze."""
        if isinstance(event, Crash):
            self._crash(event)
        else:
            self._freeze(seat, event)

    def _await_return(self, name: str) -> None:
        """Let a node that is dead live again when the plan says so, if ever."""
        crash = dead(self._plan, dies_by(name, self._scenario), self.now)
        if (back := self.now if crash is None else back_at(self._plan, crash)) < NEVER:
            self._push(back, _RESTART, name, life=self._plans)

    def _crash(self, crash: Crash) -> None:
        """End the life of a node, and of those on the same computer, without a word."""
        for name in dies_with(crash.node, self._scenario):
            if self._seats.pop(name, None) is None:
                continue
            self._network.take_decided(name)
            self._tell_life(name, False)
            self._await_return(name)

    def _restart(self, name: str) -> None:
        """Begin the next life of a node that has died: it gets what is latched."""
        if name not in self._factories or name in self._seats:
            return
        self._network.take_decided(name)  # of what nobody was there to receive
        life = self._incarnations[name] = self._incarnations[name] + 1
        seat = self._seats[name] = self._seat(self._factories[name](life), life)
        for other in sorted(self._seats):
            self._hear(name, other, self._incarnations[other], True)
        self._start(name)
        self._tell_life(name, True)
        self._tell(name)
        for wanted in sorted(seat.runner.node.subscriptions & self._latched.keys()):
            envelope = self._latched[wanted]
            due = self._network.hand_over(envelope, name, self.now)
            self._push(due, _HANDOVER, name, life=life, envelope=envelope)

    def _freeze(self, seat: _Seat, freeze: Freeze) -> None:
        """Let a node stand still. What is sent to it waits; its timers skip; its lease runs out."""
        name, life = freeze.node, seat.runner.incarnation
        seat.froze = self._plan.since_ns + from_seconds(freeze.at_s)
        if (until := seat.froze + from_seconds(freeze.for_s)) <= self.now:
            return
        if self.now + self._lease < until:
            self._push(self.now + self._lease, _LEASE, name, life=life)
        seat.frozen_until = max(seat.frozen_until, until)
        self._push(until, _THAW, name, life=life)

    def _defer(
        self,
        seat: _Seat,
        due: Time,
        kind: int,
        receiver: str,
        source: str,
        name: str,
        number: int,
        envelope: Envelope | None,
    ) -> None:
        """Put off what a frozen node can't do now: a timer to its next turn after the thaw."""
        thaw = seat.frozen_until
        if kind == _TIMER:
            period = seat.after(due, seat.runner.node.timers[name]) - due
            missed = -((due - thaw) // period)
            if number == seat.runner.incarnation:
                seat.runner.count("skipped_timers", missed)
            thaw = due + missed * period
        self._count += 1
        heappush(self._events, (thaw, kind, receiver, source, name, number, self._count, envelope))

    def _tell_life(self, name: str, lives: bool) -> None:
        """Show to the others that a node lives, or does not."""
        for other in sorted(self._seats.keys() - {name}):
            self._hear(other, name, self._incarnations[name], lives)
            if self.now >= self._seats[other].frozen_until:
                self._tell(other)

    def _hear(self, name: str, other: str, life: int, lives: bool) -> None:
        """Let a node's host know of a life of another."""
        seat = self._seats[name]
        if lives:
            seat.runner.announced(other, life)
        if other != name:
            seat.liveness.heard(other, life, lives, self.now)

    def _tell(self, name: str) -> None:
        """Tell a node what it can know of who lives."""
        seat = self._seats[name]
        for node, life, alive in seat.liveness.visible(self._plan, self.now):
            self._send(seat.runner.alive(node, life, alive, seat.shows(self.now)))

    def _send(self, envelopes: Iterable[Envelope]) -> None:
        now = self.now
        for envelope in envelopes:
            self._tap(envelope, now + self._tap_latency)
            if (self._plan.crashes or self._inputs) and topic(envelope.topic).latched:
                self._latched[envelope.topic] = envelope
            for due, receiver, delivered in self._network.send(envelope, now):
                self._count += 1
                event = (
                    due,
                    _DELIVERY,
                    receiver,
                    delivered.source,
                    delivered.topic,
                    delivered.seq,
                    self._count,
                    delivered,
                )
                heappush(self._events, event)

    def _push(
        self,
        due: Time,
        kind: int,
        receiver: str,
        name: str = "",
        life: int = 0,
        envelope: Envelope | None = None,
    ) -> None:
        self._count += 1
        heappush(self._events, (due, kind, receiver, "", name, life, self._count, envelope))


def _fates(plan: FaultPlan) -> tuple[Crash | Freeze, ...]:
    return (*plan.crashes, *plan.freezes)


def timer_phase(seed: int, node: str, timer: str, period: Duration) -> Duration:
    """When a timer is first due after the start: evenly spread over its period, from a named stream."""
    return int(stream(seed, f"timer/{node}/{timer}").integers(period))
