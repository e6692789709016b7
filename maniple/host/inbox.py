"""What arrived and is not yet dealt with: filled by Zenoh's threads, emptied by one."""

import time
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import NamedTuple, TypeAlias

from maniple.core.time import Time
from maniple.host.liveness import Life

BUDGET = 64 << 20
"""Bytes: what is larger than this over the number of messages before it is not let in. So a flood takes only
so much memory, and a large message is not let in behind many."""
BACKLOG = "backlog"
"""Asked as "backlog/NODE": how many bytes wait there. Who plays a recording waits for those with many."""
_LEAST = 1024
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


class Stop(NamedTuple):
    """The end is asked for."""


Item: TypeAlias = Arrived | Unfit | Life | Stop


class Inbox:
    """A queue of them. All but `take` may be called from any thread, `stop` from a signal handler too."""

    def __init__(self) -> None:
        self._items: SimpleQueue[Item] = SimpleQueue()

    def arrived(self, topic: str, data: bytes) -> None:
        """Let bytes in, or only that there were some (reason "flood")."""
        fits = (self._items.qsize() + 1) * max(len(data), _LEAST) <= BUDGET
        self._items.put(Arrived(topic, data, time.monotonic_ns()) if fits else Unfit(topic, "flood"))

    def unfit(self, topic: str, reason: str) -> None:
        """Something was kept out."""
        self._items.put(Unfit(topic, reason))

    def life(self, node: str, incarnation: int, alive: bool) -> None:
        """A liveliness token appeared, or is gone."""
        self._items.put(Life(node, incarnation, alive))

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
        return (first, *(get() for _ in range(more))) if more else (first,)
