"""Clocks that are off: true scenario time and what a node is shown. In whole numbers, the same anywhere."""

from typing import NamedTuple

from maniple.core.scenario.types import Scenario
from maniple.core.time import Duration, Time, from_seconds

_ONE = 10**12
"""Skew is counted in parts of this."""


class NodeClock(NamedTuple):
    """A clock that is `offset` ahead at `epoch` (both ns, `epoch` in true scenario time) and goes faster by
    `skew` parts per million."""

    epoch: Time = 0
    offset: Duration = 0
    skew: float = 0.0

    def shown(self, true: Time) -> Time:
        """What the clock shows at a moment of true scenario time, to the ns below."""
        if not (self.offset or self.skew):
            return true
        return true + self.offset + (true - self.epoch) * self._rate() // _ONE

    def true(self, shown: Time) -> Time:
        """When the clock showed that, in true scenario time: the inverse of `shown`, to 1 ns."""
        if not (self.offset or self.skew):
            return shown
        elapsed = shown - self.offset - self.epoch
        return self.epoch - (-elapsed * _ONE // (_ONE + self._rate()))

    def _rate(self) -> int:
        return round(self.skew * 1e-6 * _ONE)


def node_clock(scenario: Scenario, node: str, epoch: Time) -> NodeClock:
    """The clock of a node; `epoch` is the start of the run in true scenario time."""
    for error in scenario.clocks:
        if error.node == node:
            return NodeClock(epoch, from_seconds(error.offset_s), error.skew_ppm)
    return NodeClock(epoch)
