"""How the formation's frame moves during one part of a task: where it is and, exactly, how that changes."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats, Pose, wrap
from maniple.core.scenario.types import (
    Csv,
    FigureEight,
    Leg,
    Line,
    Orbit,
    Point,
    Positioning,
    Samples,
    Waypoints,
)

Velocity: TypeAlias = tuple[float, float, float]
"""Of a frame, in the frame its pose is given in: (m/s, m/s, rad/s counter-clockwise)."""

REST: Velocity = (0.0, 0.0, 0.0)


class Way(Protocol):
    """The motion of a frame."""

    @property
    def travel_s(self) -> float:
        """How long it takes; 0 for a frame that stands."""

    @property
    def length_m(self) -> float:
        """How far the frame's origin goes."""

    def at(self, t_s: float) -> tuple[Pose, Velocity]:
        """Pose and its derivative at 0 <= t_s <= travel_s."""

    def twists(self) -> Floats:
        """Velocities (k, 3) along the frame's own axes that are met on the way, the extreme ones among
        them."""


def way_of(leg: Leg) -> Way:
    """The way of one part of a task.

    Raises:
        ScenarioError: its file has not been loaded.
    """
    match leg:
        case Line(start=start, end=end):
            return Travel(Arcs([_straight(start, end)]), leg.speed_mps, "along")
        case Waypoints(points=points, radius_m=radius):
            return Travel(Arcs(rounded(points, radius)), leg.speed_mps, leg.facing)
        case Orbit():
            return Travel(Arcs([_circle(leg)]), leg.speed_mps, leg.facing)
        case FigureEight():
            return Travel(Lemniscate(leg), leg.speed_mps, leg.facing)
        case Samples(times_s=times, poses=poses):
            return Spline(times, poses)
        case Positioning(target=target):
            return Stand(Pose(*map(float, target)))
        case Csv(file=file):
            raise ScenarioError(f"the way in {file!r} has not been loaded; must be samples here")


def speed_at(twists: Floats, place: Point) -> float:
    """Largest speed (m/s) of a place that is fixed in a frame which moves at `twists`, see `Way`."""
    x, y = place
    return float(np.hypot(twists[:, 0] - twists[:, 2] * y, twists[:, 1] + twists[:, 2] * x).max())


class Path(Protocol):
    """A curve in the plane by its arc length."""

    @property
    def length_m(self) -> float:
        """Of all of it."""

    def at(self, s_m: float) -> tuple[Pose, float]:
        """Point and direction, and the curvature (1/m, positive to the left) after `s_m`."""

    def curvatures(self) -> Floats:
        """Curvatures (k,) that are met, the extreme ones among them."""


class Travel:
    """A path at constant speed; "along": the frame turns with it, "fixed": it keeps its first direction."""

    def __init__(self, path: Path, speed_mps: float, facing: Literal["along", "fixed"]) -> None:
        self._path = path
        self._speed = speed_mps
        self._heading = None if facing == "along" else path.at(0.0)[0].psi
        self.length_m = path.length_m
        self.travel_s = path.length_m / speed_mps

    def at(self, t_s: float) -> tuple[Pose, Velocity]:
        """See `Way`."""
        on, curvature = self._path.at(min(self._speed * t_s, self.length_m))
        vx, vy = self._speed * math.cos(on.psi), self._speed * math.sin(on.psi)
        if self._heading is None:
            return on, (vx, vy, self._speed * curvature)
        return Pose(on.x, on.y, self._heading), (vx, vy, 0.0)

    def twists(self) -> Floats:
        """See `Way`; of a fixed heading the speed only, along x."""
        turning = self._path.curvatures() if self._heading is None else np.zeros(1)
        return self._speed * np.stack([np.ones_like(turning), np.zeros_like(turning), turning], axis=-1)


class Arc(NamedTuple):
    """Part of a circle, or of a straight line where the curvature is 0."""

    start: Pose
    length_m: float
    curvature: float
    """1/m, positive to the left."""


class Arcs:
    """Arcs one after the other, each starting where the one before ends."""

    def __init__(self, arcs: Sequence[Arc]) -> None:
        self._arcs = tuple(arcs)
        self._begins = [0.0]
        for arc in self._arcs:
            self._begins.append(self._begins[-1] + arc.length_m)

    @property
    def length_m(self) -> float:
        """See `Path`."""
        return self._begins[-1]

    def at(self, s_m: float) -> tuple[Pose, float]:
        """See `Path`."""
        index = min(bisect_right(self._begins, s_m), len(self._arcs)) - 1
        arc, done = self._arcs[index], s_m - self._begins[index]
        return arc.start.advance(done, done * arc.curvature), arc.curvature

    def curvatures(self) -> Floats:
        """See `Path`."""
        return np.array(sorted({arc.curvature for arc in self._arcs}))


