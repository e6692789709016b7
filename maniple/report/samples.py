"""Numbers over time, as they come from messages in any order."""

from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maniple.core.geometry import Floats
from maniple.core.time import SECOND, Time

Stamps = NDArray[np.int64]


class Samples:
    """Rows of `columns` numbers, each with its time; 8 bytes a number."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._stamps = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: Time, values: tuple[float, ...]) -> None:
        """Note a row."""
        self._stamps.append(stamp_ns)
        self._values.extend(values)

    def arrays(self) -> tuple[Stamps, Floats]:
        """Times (k,) in ns, rising, and rows (k, columns)."""
        stamps = np.array(self._stamps, dtype=np.int64)
        values = np.array(self._values).reshape(-1, self._columns)
        order = np.argsort(stamps, kind="stable")
        return stamps[order], values[order]


class Track(NamedTuple):
    """Numbers over time."""

    t: Floats
    """(k,), s, rising."""
    values: Floats
    """(k, columns)."""


class Band(NamedTuple):
    """What many tracks have in common: in each span of time the extremes, quartiles and median."""

    t: Floats
    """(b,), s: the middles of the spans."""
    levels: Floats
    """(5, b): least, lower quartile, median, upper quartile, largest."""


def seconds(stamps: Stamps, begin: Time) -> Floats:
    """Times in s since `begin`."""
    return np.asarray((stamps - begin) / SECOND)


def with_gaps(track: Track, longest_s: float) -> Track:
    """The same with a row of NaN in every gap that is longer than `longest_s`: a line is broken there."""
    after = np.flatnonzero(np.diff(track.t) > longest_s) + 1
    if not len(after):
        return track
    t = np.insert(track.t, after, 0.5 * (track.t[after - 1] + track.t[after]))
    return Track(t, np.insert(track.values, after, np.nan, axis=0))


def band(tracks: list[tuple[Floats, Floats]], spans: int = 240) -> Band:
    """The band of several (t, value) pairs of arrays, in at most `spans` equal spans of time."""
    t = np.concatenate([one for one, _ in tracks]) if tracks else np.empty(0)
    values = np.concatenate([one for _, one in tracks]) if tracks else np.empty(0)
    known = np.isfinite(values)
    t, values = t[known], values[known]
    if not len(t):
        return Band(np.empty(0), np.empty((5, 0)))
    fewest = max(1, min(spans, max(len(one) for one, _ in tracks) // 2))
    edges = np.linspace(t.min(), t.max(), fewest + 1)
    place = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, fewest - 1)
    order = np.argsort(place, kind="stable")
    filled, first = np.unique(place[order], return_index=True)
    parts = np.split(values[order], first[1:])
    levels = np.array([np.percentile(part, (0, 25, 50, 75, 100)) for part in parts]).T
    return Band(0.5 * (edges[filled] + edges[filled + 1]), levels)
