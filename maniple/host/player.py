"""Plays a recording onto the network, as if its nodes lived. See docs/play.md."""

import re
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import chain
from typing import NamedTuple

import msgspec

from maniple.core import topics
from maniple.core.errors import ArgumentError, RecordingError, RunError
from maniple.core.time import SECOND, Time, to_seconds
from maniple.host.clock import Anchor
from maniple.host.inbox import BACKLOG
from maniple.host.joining import CLOCK, PLAYED
from maniple.host.liveness import ROUTER, Life
from maniple.host.playing.cues import cues, is_latched, is_order, latched
from maniple.host.playing.timeline import Timeline
from maniple.host.recorder import RECORDER
from maniple.recording.reader import Recorded, Recording
from maniple.recording.selection import Selection, matches
from maniple.transport.zenoh import ZenohSession

PATIENCE_S = 600.0
"""So long may who listens not read before its session ends; one that is dead is noticed by its lease."""

LISTENERS = frozenset({ROUTER, RECORDER})
"""Who may be there where a recording is played: they act on nothing."""

MOST_BACKLOG = 16 << 20
"""Where more bytes wait to be dealt with, a play waits too."""
LOOK_EVERY = 4 << 20
"""Bytes put between two looks at that."""
_LEAST = 1024
"""What a message counts at least, as an inbox counts."""

_POLL_S = 0.05
_LONGEST_WAIT_S = 3600.0
_MOST_STEPS = 1_000_000
_KEY = re.compile(r"[^/*$#?@][^/*$#?]*(/[^/*$#?@][^/*$#?]*)*")


class Playing(msgspec.Struct, frozen=True, kw_only=True):
    """How far a play is, and how it goes; what a control is answered."""

    position_s: float
    """Since the recording's first message."""
    end_s: float
    """Where it ends, likewise."""
    paused: bool
    loops: int
    """How often it has come to the end."""
    messages: int
    """Put so far, of all loops; latched values that were handed over at the start among them."""
    bytes: int
    rate: float | None
    """Time of the recording over wall time, as asked for; None: as fast as possible."""
    reached_rate: float
    """The same as it came about, without the pauses."""
    lag_max_s: float
    """How late the latest message was, wall time."""
    slowed_s: float
    """By how much all was slowed because it could not keep up, wall time."""
    recorded_s: float
    """Time of the recording that was played, of all loops."""
    wall_s: float
    """Without the pauses."""
    live: tuple[str, ...]
    """The nodes that it shows as living now."""


class How(NamedTuple):
    """How a recording is to be played."""

    rate: float | None = 1.0
    """Time of the recording over wall time; None: as fast as possible."""
    times: int | None = 1
    """None: again and again."""
    paused: bool = False
    linger_s: float = 0.0
    """How long it is there after its end, for those who are still behind, wall time."""
    onto_live_nodes: bool = False