def rounded(points: Sequence[Point], radius_m: float) -> list[Arc]:
    """Straight lines through `points`, joined by arcs that are tangent to both.

    An arc starts `radius_m` tan(turn / 2) before its corner, but no farther than half of the shorter line
    there: then its radius is smaller.
    """
    lines = [_straight(a, b) for a, b in pairwise(points)]
    arcs: list[Arc] = []
    cut = 0.0
    for line, after in zip(lines, [*lines[1:], None], strict=True):
        turn = wrap(after.start.psi - line.start.psi) if after else 0.0
        slope = math.tan(0.5 * abs(turn))
        shorter = min(line.length_m, after.length_m) if after else 0.0
        tangent = min(radius_m * slope, 0.5 * shorter)
        straight = line.length_m - cut - tangent
        if straight > 0.0 or not arcs:
            arcs.append(Arc(line.start.advance(cut, 0.0), straight, 0.0))
        if tangent > 0.0:
            radius = tangent / slope
            entry = line.start.advance(line.length_m - tangent, 0.0)
            arcs.append(Arc(entry, radius * abs(turn), math.copysign(1.0 / radius, turn)))
        cut = tangent
    return arcs


def _straight(start: Point, end: Point) -> Arc:
    dx, dy = end[0] - start[0], end[1] - start[1]
    return Arc(Pose(float(start[0]), float(start[1]), math.atan2(dy, dx)), math.hypot(dx, dy), 0.0)


def _circle(leg: Orbit) -> Arc:
    side = -1.0 if leg.clockwise else 1.0
    start = Pose(*leg.centre, wrap(leg.start_rad)).compose(Pose(leg.radius_m, 0.0, side * 0.5 * math.pi))
    return Arc(start, 2.0 * math.pi * leg.radius_m * leg.turns, side / leg.radius_m)


class Lemniscate:
    """Gerono's figure eight, (sin a, sin a cos a) times its size, from its crossing on.

    Its curvature has no jumps. The arc length from 0 to `a` is a Fourier series, s = c0 a + sum ck sin 2ka,
    found once for size 1 and inverted by Newton's method.
    """

    def __init__(self, leg: FigureEight) -> None:
        self._frame = Pose(*leg.centre, wrap(leg.angle_rad))
        self._size = leg.size_m
        self._lap = 2.0 * math.pi * _unit_lemniscate()[0]
        self.length_m = leg.laps * self._lap * leg.size_m

    def at(self, s_m: float) -> tuple[Pose, float]:
        """See `Path`."""
        a = self._angle(math.fmod(s_m / self._size, self._lap))
        return self._frame.compose(
            Pose(self._size * math.sin(a), self._size * math.sin(a) * math.cos(a), _direction(a))
        ), float(_unit_curvature(np.array(a))) / self._size

    def curvatures(self) -> Floats:
        """See `Path`."""
        farthest = self._angle(min(self.length_m / self._size, self._lap))
        return _unit_curvature(farthest * np.linspace(0.0, 1.0, 721)) / self._size

    @staticmethod
    def _angle(s: float) -> float:
        """The parameter `a` after the arc length `s` on the curve of size 1."""
        mean, waves = _unit_lemniscate()
        orders = 2.0 * np.arange(1, len(waves) + 1)
        a = s / mean
        for _ in range(20):
            off = mean * a + float(waves @ np.sin(orders * a)) - s
            a -= off / math.hypot(math.cos(a), math.cos(2.0 * a))
            if abs(off) < 1e-13:
                break
        return a


@cache
def _unit_lemniscate() -> tuple[float, Floats]:
    """c0 and c1, c2, ... of the arc length of the curve of size 1: the integral of the spectrum of ds/da."""
    a = np.pi / 256 * np.arange(256)
    spectrum = np.fft.rfft(np.hypot(np.cos(a), np.cos(2.0 * a))).real / 256
    orders = np.arange(1, 64)
    return float(spectrum[0]), spectrum[1:64] / orders


def _direction(a: float) -> float:
    return math.atan2(math.cos(2.0 * a), math.cos(a))


def _unit_curvature(a: Floats) -> Floats:
    """(x' y'' - y' x'') / |(x', y')|^3 of the curve of size 1."""
    dx, dy = np.cos(a), np.cos(2.0 * a)
    return np.asarray((-2.0 * dx * np.sin(2.0 * a) + dy * np.sin(a)) / np.hypot(dx, dy) ** 3)


