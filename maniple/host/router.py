"""The router: relays everything, keeps the last value of every latched topic, numbers lives, and tells who
joins a run what time it is there."""

import threading
import time

from maniple.core import topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError, TransportError
from maniple.host.clock import Anchor
from maniple.transport.zenoh import ZenohSession

_POLL_S = 0.2
_CLOCK = "clock"

PATIENCE_S = 5.0
"""How long a stopped router goes on for those who still have something to say, wall time."""


class LatchedStore:
    """The newest message of every latched topic. Pure: it is told what arrives."""

    def __init__(self) -> None:
        self._newest: dict[str, Envelope] = {}

    def keep(self, topic: str, data: bytes) -> None:
        """Remember a message unless a newer one of the same topic is known; garbage is ignored."""
        try:
            envelope = envelope_of(topic, data)
        except MessageError:
            return
        sender = topics.sender_of(topic)
        if sender and envelope.source != sender:
            return
        known = self._newest.get(topic)
        if known is None or (known.incarnation, known.seq) < (envelope.incarnation, envelope.seq):
            self._newest[topic] = envelope

    def answer(self, topic: str) -> dict[str, bytes]:
        """What is known of a topic: its bytes by its name, or nothing."""
        known = self._newest.get(topic)
        return {} if known is None else {topic: known.data}


class Lives:
    """The highest incarnation of every node that was ever seen."""

    def __init__(self) -> None:
        self._highest: dict[str, int] = {}

    def seen(self, node: str, incarnation: int) -> None:
        """A life of a node is there, or was."""
        self._highest[node] = max(incarnation, self._highest.get(node, 0))

    def answer(self, name: str) -> dict[str, bytes]:
        """The number of the next life of a node, asked for as "incarnation/NODE"."""
        node = name.removeprefix("incarnation/")
        return {name: str(self._highest.get(node, 0) + 1).encode()}


def serve(session: ZenohSession, clock: Anchor | None = None) -> None:
    """Make a router session keep and serve latched values and incarnations, and the clock of a run."""
    store = LatchedStore()
    lives = Lives()
    for row in topics.TOPICS:
        if row.latched:
            expression = row.pattern.replace("{id}", "*")
            session.subscribe(expression, store.keep)
            session.serve(expression, store.answer)
    session.watch(lambda node, incarnation, _: lives.seen(node, incarnation))
    session.serve("incarnation/*", lives.answer)
    if clock is not None:
        session.serve(_CLOCK, lambda name: {name: f"{clock.now()}:{clock.speed!r}".encode()})
    session.announce("router", 1)


def next_incarnation(session: ZenohSession, node: str, patience_s: float = 3.0) -> int:
    """Which life of a node starts now, as the router counts them; 1 where nobody counts.

    One that was cut off is given `patience_s` to be missed: its lease ends within that.

    Raises:
        TransportError: the node lives; two of one name would take turns.
    """
    until = time.monotonic() + patience_s
    while lives := session.lives(node):
        if time.monotonic() >= until:
            raise TransportError(f"{node} is running already (incarnation {lives[-1]}): stop that one first")
        time.sleep(_POLL_S)
    answers = session.ask(f"incarnation/{node}")
    return int(next(iter(answers.values()), b"1"))


def clock_of(session: ZenohSession) -> Anchor:
    """The clock of the run that a router belongs to, as exact as its answer is fast; without one, the wall
    clock."""
    asked = time.monotonic_ns()
    answers = session.ask(_CLOCK)
    if not answers:
        return Anchor.here()
    now, speed = answers[_CLOCK].decode().split(":")
    return Anchor.parse(f"{now}:{(asked + time.monotonic_ns()) // 2}:{speed}")


class RouterHost:
    """Runs a router until it is stopped and everybody else has left, or has had the time to."""

    def __init__(self, session: ZenohSession, clock: Anchor | None = None) -> None:
        self._session = session
        self._clock = clock
        self._alive: set[tuple[str, int]] = set()
        self._changed = threading.Event()
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._stopping.set()

    def run(self, patience_s: float = PATIENCE_S) -> None:
        """Serve until `stop`, then until all others are gone, `patience_s` at most."""
        serve(self._session, self._clock)
        self._session.watch(self._life)
        while not self._stopping.wait(1.0):
            pass
        until = time.monotonic() + patience_s
        while self._alive and (left := until - time.monotonic()) > 0:
            self._changed.wait(left)
            self._changed.clear()

    def _life(self, node: str, incarnation: int, alive: bool) -> None:
        if node == "router":
            return
        (self._alive.add if alive else self._alive.discard)((node, incarnation))
        self._changed.set()
