"""Who takes which place, how the places are chained, and how the formation is built: section 5.

Positions and places are control points, (n, 2) in m in one frame; places come in the order of the triangle
chain. An assignment is `order`: `order[k]` is the index of the robot that takes place k. Headings play no
part: a control point can move in any direction at once.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from central_controller.formation import Gains
from maniple.control.parts import Planner
from maniple.core.errors import MissingExtraError
from maniple.core.geometry import Floats
from maniple.core.scenario import outline

Indices = NDArray[np.intp]

NEAR_M = 0.05
"""A triangle with p, q or median below this is too near to a singular one to be used in a chain."""

EXACT = 7
"""Up to so many places every order is tried."""


def given(positions: Floats, places: Floats) -> Sequence[int]:
    """The user's own order: robot k takes place k."""
    del places
    return range(len(positions))


def final_reorganization(positions: Floats, places: Floats) -> Sequence[int]:
    """Section 5, "formation rearrangement through final reorganization".

    "The most distant robot of the desired static formation" is R1: the one whose nearest place is farthest
    away, as distance from a set of points is measured. "The next robot to be labeled will be the one closest
    to the last labeled one, and so on": closest where the robots are now. Label k takes place k. Of equals
    the first of the user's list is taken.
    """
    labels = [int(_distances(positions, places).min(axis=1).argmax())]
    between = _distances(positions, positions)
    free = [robot for robot in range(len(positions)) if robot != labels[0]]
    while free:
        labels.append(min(free, key=between[labels[-1]].__getitem__))
        free.remove(labels[-1])
    return labels


def proximity(positions: Floats, places: Floats) -> Sequence[int]:
    """Section 5, the second algorithm, "a second step of the rearranging algorithm previously described".

    "Associating the R1 robot of the optimized initial formation to the robot in the initial formation labeled
    by the user that is closest to it": R1 of `final_reorganization` takes the nearest of the user's places.
    "The other robots are labeled using a criterion of proximity": the places after that one in the chain, up
    to its end, and then those before it, back to its beginning, each take the nearest robot that is left.
    "Respecting the established sequence": where a place completes a triangle, robots that stand in the same
    sequence as its places, ABC or ACB, come before the others, which are taken only if there is no such one.
    """
    first = final_reorganization(positions, places)[0]
    reach = _distances(positions, places)
    seat = int(reach[first].argmin())
    n = len(positions)
    order = [-1] * n
    order[seat] = first
    free = [robot for robot in range(n) if robot != first]
    for place in (*range(seat + 1, n), *range(seat - 1, -1, -1)):
        order[place] = min(free, key=reach[:, place].__getitem__)
        for start in (place - 2, place):
            corners = range(start, start + 3)
            if corners[0] < 0 or corners[-1] >= n or any(order[k] < 0 for k in corners):
                continue
            sequence = _sequence(*places[corners])
            fitting = [
                robot
                for robot in free
                if _sequence(*positions[[robot if k == place else order[k] for k in corners]]) == sequence
            ]
            order[place] = min(fitting or free, key=reach[:, place].__getitem__)
        free.remove(order[place])
    return order