class Spline:
    """Poses at given times, joined by cubics whose slopes make no overshoot (Fritsch and Butland 1984).

    Once differentiable; headings take the shorter way round from one pose to the next.
    """

    def __init__(self, times_s: Sequence[float], poses: Sequence[tuple[float, float, float]]) -> None:
        values = np.array(poses, dtype=np.float64)
        values[:, 2] = np.unwrap(values[:, 2])
        steps = np.diff(np.array(times_s, dtype=np.float64))
        chords = np.diff(values, axis=0) / steps[:, None]
        slopes = _monotone_slopes(steps, chords)
        h = steps[:, None]
        square = (3.0 * chords - 2.0 * slopes[:-1] - slopes[1:]) / h
        cube = (slopes[:-1] + slopes[1:] - 2.0 * chords) / h**2
        self._cubics = np.stack([values[:-1], slopes[:-1], square, cube], axis=1)
        self._steps = steps
        self._times = [float(t) for t in times_s]
        self._rows: list[list[list[float]]] = self._cubics.tolist()
        self.travel_s = self._times[-1]

    @property
    def length_m(self) -> float:
        """See `Way`; in chords, eight between two samples."""
        u = np.linspace(0.0, 1.0, 9)[:, None, None] * self._steps[:, None]
        a, b, c, d = (self._cubics[None, :, k, :2] for k in range(4))
        points = a + u * (b + u * (c + u * d))
        return float(np.hypot(*np.moveaxis(np.diff(points, axis=0), -1, 0)).sum())

    def at(self, t_s: float) -> tuple[Pose, Velocity]:
        """See `Way`."""
        index = min(max(bisect_right(self._times, t_s), 1), len(self._rows)) - 1
        u = t_s - self._times[index]
        a, b, c, d = self._rows[index]
        x, y, psi = (a[k] + u * (b[k] + u * (c[k] + u * d[k])) for k in range(3))
        vx, vy, turning = (b[k] + u * (2.0 * c[k] + u * 3.0 * d[k]) for k in range(3))
        return Pose(x, y, wrap(psi)), (vx, vy, turning)

    def twists(self) -> Floats:
        """See `Way`; at nine moments between two samples."""
        u = np.linspace(0.0, 1.0, 9)[:, None] * self._steps
        a, b, c, d = (self._cubics[None, :, k, :] for k in range(4))
        v = b + u[..., None] * (2.0 * c + 3.0 * d * u[..., None])
        psi = (a + u[..., None] * (b + u[..., None] * (c + d * u[..., None])))[..., 2]
        along = v[..., 0] * np.cos(psi) + v[..., 1] * np.sin(psi)
        across = v[..., 1] * np.cos(psi) - v[..., 0] * np.sin(psi)
        return np.stack([along, across, v[..., 2]], axis=-1).reshape(-1, 3)


def directions(times_s: Sequence[float], points: Sequence[Point]) -> list[float]:
    """Heading (rad) along the way at every one of its samples: that of a parabola through its neighbours.

    Where the way stands it stays as before, at the start as after; 0 if it never moves.
    """
    where, when = np.array(points, dtype=np.float64), np.array(times_s, dtype=np.float64)
    moves = np.gradient(where, when, axis=0, edge_order=1 if len(when) < 3 else 2)
    moving = np.flatnonzero(np.hypot(*moves.T) > 1e-9)
    if not len(moving):
        return [0.0] * len(when)
    last = np.maximum(np.searchsorted(moving, np.arange(len(when)), side="right") - 1, 0)
    return list(map(float, np.arctan2(moves[:, 1], moves[:, 0])[moving[last]]))


def _monotone_slopes(steps: Floats, chords: Floats) -> Floats:
    """Slopes (n, 3) at n moments from the slopes (n - 1, 3) between them: 0 at an extremum, else a weighted
    harmonic mean; at the ends a parabola's, where that does not overshoot."""
    if len(steps) == 1:
        return np.repeat(chords, 2, axis=0)
    before, after = steps[:-1, None], steps[1:, None]
    first, second = chords[:-1], chords[1:]
    weight1, weight2 = 2.0 * after + before, after + 2.0 * before
    slopes = np.zeros((len(steps) + 1, chords.shape[1]))
    same = first * second > 0.0
    with np.errstate(over="ignore"):  # next to a slope that is almost 0
        means = weight1 / np.where(same, first, 1.0) + weight2 / np.where(same, second, 1.0)
    np.divide(weight1 + weight2, means, out=slopes[1:-1], where=same)
    slopes[0] = _end_slope(steps[0], steps[1], chords[0], chords[1])
    slopes[-1] = _end_slope(steps[-1], steps[-2], chords[-1], chords[-2])
    return slopes


def _end_slope(h0: float, h1: float, chord0: Floats, chord1: Floats) -> Floats:
    slope = ((2.0 * h0 + h1) * chord0 - h0 * chord1) / (h0 + h1)
    steep = (np.sign(chord0) != np.sign(chord1)) & (np.abs(slope) > 3.0 * np.abs(chord0))
    slope = np.where(steep, 3.0 * chord0, slope)
    return np.where(np.sign(slope) == np.sign(chord0), slope, 0.0)


class Stand:
    """A frame that stays where it is."""

    travel_s = 0.0
    length_m = 0.0

    def __init__(self, pose: Pose) -> None:
        self._pose = pose

    def at(self, t_s: float) -> tuple[Pose, Velocity]:  # noqa: ARG002 - it is always there
        """See `Way`."""
        return self._pose, REST

    def twists(self) -> Floats:
        """See `Way`."""
        return np.zeros((1, 3))
