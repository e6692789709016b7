"""The recorder process: everything that is said, as it arrives, into a recording. It also holds what is
latched, for a router that comes back."""

import time
from collections import Counter
from collections.abc import Sequence
from math import inf

from maniple.core import topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.host.clock import Anchor
from maniple.host.fate import Fate, Meet, meet, say
from maniple.host.inbox import Arrived, Inbox, Stop, Unfit
from maniple.host.joining import restore
from maniple.host.latched import LatchedStore, Lives
from maniple.host.liveness import ROUTER, Life
from maniple.recording.writer import RecordingWriter
from maniple.transport.zenoh import ZenohSession

RECORDER = "recorder"

QUIET_S = 0.3
"""After a request to stop it goes on until nothing has arrived for this long,"""
PATIENCE_S = 1.5
"""but no longer than this."""

MOST_STRANGE = 256
"""Keys that are recorded beside those of the scenario's nodes: users' own, and garbage."""
_LONGEST_KEY = 256


class RecorderHost:
    """Subscribes to everything and writes it down until it is stopped. What is not written is counted."""

    def __init__(
        self,
        writer: RecordingWriter,
        clock: Anchor,
        sessions: Sequence[ZenohSession],
        scenario: Scenario,
        meet: Meet = meet,
    ) -> None:
        self._writer = writer
        self._clock = clock
        self._sessions = sessions
        self._inbox = Inbox()
        self._known = keys_of(scenario)
        self._strange: set[str] = set()
        self._store = LatchedStore()
        self._flowing: dict[str, Envelope] = {}
        self._lives = Lives()
        self._router_went = False
        self._fate = Fate(RECORDER, (RECORDER,), clock.now())
        self._meet = meet
        self.unwritten: Counter[str] = Counter()
        """What was kept out of the recording, by reason."""

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self, poll_s: float = 0.1) -> None:
        """Record until `stop`, and then what is still on its way."""
        for session in self._sessions:
            session.subscribe("**", self._inbox.arrived, self._inbox.unfit, self._has_one_sender)
        fleet = self._sessions[0]
        fleet.watch(self._inbox.life)
        for row in topics.TOPICS:
            if row.latched and "{id}" not in row.pattern:
                for topic, data in fleet.ask(row.pattern).items():
                    self._store.keep(topic, data)
        for session in self._sessions:
            session.settle()
        fleet.announce(RECORDER, 1)
        self._go(poll_s)
        if self.unwritten:
            counts = ", ".join(f"{count} {reason}" for reason, count in sorted(self.unwritten.items()))
            say(f"not recorded: {counts}")

    def _go(self, poll_s: float) -> None:
        stop_by, quiet_since = inf, time.monotonic()
        while True:
            for item in self._inbox.take(poll_s):
                if isinstance(item, Arrived):
                    self._write(item.topic, item.data, self._clock.at(item.monotonic_ns))
                    quiet_since = time.monotonic()
                elif isinstance(item, Unfit):
                    self.unwritten[item.reason] += 1
                elif isinstance(item, Life):
                    self._heard(item)
                elif isinstance(item, Stop):
                    quiet_since = time.monotonic()
                    stop_by = min(stop_by, quiet_since + PATIENCE_S)
            self._writer.tick(time.monotonic_ns())
            self._meet_fate()
            now = time.monotonic()
            if now >= stop_by or (stop_by < inf and now - quiet_since >= QUIET_S):
                return

    def _write(self, topic: str, data: bytes, arrival: Time) -> None:
        if not self._admits(topic):
            self.unwritten["unknown key"] += 1
            return
        try:
            envelope = envelope_of(topic, data)
        except MessageError:
            self._writer.write(topic, data, arrival, arrival, 0)
            return
        self._writer.write(topic, data, arrival, envelope.stamp_ns, envelope.seq)
        if topic in self._known and (row := topics.topic(topic)).latched:
            if row.rate_hz:
                self._flowing[topic] = envelope
            else:
                self._store.keep(topic, data)

    def _has_one_sender(self, topic: str) -> bool:
        return topic in self._known and topics.has_one_sender(topic)

    def _admits(self, topic: str) -> bool:
        """Whether a key is recorded: each takes room for good, and anybody may make up any number."""
        if topic in self._known or topic in self._strange:
            return True
        if len(self._strange) >= MOST_STRANGE or len(topic) > _LONGEST_KEY:
            return False
        self._strange.add(topic)
        return True

    def _heard(self, life: Life) -> None:
        """A liveliness token appeared, or is gone."""
        if life.node != ROUTER:
            self._lives.seen(life.node, life.incarnation)
            return
        if life.alive and self._router_went:
            for envelope in self._flowing.values():
                self._store.keep(envelope.topic, envelope.data)
            restore(self._sessions[0], self._clock, self._store.all(), self._lives)
        self._router_went = not life.alive

    def _meet_fate(self) -> None:
        plan = self._store.message(topics.PLAN)
        if isinstance(plan, FaultPlan) and (event := self._fate.due(plan, self._clock.now())):
            self._meet(event, self._clock)


def keys_of(scenario: Scenario) -> frozenset[str]:
    """The names of all topics that the nodes of a scenario may speak on, as far as they are recorded."""
    robots = [robot.id for robot in scenario.robots]
    nodes = (*robots, "controller", "simulator")
    return frozenset(
        row.pattern.replace("{id}", node) for row in topics.TOPICS if row.recorded for node in nodes
    )
