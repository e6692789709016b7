"""What arrived and is not yet dealt with: filled by Zenoh's threads, emptied by one."""

import threading
import time
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import NamedTuple, TypeAlias

from maniple.core.time import Time
from maniple.host.liveness import Life

BUDGET = 64 << 20
"""Bytes that may wait together, so that a flood takes only so much memory."""
BACKLOG = "backlog"
"""Asked as "backlog/NODE": how many bytes wait there. Who plays a recording waits for those with many."""
_SHARE = 8
"""A message takes at most this part of the room that is left: behind many large ones a small one gets in."""
_LEAST = 1024
"""What a message takes at least."""
_BATCH = 256
"""The most that is taken out at a time, so that a flood does not hold up timers."""


class Arrived(NamedTuple):
    """Bytes on a topic."""

    topic: str
    data: bytes
    monotonic_ns: Time
    """When they arrived."""


class Unfit(NamedTuple):
    """Something that arrived on a topic and must not be looked at."""

    topic: str
    reason: str


class Asked(NamedTuple):
    """Somebody asks something of this host, and waits for a reply."""

    data: bytes
    reply: Callable[[bytes], None]


class Stop(NamedTuple):
    """The end is asked for."""


Item: TypeAlias = Arrived | Unfit | Life | Asked | Stop


class Inbox:
    """A queue of them. All but `take` may be called from any thread, `stop` from a signal handler too."""

    def __init__(self, budget: int = BUDGET) -> None:
        self._items: SimpleQueue[Item] = SimpleQueue()
        self._budget = self._room = budget
        self._lock = threading.Lock()

    @property
    def waiting(self) -> int:
        """Bytes that wait."""
        with self._lock:
            return self._budget - self._room

    def arrived(self, topic: str, data: bytes) -> None:
        """Let bytes in, or only that there were some (reason "flood")."""
        size = max(len(data), _LEAST)
        with self._lock:
            if fits := _SHARE * size <= self._room:
                self._room -= size
        self._items.put(Arrived(topic, data, time.monotonic_ns()) if fits else Unfit(topic, "flood"))

    def unfit(self, topic: str, reason: str) -> None:
        """Something was kept out."""
        self._items.put(Unfit(topic, reason))

    def life(self, node: str, incarnation: int, alive: bool) -> None:
        """A liveliness token appeared, or is gone."""
        self._items.put(Life(node, incarnation, alive))

    def asked(self, data: bytes, reply: Callable[[bytes], None]) -> None:
        """Somebody asks something."""
        self._items.put(Asked(data, reply))

    def stop(self) -> None:
        """Ask for the end."""
        self._items.put(Stop())

    def take(self, timeout_s: float) -> Sequence[Item]:
        """What is there; where nothing is, what comes first within the time."""
        get: Callable[[], Item] = self._items.get_nowait
        try:
            first = self._items.get(timeout=timeout_s) if timeout_s > 0 else get()
        except Empty:
            return ()
        more = min(self._items.qsize(), _BATCH - 1)
        items = (first, *(get() for _ in range(more))) if more else (first,)
        freed = sum(max(len(item.data), _LEAST) for item in items if isinstance(item, Arrived))
        with self._lock:
            self._room += freed
        return items