class Player:
    """Plays what a selection takes of a recording over a session, in a thread of its own.

    Where no router serves the prefix of the session, it serves what one would: latched values and the time,
    which is that of the recording.

    Raises:
        RecordingError: nothing in the recording is selected, or it is damaged, or a topic of it is no key.
        ArgumentError: nodes live there.
    """

    def __init__(
        self,
        recording: Recording,
        selection: Selection,
        session: ZenohSession,
        is_router: bool,
        how: How,
    ) -> None:
        self._recording = recording
        self._selection = selection
        self._session = session
        self._is_router = is_router
        self._how = how
        self._encodings = _encodings(recording)
        present = session.everyone()
        self._others = frozenset(present.keys() - LISTENERS)
        if self._others and not how.onto_live_nodes:
            raise ArgumentError(
                f"{_listed(self._others)} live there: they would take what is played for real. Play it under "
                "another --prefix, on a router of its own (without --connect), or --onto-live-nodes"
            )
        self._first, self._from, self._until = self._span()
        self._timeline = Timeline(how.rate, how.paused)
        self._changed = threading.Condition()
        self._stopping = False
        self._failure: Exception | None = None
        self._kept: dict[str, bytes] = {}
        self._live: set[tuple[str, int]] = set()
        self._shown: set[tuple[str, int]] = set()
        self._messages = self._bytes = self._loops = self._unlooked = 0
        self._recorded_ns = 0
        self._begun_ns = self._ended_ns = 0
        self._serves = ROUTER not in present
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The topics that are not played, as nodes live there."""
        return tuple(name for name in self._recording.topics if self._is_selected(name) and self._held(name))

    def start(self) -> None:
        """Begin to play."""
        if self._serves:
            for row in topics.TOPICS:
                if row.latched:
                    self._session.serve(row.pattern.replace("{id}", "*"), self._answer)
            self._session.serve(CLOCK, lambda name: {name: self._clock().told(time.monotonic_ns()).encode()})
            self._session.serve("claim/**", lambda name: {name: PLAYED})
            self._session.announce(ROUTER, 1)
        if not self._how.onto_live_nodes:
            self._session.watch(self._appeared)
        self._session.serve("play/**", self._ordered)
        self._begun_ns = time.monotonic_ns()
        self._thread.start()

    def stop(self) -> None:
        """Make it end."""
        with self._changed:
            self._stopping = True
            self._changed.notify()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end; whether it has ended.

        Raises:
            RunError: a node came to life where it is played, or the router went away.
            RecordingError: the recording is damaged.
        """
        self._thread.join(timeout_s)
        if not (self._is_router or self._session.connected or self._failure):
            self._failure = RunError("the router went away: what was put since then is lost")
            self.stop()
        if self._failure is not None:
            raise self._failure
        return not self._thread.is_alive()

    def pause(self) -> None:
        """Stand still."""
        with self._changed:
            self._timeline.pause(time.monotonic_ns())

    def resume(self) -> None:
        """Go on."""
        with self._changed:
            self._timeline.resume(time.monotonic_ns())
            self._changed.notify()

    def toggle(self) -> None:
        """Pause, or go on."""
        (self.resume if self._timeline.paused else self.pause)()

    def step(self, count: int = 1) -> None:
        """Put so many messages and stand still."""
        with self._changed:
            self._timeline.step(count, time.monotonic_ns())
            self._changed.notify()

    def state(self) -> Playing:
        """How far it is, and how it goes."""
        now = self._ended_ns or time.monotonic_ns()
        with self._changed:
            timeline = self._timeline
            at = min(max(timeline.position(now), self._from), self._until)
            running = now - self._begun_ns - timeline.stood_until(now) if self._begun_ns else 0
        recorded = self._recorded_ns + (0 if self._ended_ns else at - self._from)
        return Playing(
            position_s=to_seconds(at - self._first),
            end_s=to_seconds(self._until - self._first),
            paused=timeline.paused,
            loops=self._loops,
            messages=self._messages,
            bytes=self._bytes,
            rate=self._how.rate,
            reached_rate=recorded / running if running > 0 else 0.0,
            lag_max_s=to_seconds(timeline.latest),
            slowed_s=to_seconds(timeline.slowed),
            recorded_s=to_seconds(recorded),
            wall_s=to_seconds(running),
            live=tuple(sorted({node for node, _ in self._live.copy()})),
        )

    def _run(self) -> None:
        try:
            while not self._stopping and self._how.times != self._loops:
                self._play_once()
            self._ended_ns = time.monotonic_ns()
            if not self._stopping:
                self._linger()
        except Exception as error:  # noqa: BLE001 - it is raised by `wait`
            self._failure = self._failure or error
        finally:
            self._ended_ns = self._ended_ns or time.monotonic_ns()
            for life in list(self._live):
                self._show(Life(*life, False))

    def _play_once(self) -> None:
        """From the start to the end, once."""
        with self._changed:
            self._timeline.begin(self._from, time.monotonic_ns())
        before = self._before()
        self._kept = {message.topic: message.data for message in before}
        reached = self._from
        for cue in cues(self._recording.messages(self._takes, self._from, self._selection.end_ns)):
            if isinstance(cue, Life):
                self._show(cue)
                continue
            if not self._await(cue):
                break
            for message in (*before, cue):
                self._put(message)
            before = ()
            reached = cue.log_time_ns
            with self._changed:
                self._timeline.put(reached, time.monotonic_ns())
        else:
            self._loops += 1
        self._recorded_ns += reached - self._from

    def _await(self, message: Recorded) -> bool:
        """Wait until a message is due; False: it is to end."""
        if self._unlooked >= LOOK_EVERY:
            self._unlooked = 0
            self._await_listeners()
        with self._changed:
            while not self._stopping:
                left = self._timeline.wait(message.log_time_ns, time.monotonic_ns())
                if left == 0:
                    return True
                self._changed.wait(None if left is None else min(left / SECOND, _LONGEST_WAIT_S))
        return False

    def _await_listeners(self) -> None:
        """Wait until nobody has too much of what was put still before it."""
        while not self._stopping and any(map(_is_much, self._session.ask(f"{BACKLOG}/*").values())):
            time.sleep(_POLL_S)

    def _linger(self) -> None:
        """Be there until the last message has reached those who tell how far behind they are, and for a
        while for the others: what is on its way to somebody is lost when this session ends."""
        self._session.ask(f"{BACKLOG}/*", PATIENCE_S)
        with self._changed:
            self._changed.wait_for(lambda: self._stopping, self._how.linger_s)

    def _put(self, message: Recorded) -> None:
        name, data = message.topic, message.data
        if is_latched(name):
            self._kept[name] = data
        self._session.put_in_order(name, data, self._encodings.get(name))
        self._messages += 1
        self._bytes += len(data)
        self._unlooked += max(len(data), _LEAST)

    def _show(self, life: Life) -> None:
        """A life of the recording appears, or goes."""
        node, incarnation, alive = life
        if node in self._others:
            return
        if alive:
            self._live.add((node, incarnation))
            self._shown.add((node, incarnation))
            self._session.announce(node, incarnation)
        else:
            self._live.remove((node, incarnation))
            self._session.withdraw(node, incarnation)

    def _span(self) -> tuple[Time, Time, Time]:
        """The time of the first message of all, and from when to when is played."""
        chosen, recording = self._selection, self._recording
        found = recording.messages(self._takes, chosen.start_ns, chosen.end_ns)
        first = next(found, None)
        if first is None:
            where = f" that may be played where {_listed(self._others)} live" if self._others else ""
            raise RecordingError(f"{recording.path}: no message of the topics and the time asked for{where}")
        for name in recording.topics:
            if self._takes(name) and not _KEY.fullmatch(name):
                raise RecordingError(
                    f"{recording.path}: topic {name!r} can't be a key; --without leaves it out"
                )
        start = first.log_time_ns if chosen.start_ns is None else chosen.start_ns
        end = recording.end_ns if chosen.end_ns is None else min(recording.end_ns, chosen.end_ns)
        return recording.start_ns, start, end

    def _takes(self, name: str) -> bool:
        return self._is_selected(name) and not self._held(name)

    def _is_selected(self, name: str) -> bool:
        return self._selection.takes(name)

    def _held(self, name: str) -> bool:
        """Whether a topic is kept from nodes that live there, as nobody asked for it by name: an order, or
        what one of them alone may say."""
        if not self._others or any(matches(pattern, name) for pattern in self._selection.topics):
            return False
        if is_order(name) or not topics.has_known_senders(name):
            return is_order(name)
        return not self._others.isdisjoint(topics.senders_of(name))

    def _before(self) -> tuple[Recorded, ...]:
        """The latched values at the start: of a recording that begins in the middle, those from before it."""
        held = (one for one in self._recording.latched if self._hands_over(one.topic))
        attached = (Recorded(one.topic, one.data, one.log_time_ns, one.publish_time_ns, 0) for one in held)
        start = self._selection.start_ns
        earlier = () if start is None else self._recording.messages(self._hands_over, None, start)
        return latched(chain(attached, earlier))

    def _hands_over(self, name: str) -> bool:
        return is_latched(name) and self._takes(name)

    def _clock(self) -> Anchor:
        with self._changed:
            return self._timeline.clock(time.monotonic_ns())

    def _answer(self, name: str) -> Mapping[str, bytes]:
        data = self._kept.get(name)
        return {} if data is None else {name: data}

    def _ordered(self, name: str) -> Mapping[str, bytes]:
        """An order from outside: play/status, play/pause, play/resume, play/step, play/step/COUNT."""
        _, *order = name.split("/")
        acts: dict[str, Callable[[], None]] = {
            "status": lambda: None,
            "pause": self.pause,
            "resume": self.resume,
            "step": self.step,
        }
        if len(order) == 2 and order[0] == "step" and order[1].isascii() and order[1].isdecimal():
            acts = {"step": partial(self.step, min(int(order[1][:9]), _MOST_STEPS))}
        elif len(order) != 1:
            return {}
        act = acts.get(order[0])
        if act is None:
            return {}
        act()
        return {name: msgspec.json.encode(self.state())}

    def _appeared(self, node: str, incarnation: int, alive: bool) -> None:
        """Somebody is there: what is played must not reach who acts on it."""
        if not alive or node in LISTENERS or (node, incarnation) in self._shown:
            return
        self._failure = RunError(f"{node} (incarnation {incarnation}) came to life where it is played: ended")
        self.stop()


def _is_much(backlog: bytes) -> bool:
    return backlog.isdigit() and int(backlog[:18]) > MOST_BACKLOG


def _encodings(recording: Recording) -> dict[str, str]:
    """The encoding of each topic, as it was on the wire."""
    return {
        name: encoding
        for layout in recording.layouts
        for channel in layout.channels.values()
        if (name := recording.topic_of(channel.topic)) and (encoding := channel.metadata.get("encoding"))
    }


def _listed(nodes: frozenset[str], most: int = 6) -> str:
    names = sorted(nodes)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