def optimal(positions: Floats, places: Floats) -> Sequence[int]:
    """The least sum of the squared ways.

    Two robots i, j then have (x_i - x_j) (g_i - g_j) >= 0 with their starts x and their places g, or an
    exchange would be shorter. So discs of radius R that travel in step (`Straight`) do not touch if starts
    and places are more than 2 sqrt(2) R apart: Turpin, Michael and Kumar 2014 (CAPT),
    doi 10.1177/0278364913515307. The sum of the ways themselves is nearly the least, too.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError:
        raise MissingExtraError("planning.method = 'optimal'", "planning") from None
    rows, columns = linear_sum_assignment(_distances(positions, places) ** 2)
    order = np.empty(len(rows), dtype=np.intp)
    order[columns] = rows
    return [int(robot) for robot in order]


METHODS: Mapping[str, Planner] = {
    "given": given,
    "final-reorganization": final_reorganization,
    "proximity": proximity,
    "optimal": optimal,
}
"""The built-in planners."""


class Plan(NamedTuple):
    """An assignment and what it means for straight ways that all begin and end together."""

    order: tuple[int, ...]
    total_m: float
    """The sum of all ways."""
    longest_m: float
    """The longest way."""
    crossings: int
    """Pairs of ways that meet."""
    separation_m: float
    """The smallest distance between two control points on the way."""


def plan(planner: Planner, positions: Floats, places: Floats) -> Plan:
    """What a planner decides for robots at `positions` (n, 2) and `places` (n, 2).

    Raises:
        ValueError: what the planner gave is no order of the n robots.
    """
    order = tuple(int(robot) for robot in planner(positions, places))
    if sorted(order) != list(range(len(places))):
        raise ValueError(f"a planner gave {order}; must be an order of 0 to {len(places) - 1}")
    starts = np.asarray(positions, dtype=np.float64)[list(order)]
    ways = np.linalg.norm(places - starts, axis=1)
    return Plan(
        order, float(ways.sum()), float(ways.max()), crossings(starts, places), separation(starts, places)
    )


def crossings(starts: Floats, ends: Floats) -> int:
    """How many pairs of the straight ways from `starts` (n, 2) to `ends` (n, 2) meet."""
    ways = [((x0, y0), (x1, y1)) for (x0, y0), (x1, y1) in zip(starts.tolist(), ends.tolist(), strict=True)]
    return sum(outline.gap(a, b) == 0.0 for a, b in combinations(ways, 2))


def separation(starts: Floats, ends: Floats) -> float:
    """The smallest distance (m) between two points that go straight from `starts` (n, 2) to `ends` (n, 2) in
    step, each always at the same share of its way as the others."""
    return float(approaches(starts, ends).min())


def approaches(starts: Floats, ends: Floats) -> Floats:
    """The same for every pair, (n, n); infinite for a point and itself."""
    apart = starts[:, None] - starts[None]
    change = ends[:, None] - ends[None] - apart
    square = np.maximum((change * change).sum(axis=-1), 1e-300)
    nearest = np.clip(-(apart * change).sum(axis=-1) / square, 0.0, 1.0)
    out = np.linalg.norm(apart + nearest[..., None] * change, axis=-1)
    np.fill_diagonal(out, np.inf)
    return np.asarray(out)


STRAIGHT = 1.875
"""The largest speed on a straight way over the mean one."""


class Straight:
    """The building of a formation: every point from where it is to its place along a straight line.

    All begin and end together, at rest, and are at the same share of their ways at every moment. That share
    is 10 s^3 - 15 s^4 + 6 s^5 of the share s of the time, so that accelerations begin and end at zero too.
    """

    def __init__(self, start: Floats, end: Floats, speed_mps: float) -> None:
        """From `start` (n, 2) to `end` (n, 2); `speed_mps` is the largest that the fastest point reaches."""
        self.start = np.array(start, dtype=np.float64)
        self._way = np.asarray(end, dtype=np.float64) - self.start
        longest = float(np.linalg.norm(self._way, axis=1).max())
        self.duration_s = STRAIGHT * longest / speed_mps

    def at(self, t_s: float) -> tuple[Floats, Floats]:
        """The points (n, 2) in m and their velocities (n, 2) in m/s; at rest before 0 and after the end."""
        if t_s <= 0.0 or t_s >= self.duration_s:
            return self.start + (self._way if t_s > 0.0 or not self.duration_s else 0.0), 0.0 * self._way
        s = t_s / self.duration_s
        share = s * s * s * (10.0 - s * (15.0 - 6.0 * s))
        rate = 30.0 * (s * (1.0 - s)) ** 2 / self.duration_s
        return self.start + share * self._way, rate * self._way


def follow(points: Floats, velocities: Floats, positions: Floats, gains: Gains) -> Floats:
    """Velocities (n, 2) in m/s of control points at `positions` that are to be at `points` and move at
    `velocities`, all (n, 2) in m and m/s in one frame.

    Each for itself, by eq. (7) with the gains of x and y: x' = x_des' + L tanh(L^-1 kappa (x_des - x)). That
    is how straight ways are to be followed: on the way the triangles may be singular, or mirror images.
    """
    reach = gains.slope[:2] * (points - positions)
    return np.asarray(velocities + gains.saturation[:2] * np.tanh(reach))


def overlaps(places: Floats) -> int:
    """How many pairs of triangles of the chain over `places` (n, 2) have more than an edge in common."""
    return int(_overlaps(np.asarray(places, dtype=np.float64)[None])[0])


def singular(places: Floats, signed: bool = True) -> bool:
    """Whether a triangle of the chain over `places` (n, 2) has p, q or median below `NEAR_M`; with the
    unsigned angle also whether one is that flat."""
    length, height = _sizes(np.asarray(places, dtype=np.float64)[None])
    return bool(length.min() < NEAR_M or (not signed and height.min() < NEAR_M))


def rechain(places: Floats, signed: bool = True) -> tuple[int, ...]:
    """An order in which `places` (n, 2) can be chained: as they are if no triangle is singular then."""
    return relabel(places, signed) if singular(places, signed) else tuple(range(len(places)))


def relabel(places: Floats, signed: bool = True) -> tuple[int, ...]:
    """The order of `places` (n, 2) whose chain of triangles is best: not singular, and with few overlaps.

    A singular triangle counts as 4 n overlaps; one flatter than `NEAR_M` as one, or as 4 n with the unsigned
    angle, where it is singular. Of equals the one whose shortest p, q or median is longest is taken, but
    places that are as good already stay as they are.

    Up to `EXACT` places all orders are compared. For more, sweeps across the plane in many directions and
    zigzags round the centroid are, and then exchanges of two places near each other in the best of them, as
    long as that improves it: an overlap that could be avoided may remain.
    """
    points = np.asarray(places, dtype=np.float64)
    n = len(points)
    if n <= EXACT:
        return _best(points, _permutations(n), signed)[0]
    order, cost = _best(points, np.array([range(n), *_sweeps(points), *_zigzags(points)]), signed)
    for _ in range(max(1, 5000 // (n * n))):
        better, less = _best(points, _exchanges(order), signed)
        if less >= cost:
            break
        order, cost = better, less
    return order


def _best(points: Floats, orders: Indices, signed: bool) -> tuple[tuple[int, ...], int]:
    """The best of `orders` (c, n) and its cost in overlaps; the first if none is cheaper."""
    chains = points[orders]
    length, height = _sizes(chains)
    grave = 4 * len(points)
    cost = _overlaps(chains) + grave * (length < NEAR_M).sum(axis=1)
    cost += (1 if signed else grave) * (height < NEAR_M).sum(axis=1)
    best = int(np.lexsort((-length.min(axis=1).round(6), cost))[0])
    chosen = best if cost[best] < cost[0] else 0
    return tuple(orders[chosen].tolist()), int(cost[chosen])


@lru_cache(maxsize=8)
def _permutations(n: int) -> Indices:
    return np.array(list(permutations(range(n))))


def _sweeps(points: Floats) -> list[Indices]:
    """Orders along lines in directions all round; none of them upright to rows and columns."""
    angles = np.arange(24) * (math.pi / 12) + 0.02
    return [np.argsort(points @ (math.cos(a), math.sin(a)), kind="stable") for a in angles]


def _zigzags(points: Floats) -> list[Indices]:
    """Orders to and fro between two sides, from every place (or every few) round the centroid."""
    n = len(points)
    x, y = (points - points.mean(axis=0)).T
    around = np.argsort(np.arctan2(y, x), kind="stable")
    rank = np.arange(n)
    corner = np.where(rank % 2, (rank + 1) // 2, -(rank // 2))
    return [around[(first + corner) % n] for first in range(0, n, max(1, n // 12))]


def _exchanges(order: Sequence[int]) -> Indices:
    """`order`, and every one with two exchanged that are next or next but one to each other."""
    n = len(order)
    pairs = [(k, k + step) for step in (1, 2) for k in range(n - step)]
    out = np.tile(np.asarray(order, dtype=np.intp), (len(pairs) + 1, 1))
    for row, (a, b) in zip(out[1:], pairs, strict=True):
        row[[a, b]] = row[[b, a]]
    return out


def _windows(chains: Floats) -> Floats:
    """The triangles (c, m, 3, 2) of chains of points (c, n, 2)."""
    return np.stack([chains[:, :-2], chains[:, 1:-1], chains[:, 2:]], axis=2)


def _sizes(chains: Floats) -> tuple[Floats, Floats]:
    """The shortest of p, q and median, and the smallest height, of every triangle of the chains: (c, m)."""
    first, second, third = np.moveaxis(_windows(chains), 2, 0)
    d2, d3 = second - first, third - first
    p, q, r = (np.linalg.norm(d, axis=-1) for d in (d2, d3, d3 - d2))
    median = 0.5 * np.linalg.norm(d2 + d3, axis=-1)
    doubled = np.abs(d2[..., 0] * d3[..., 1] - d2[..., 1] * d3[..., 0])
    height = doubled / np.maximum(np.maximum(np.maximum(p, q), r), 1e-300)
    return np.minimum(np.minimum(p, q), median), height


def _overlaps(chains: Floats) -> Indices:
    """Pairs of triangles with a common interior in each of the chains (c, n, 2): no edge parts them."""
    corners = _windows(chains)
    count, m = corners.shape[:2]
    edges = np.roll(corners, -1, axis=2) - corners
    length = np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-300)
    normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1) / length
    along = np.matmul(normals.reshape(count, 3 * m, 2), corners.reshape(count, 3 * m, 2).swapaxes(1, 2))
    along = along.reshape(count, m, 3, m, 3)
    low, high = along.min(axis=-1), along.max(axis=-1)
    own = np.arange(m)
    own_low, own_high = low[:, own, :, own].swapaxes(0, 1), high[:, own, :, own].swapaxes(0, 1)
    parted = np.maximum(low - own_high[..., None], own_low[..., None] - high).max(axis=2)
    parted = np.maximum(parted, parted.swapaxes(1, 2))
    flat = (own_high - own_low).min(axis=2) < 1e-9
    shared = (parted < -1e-9) & ~flat[:, :, None] & ~flat[:, None, :]
    return np.asarray((shared.sum(axis=(1, 2)) - (~flat).sum(axis=1)) // 2)


def _distances(a: Floats, b: Floats) -> Floats:
    """Between all points of two sets (k, 2) and (m, 2): (k, m)."""
    return np.asarray(np.linalg.norm(np.asarray(a)[:, None] - np.asarray(b)[None], axis=-1))


def _sequence(first: Floats, second: Floats, third: Floats) -> bool:
    """Whether three points are in the sequence ABC, counter-clockwise."""
    a, b = second - first, third - first
    return bool(a[0] * b[1] > a[1] * b[0])
