"""Distances between outlines, contacts and their onsets, from ground truth.

Looking is expensive, so it is rare. Since the last look no distance can have shrunk by more than the
outlines moved (conservative advancement), so steps may be taken unseen until that could close the smallest
one; the poses passed meanwhile are kept and looked at all at once. Only pairs that may be somebody's
nearest, given how far the outlines moved since the pairs were chosen, are looked at. Nothing of this
changes the result: clearances are exact at every step.
"""

from collections.abc import Sequence

import numpy as np

from maniple.core.geometry import Floats
from simulator.world import Complexes, Ints, Shapes

FAR_M = 1e6
"""Clearance of a robot that is alone in the world."""
RELEASE_M = 1e-3
"""A contact ends when the pair is farther apart by this than where it was stopped."""
_SLACK_M = 0.4
"""Pairs are looked at if they are at most this much farther apart than a robot's nearest."""
_HISTORY = 64
"""Most steps that are kept before a look."""


def separation(offset: Complexes, turn: Complexes, half: Complexes, corners: Complexes) -> Floats:
    """Distances (m) of p pairs of rectangles in k poses, exact, 0 where they overlap; shape (k, p).

    Disjoint convex polygons are nearest at a corner of one of them; overlap is decided by the separating
    axis theorem. Both hold for rectangles without width (segments) and without length (points).

    Args:
        offset: from the first to the second rectangle's centre, m, shape (k, p).
        turn: exp(-i heading) of both, shape (k, 2, p).
        half: half length + i half width of both, shape (2, p).
        corners: the corners of the other of the two in its own frame, shape (4, 1, 2, p).
    """
    between = offset[:, None] * turn  # in the frame of either; a rectangle does not mind the sign
    corner = corners * (turn * turn[:, ::-1].conj())
    reach = np.abs(_parts(corner[:2])).max(axis=0)
    own = _parts(half)
    apart = np.abs(_parts(between))
    apart -= own
    apart -= reach
    gap = np.abs(_parts(corner + between))
    gap -= own
    np.maximum(gap, 0.0, out=gap)
    gap *= gap
    nearest = np.sqrt((gap[..., 0] + gap[..., 1]).min(axis=(0, 2)))
    nearest[apart.max(axis=(1, 3)) <= 0.0] = 0.0
    return np.asarray(nearest)


def _parts(points: Complexes) -> Floats:
    """Real and imaginary parts as a last axis, without copying."""
    return points.view(np.float64).reshape(*points.shape, 2)


