"""The recorder process: everything that is said, as it arrives, into a recording. It also holds what is
latched, for a router that comes back.

Zenoh's threads only put what arrives into an inbox; one thread takes it out and writes. So a disk that stands
still holds up nobody but this process, as long as the inbox has room.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from math import inf

import msgspec

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError, RecordingError, RunError
from maniple.core.messages import FaultPlan, Journal
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND, Duration, Time
from maniple.host.clock import Anchor
from maniple.host.fate import Fate, Meet, meet, say
from maniple.host.inbox import BACKLOG, Arrived, Asked, Inbox, Stop, Unfit
from maniple.host.joining import restore
from maniple.host.latched import LatchedStore, Lives
from maniple.host.liveness import ROUTER, Life
from maniple.host.recorder_control import Control
from maniple.host.recorder_drawing import Drawing
from maniple.host.recorder_orders import own_name, read_order, take_orders
from maniple.host.recorder_space import Space
from maniple.recording.other_scenarios import OTHERS_NAME, OtherScenarios
from maniple.recording.rolling import RollingWriter
from maniple.recording.split import PartsWriter
from maniple.recording.tally import Stream
from maniple.transport.zenoh import ZenohSession

RECORDER = "recorder"

CHUNK_PERIOD: Duration = 250 * MILLISECOND
"""How long a message waits in memory, wall time: with the way here and the writing less than 0.5 s."""

INBOX_BYTES = 256 << 20
"""What may wait while the disk stands still or the processor is busy."""

QUIET_S = 0.3
"""After a request to stop it goes on until nothing has arrived for this long,"""
PATIENCE_S = 1.5
"""but no longer than this."""

LATE_S = 3.0
"""After so long everybody has said something, so that it is known what a late recorder has missed."""

MOST_STRANGE = 256
"""Keys that are recorded beside those of the scenario's nodes: users' own, and garbage."""
_LONGEST_KEY = 256

_JOURNALS = topics.journal("")


class RecorderHost:
    """Subscribes to everything and writes it down until it is stopped. What is not written is counted.

    `takes` says which topics are recorded. `drawing` gets what was recorded, to draw it. `space` ends the
    recording before the disk is full. Of a `RollingWriter` the rest is written at the end only if
    `keep_on_exit`. It `goes_on` where an earlier recorder of the run has ended.
    """

    def __init__(
        self,
        writer: PartsWriter | RollingWriter,
        clock: Anchor,
        sessions: Sequence[ZenohSession],
        scenario: Scenario,
        meet: Meet = meet,
        *,
        takes: Callable[[str], bool] = lambda _: True,
        drawing: Drawing | None = None,
        space: Space | None = None,
        keep_on_exit: bool = False,
        goes_on: bool = False,
    ) -> None:
        self._writer = writer
        self._clock = clock
        self._sessions = sessions
        self._inbox = Inbox(INBOX_BYTES)
        self._known = keys_of(scenario)
        self._strange: set[str] = set()
        self._taken: dict[str, bool] = {}
        self._takes = takes
        self._drawing = drawing
        self._space = space
        self._keep_on_exit = keep_on_exit
        self._goes_on = goes_on
        self._name = own_name()
        self._control = Control(self._name, writer, clock.now, space)
        self._store = LatchedStore()
        self._flowing: dict[str, Envelope] = {}
        self._lives = Lives()
        self._others = OtherScenarios(to_json(scenario))
        self._router_went = False
        self._late_at = inf
        self._fate = Fate(RECORDER, (RECORDER,), clock.now())
        self._meet = meet
        self.unwritten: Counter[str] = Counter()
        """What was kept out of the recording, by reason."""

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self, poll_s: float = 0.1) -> None:
        """Record until `stop`, and then what is still on its way.

        Raises:
            RunError: it ended before that, as there is no room to write any more.
        """
        for session in self._sessions:
            session.subscribe("**", self._inbox.arrived, self._inbox.unfit, self._has_known_senders)
        fleet = self._sessions[0]
        fleet.watch(self._inbox.life)
        take_orders(fleet, self._name, self._inbox.asked)
        fleet.serve(f"{BACKLOG}/{self._name}", lambda name: {name: str(self._inbox.waiting).encode()})
        for row in topics.TOPICS:
            if row.latched and "{id}" not in row.pattern:
                for topic, data in fleet.ask(row.pattern).items():
                    self._store.keep(topic, data)
        for session in self._sessions:
            session.settle()
        fleet.announce(RECORDER, 1)
        try:
            with contextlib.closing(self._writer):
                self._go(poll_s)
                if text := self._control.end(self._keep_on_exit):
                    say(text)
        except RecordingError as error:
            raise RunError(str(error)) from None
        finally:
            self._tell()

    def _go(self, poll_s: float) -> None:
        stop_by, quiet_since = inf, time.monotonic()
        self._late_at = quiet_since + LATE_S
        while True:
            for item in self._inbox.take(poll_s):
                if isinstance(item, Arrived):
                    self._take_in(item)
                    quiet_since = time.monotonic()
                elif isinstance(item, Unfit):
                    self.unwritten[item.reason] += 1
                elif isinstance(item, Life):
                    self._heard(item)
                elif isinstance(item, Asked):
                    self._obey(item)
                elif isinstance(item, Stop):
                    quiet_since = time.monotonic()
                    stop_by = min(stop_by, quiet_since + PATIENCE_S)
            self._writer.tick(time.monotonic_ns())
            self._meet_fate()
            now = time.monotonic()
            if now >= self._late_at:
                self._tell_late()
            self._control.look()
            self._require_space()
            if now >= stop_by or (stop_by < inf and now - quiet_since >= QUIET_S):
                return

    def _take_in(self, item: Arrived) -> None:
        """Record what arrived, and hold it if it is latched."""
        topic, data, arrival = item.topic, item.data, self._clock.at(item.monotonic_ns)
        if not self._admits(topic):
            self.unwritten["unknown key"] += 1
            return
        try:
            envelope = envelope_of(topic, data)
        except MessageError:
            self._record(item, arrival, arrival, 0)
            return
        self._record(item, arrival, envelope.stamp_ns, envelope.seq)
        if topic in self._known and (row := topics.topic(topic)).latched:
            if row.rate_hz:
                self._flowing[topic] = envelope
            else:
                self._store.keep(topic, data)
        if envelope.seq == 0 and topic.startswith(_JOURNALS):
            self._look_at_start(topic, data)

    def _look_at_start(self, topic: str, data: bytes) -> None:
        """Of the first journal of a life: say if that runs another scenario."""
        with contextlib.suppress(MessageError):
            journal = codec.decode(topic, data)
            if isinstance(journal, Journal) and (text := self._others.heard(journal)):
                say(text)
                self._writer.note(OTHERS_NAME, self._others.found)

    def _record(self, item: Arrived, arrival: Time, stamp: Time, seq: int) -> None:
        taken = self._taken.get(item.topic)
        if taken is None:
            taken = self._taken[item.topic] = self._takes(item.topic)
        if not taken:
            return
        if self._control.paused:
            self._control.left_out()
            return
        self._writer.write(item.topic, item.data, arrival, stamp, seq)
        if self._drawing is not None:
            self._drawing.draw(item.topic, item.data, arrival, time.monotonic_ns() - item.monotonic_ns)

    def _has_known_senders(self, topic: str) -> bool:
        return topic in self._known and topics.has_known_senders(topic)

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

    def _obey(self, asked: Asked) -> None:
        """Do what somebody asks, and answer."""
        order = read_order(asked.data)
        if order is None:
            answer = self._control.answer(False, "that is no order that this version knows")
        else:
            answer = self._control.obey(order)
        asked.reply(msgspec.json.encode(answer))

    def _require_space(self) -> None:
        """Say when room on the disk gets low.

        Raises:
            RecordingError: the recording has to end.
        """
        if self._space is None:
            return
        room, text = self._space.look(time.monotonic())
        if room == "none" and self._writer.writing:
            raise RecordingError(f"the recording has ended: {text}")
        if text:
            say(text)

    def _tell_late(self) -> None:
        """Say once what was said before the recorder came."""
        self._late_at = inf
        tally = self._writer.tally
        if tally is None or not (late := late_text(tally.streams())):
            return
        if self._goes_on:
            late += "; what of them is in earlier parts is not counted: maniple log info tells"
        say(late)

    def _tell(self) -> None:
        """Say what is not in the recording."""
        if self._late_at < inf:
            self._tell_late()
        if self.unwritten:
            counts = ", ".join(f"{count} {reason}" for reason, count in sorted(self.unwritten.items()))
            say(f"not recorded: {counts}")
        if self._drawing is not None and (text := self._drawing.summary()):
            say(text)

    def _meet_fate(self) -> None:
        plan = self._store.message(topics.PLAN)
        if isinstance(plan, FaultPlan) and (event := self._fate.due(plan, self._clock.now())):
            self._meet(event, self._clock)


def late_text(streams: Iterable[Stream]) -> str:
    """What a recorder that came late has missed, in words; empty where it came in time."""
    missed: Counter[str] = Counter()
    for stream in streams:
        missed[stream.source] += stream.missed_first
    by_source = ", ".join(f"{count} of {source}" for source, count in sorted(missed.items()) if count)
    return f"came late: the first {missed.total()} messages are missing ({by_source})" if by_source else ""


def keys_of(scenario: Scenario) -> frozenset[str]:
    """The names of all topics that the nodes of a scenario may speak on, as far as they are recorded."""
    robots = [robot.id for robot in scenario.robots]
    nodes = (*robots, "controller", "simulator")
    return frozenset(
        row.pattern.replace("{id}", node) for row in topics.TOPICS if row.recorded for node in nodes
    )
