"""By what one recorder's clock is ahead of another's, from what both heard.

Clocks of two machines are never compared as they are. Log times of one message differ by their offset, and by
how much longer it took to one of the two. The median of that is taken; and a straight line through medians
of stretches, where there are enough of them to tell that one clock is faster.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from maniple.core.geometry import Floats
from maniple.core.time import SECOND, Duration, Time

STRETCH: Duration = 10 * SECOND
"""Of which a median is taken to see whether one clock is faster."""

LEAST_STRETCHES = 6
"""Fewer tell nothing about that."""

_MOST_STRETCHES = 400


class Offset(msgspec.Struct, frozen=True):
    """By what the log times of one recorder are ahead of another's."""

    at_ns: Time
    """Where `ahead_ns` holds, by the clock that is set right."""
    ahead_ns: Duration
    drift_ppm: float
    """By how much faster that clock goes."""
    spread_ns: Duration
    """Nine of ten messages that both heard are nearer to this than so much."""
    common: int
    """Messages that both heard."""

    def right(self, time: Time) -> Time:
        """A time of that clock by the other."""
        since = time - self.ahead_ns - self.at_ns
        drift = self.drift_ppm * 1e-6
        return time - self.ahead_ns - round(drift / (1.0 + drift) * since)


def offset_of(theirs: Sequence[Time], ours: Sequence[Time]) -> Offset:
    """By what a clock is ahead of ours, from the times of the same events by both; at least one."""
    start = ours[0]
    times: Floats = np.array([time - start for time in ours], dtype=float)
    base = theirs[0] - ours[0]
    ahead: Floats = np.array([t - o - base for t, o in zip(theirs, ours, strict=True)], dtype=float)
    middle = float(np.median(times))
    slope = _slope(times, ahead)
    at_middle = ahead - slope * (times - middle)
    level = float(np.median(at_middle))
    return Offset(
        at_ns=start + round(middle),
        ahead_ns=base + round(level),
        drift_ppm=round(slope * 1e6, 3),
        spread_ns=round(float(np.quantile(np.abs(at_middle - level), 0.9))),
        common=len(theirs),
    )


def _slope(times: Floats, ahead: Floats) -> float:
    """Of a line through the medians of stretches with many messages: the median of the slopes between any two
    (Theil and Sen); 0 where there are too few."""
    stretch, counts = np.unique(np.floor(times / STRETCH), return_inverse=True, return_counts=True)[1:]
    full = np.flatnonzero(counts >= counts.max() / 2)[:_MOST_STRETCHES]
    points = np.array([(np.median(times[stretch == n]), np.median(ahead[stretch == n])) for n in full])
    if len(points) < LEAST_STRETCHES:
        return 0.0
    i, j = np.triu_indices(len(points), 1)
    return float(np.median((points[j, 1] - points[i, 1]) / (points[j, 0] - points[i, 0])))
