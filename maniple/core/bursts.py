"""Losses in bursts: the state of the Gilbert-Elliott chain at any message, without walking there.

A step of a two-state chain with chances e (good to bad) and l (bad to good) is this draw: with chance
r = 1 - |1 - e - l| the state is drawn anew, whatever it was; else it stays, or, where e + l > 1, it swaps. So
the state at a message is that of the last fresh draw, and the gaps between fresh draws are geometric. They
are laid out in blocks of about 1/r messages, each by hashes of its own number: what the state is depends on
the hashes alone and costs the same few of them wherever one asks.
"""

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias

from maniple.core.scenario.types import Burst

Draw: TypeAlias = Callable[[int, int, int], tuple[float, float]]
"""Two independent numbers, uniform in [0, 1), for the k-th fresh draw of a block of a life."""

_FAR = 2**62
_BLOCKS = 64
"""A block without a fresh draw has a chance of 1/e; as many one after the other do not happen."""
_REMEMBERED = 16


class BurstChain:
    """One Gilbert-Elliott chain over the messages 0, 1, 2, ... of every life; stationary from the first."""

    def __init__(self, burst: Burst, draw: Draw) -> None:
        self._draw = draw
        self._fresh = 1.0 - abs(1.0 - burst.enter - burst.leave)
        self._swaps = burst.enter + burst.leave > 1.0
        self._share = burst.enter / (burst.enter + burst.leave)
        self._bad = (1.0 - burst.leave) / self._fresh if self._swaps and self._fresh else self._share
        self._block = math.ceil(min(1.0 / self._fresh, _FAR)) if self._fresh else _FAR
        self._log = math.log1p(-self._fresh) if self._fresh < 1.0 else -math.inf
        self._known: dict[tuple[int, int], tuple[tuple[int, bool], ...]] = {}

    def is_bad(self, life: int, seq: int) -> bool:
        """Whether the chain of a life is in its bad state at message `seq` >= 0."""
        at, bad = self._last_fresh(life, seq)
        return bad != (self._swaps and (seq - at) % 2 == 1)

    def _last_fresh(self, life: int, seq: int) -> tuple[int, bool]:
        """The last fresh draw up to `seq`: where, and what it gave."""
        block = seq // self._block
        for number in range(block, max(block - _BLOCKS, -1), -1):
            for drawn in reversed(self._of_block(life, number)):
                if drawn[0] <= seq:
                    return drawn
        return -1, self._draw(life, -1, 0)[1] < self._share

    def _of_block(self, life: int, number: int) -> tuple[tuple[int, bool], ...]:
        """The fresh draws of a block; those of the last few are remembered."""
        drawn = self._known.get((life, number))
        if drawn is None:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            drawn = self._known[life, number] = tuple(self._drawn(life, number))
        return drawn

    def _drawn(self, life: int, number: int) -> Iterator[tuple[int, bool]]:
        """The fresh draws of a block, by geometric gaps from its beginning on."""
        at = number * self._block - 1
        last = at + self._block
        for count in range(self._block):
            gap, state = self._draw(life, number, count)
            at += 1 + (math.floor(min(math.log1p(-gap) / self._log, _FAR)) if self._log else _FAR)
            if at > last:
                return
            yield at, state < self._bad
