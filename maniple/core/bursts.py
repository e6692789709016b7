"""Losses in bursts: the state of the Gilbert-Elliott chain at any message, without walking there.

A step of a two-state chain with chances e (good to bad) and l (bad to good) is this draw: with chance
r = 1 - |1 - e - l| the state is drawn anew, whatever it was; else it stays, or, where e + l > 1, it swaps. So
the state at a message is that of the last fresh draw, and the gaps between fresh draws are geometric. They
are laid out in blocks of about 1/r messages, each by hashes of its own number: what the state is depends on
the hashes alone and costs the same few of them wherever one asks.
"""

import math
from collections.abc import Callable, Iterator

from maniple.core.scenario.types import Burst

Draw = Callable[[int, int], tuple[float, float]]
"""Two independent numbers, uniform in [0, 1), for the k-th fresh draw of a block."""

_FAR = 2**62
_BLOCKS = 64
"""A block without a fresh draw has a chance of 1/e; as many one after the other do not happen."""


class BurstChain:
    """One Gilbert-Elliott chain over the messages 0, 1, 2, ...; stationary from the first."""

    def __init__(self, burst: Burst) -> None:
        self._fresh = 1.0 - abs(1.0 - burst.enter - burst.leave)
        self._swaps = burst.enter + burst.leave > 1.0
        share = burst.enter / (burst.enter + burst.leave)
        self._bad_at_first = share
        self._bad = (1.0 - burst.leave) / self._fresh if self._swaps and self._fresh else share
        self._block = math.ceil(min(1.0 / self._fresh, _FAR)) if self._fresh else _FAR
        self._log = math.log1p(-self._fresh) if self._fresh < 1.0 else -math.inf

    def is_bad(self, seq: int, draw: Draw) -> bool:
        """Whether the chain is in its bad state at message `seq` >= 0."""
        at, bad = self._last_fresh(seq, draw)
        return bad != (self._swaps and (seq - at) % 2 == 1)

    def _last_fresh(self, seq: int, draw: Draw) -> tuple[int, bool]:
        """The last fresh draw up to `seq`: where, and what it gave."""
        block = seq // self._block
        for number in range(block, max(block - _BLOCKS, -1), -1):
            if drawn := list(self._of_block(number, seq, draw)):
                return drawn[-1]
        return -1, draw(-1, 0)[1] < self._bad_at_first

    def _of_block(self, number: int, seq: int, draw: Draw) -> Iterator[tuple[int, bool]]:
        """The fresh draws of a block up to `seq`, by geometric gaps from its beginning on."""
        at = number * self._block - 1
        last = min(seq, at + self._block)
        for count in range(self._block):
            gap, state = draw(number, count)
            at += 1 + math.floor(min(math.log1p(-gap) / self._log, _FAR)) if self._log else _FAR
            if at > last:
                return
            yield at, state < self._bad