class Collisions:
    """Who is how near to what, and who touches whom.

    Args:
        robots: ids.
        half: half length + i half width of each robot, m, shape (n,).
        shapes: the obstacles.
        position: where the robots start, x + iy, m, shape (n,).
        heading: likewise, rad, shape (n,).
        stride_m: about the most a point of an outline moves in one step.
    """

    def __init__(
        self,
        robots: Sequence[str],
        half: Complexes,
        shapes: Shapes,
        position: Complexes,
        heading: Floats,
        stride_m: float,
    ) -> None:
        n = len(robots)
        self._robots = tuple(robots)
        self._half = np.concatenate([half, shapes.half])
        self._radius = np.concatenate([np.zeros(n), shapes.radius])
        self._thing: Ints = np.concatenate([np.arange(n), n + shapes.thing])
        self._slack = max(_SLACK_M, 8.0 * stride_m)
        self._centres = np.empty((_HISTORY, n + len(shapes.radius)), dtype=np.complex128)
        self._centres[:, n:] = shapes.centre
        self._headings = np.empty(self._centres.shape)
        self._headings[:, n:] = shapes.heading
        self._kept = 0
        self._moved = self._roamed = 0.0
        self._contacts: dict[tuple[int, int], float] = {}
        self._touched: set[int] = set()
        self.count = 0
        """Onsets of contact of any pair so far."""
        self._minimum = np.full(n, np.inf)
        self._choose(position, heading)
        self._keep(position[None], heading[None])
        self.look()

    def clear(self, moved: Floats) -> bool:
        """Whether steps in which outlines move by at most `moved` (m, shape (n,)) surely touch nothing."""
        most = float(np.maximum.reduce(moved))
        if self._roamed + most > 0.25 * self._slack:
            if self._roamed > 0.0:
                self._choose_again()
            if most > 0.25 * self._slack:
                return False
        if 2.0 * (self._moved + most) < self._nearest:
            return True
        self.look()
        reach = np.zeros(len(self._thing))
        reach[: len(moved)] = moved
        return bool((reach[self._first] + reach[self._second] < self._distance).all())

    def record(self, position: Complexes, heading: Floats, moved: Floats) -> None:
        """Steps were taken through `position` (x + iy, m) and `heading` (rad), shape (k, n), by which
        outlines moved by at most `moved` (m, shape (n,))."""
        most = float(np.maximum.reduce(moved))
        self._moved += most
        self._roamed += most
        self._keep(position, heading)

    def overlaps(self, position: Complexes, heading: Floats) -> list[tuple[int, int]]:
        """Pairs of (robot, thing) that would overlap with the robots there, shape (n,)."""
        n = len(self._robots)
        distance = self._distances(
            np.concatenate([position, self._centres[0, n:]])[None],
            np.concatenate([heading, self._headings[0, n:]])[None],
        )
        touching = np.flatnonzero(distance[0] <= 0.0)
        return [(int(self._first[k]), int(self._thing[self._second[k]])) for k in touching]

    def stop(self, pair: tuple[int, int]) -> None:
        """A step of (robot, thing) was refused because it would have made them overlap."""
        self._touched.update(k for k in pair if k < len(self._robots))
        if pair not in self._contacts:
            self.count += 1
            self._contacts[pair] = self._gap(pair)

    def look(self) -> None:
        """Bring distances, least clearances and contacts up to date with the steps taken."""
        if not self._kept:
            return
        distance = self._distances(self._centres[: self._kept], self._headings[: self._kept])
        self._centres[0] = self._centres[self._kept - 1]
        self._headings[0] = self._headings[self._kept - 1]
        self._distance = distance[-1]
        self._nearest = float(self._distance.min(initial=FAR_M))
        np.minimum.at(self._minimum, self._whose, distance.min(axis=0)[self._which])
        self._kept = 0
        self._moved = 0.0
        for pair in [p for p, gap in self._contacts.items() if self._gap(p) > gap + RELEASE_M]:
            del self._contacts[pair]

    def report(self) -> tuple[Floats, tuple[str, ...]]:
        """Least clearance (m) of each robot since the report before, shape (n,), 0 for those who touched;
        and the contacts now, as "r1|r2" or "r1|obstacle 3" (`world.obstacles[3]`)."""
        self.look()
        clearance = np.clip(self._minimum, 0.0, FAR_M)
        clearance[sorted(self._touched)] = 0.0
        self._minimum[:] = np.inf
        np.minimum.at(self._minimum, self._whose, self._distance[self._which])
        n = len(self._robots)
        self._touched = {k for pair in self._contacts for k in pair if k < n}
        return clearance, tuple(self._name(pair) for pair in sorted(self._contacts))

    def _name(self, pair: tuple[int, int]) -> str:
        n = len(self._robots)
        thing = self._robots[pair[1]] if pair[1] < n else f"obstacle {pair[1] - n}"
        return f"{self._robots[pair[0]]}|{thing}"

    def _keep(self, position: Complexes, heading: Floats) -> None:
        if self._kept + len(position) > _HISTORY:
            self.look()
        rows = slice(self._kept, self._kept + len(position))
        n = len(self._robots)
        self._centres[rows, :n] = position
        self._headings[rows, :n] = heading
        self._kept += len(position)

    def _gap(self, pair: tuple[int, int]) -> float:
        """Distance of (robot, thing) now; infinite where it is not worth looking."""
        mine = (self._first == pair[0]) & (self._thing[self._second] == pair[1])
        return float(self._distance[mine].min(initial=np.inf))

    def _distances(self, centres: Complexes, headings: Floats) -> Floats:
        """Distances of the chosen pairs in each of k poses of everything, shape (k, pairs)."""
        turn = np.exp(-1j * headings).take(self._both, axis=1)
        offset = centres.take(self._second, axis=1)
        offset -= centres.take(self._first, axis=1)
        distance = separation(offset, turn, self._both_half, self._other_corners)
        distance -= self._pair_radius
        return distance

    def _choose_again(self) -> None:
        self.look()
        n = len(self._robots)
        self._choose(self._centres[0, :n], self._headings[0, :n])
        self._kept = 1
        self.look()

    def _choose(self, position: Complexes, heading: Floats) -> None:
        """Choose the pairs to look at while no outline moves by more than a quarter of the slack.

        The distance from a robot's centre to a shape, less the circumscribed radius, is a lower bound of
        their distance; less the inscribed one, an upper bound.
        """
        n = len(self._robots)
        centres, headings = self._centres[0].copy(), self._headings[0].copy()
        centres[:n], headings[:n] = position, heading
        offset = (centres - position[:, None]) * np.exp(-1j * headings)
        gap_x = np.maximum(np.abs(offset.real) - self._half.real, 0.0)
        gap_y = np.maximum(np.abs(offset.imag) - self._half.imag, 0.0)
        centre = np.hypot(gap_x, gap_y) - self._radius
        centre[np.arange(n), np.arange(n)] = np.inf
        body = self._half[:n]
        upper = centre - np.minimum(body.real, body.imag)[:, None]
        wanted = centre - np.abs(body)[:, None] <= upper.min(axis=1)[:, None] + self._slack
        wanted[np.arange(n), np.arange(n)] = False
        wanted[:, :n] = np.triu(wanted[:, :n] | wanted[:, :n].T)

        self._first, self._second = np.nonzero(wanted)
        self._both = np.stack([self._first, self._second])
        self._both_half = self._half[self._both]
        other = self._both_half[::-1]
        self._other_corners = np.stack([other, other.conj(), -other, -other.conj()])[:, None]
        self._pair_radius = self._radius[self._second]
        between_robots = np.flatnonzero(self._second < n)
        self._whose = np.concatenate([self._first, self._second[between_robots]])
        self._which = np.concatenate([np.arange(len(self._first)), between_robots])
        self._roamed = 0.0
