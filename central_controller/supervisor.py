"""Keeps every triangle away from where its Jacobian is singular, and robots out of each other's way.

The Jacobian of a triangle loses rank where R1 meets R2 (p = 0), where R1 meets R3 (q = 0) and where R1 is
midway between R2 and R3 (no median, hence no psi_F); the printed one, with the unsigned angle, also where all
three are in a line. Each of the first three is a point that a robot must not come near:

    p = 0         R2 at R1
    q = 0         R3 at R1
    median = 0    R3 at 2 R1 - R2, the mirror image of R2; the median is half of R3's distance from there

A robot that comes too near to such a point while the law leads it nearer is led round it: outwards, and
towards the side where it belongs, until the law leads away by itself. It belongs where the desired triangle
has it, for p and q, and for the median on the side of the line R1 R2 that gives beta its desired sign. A
point can be passed on either side, so this only delays the law. A line can't: a triangle that is nearly flat
by the unsigned angle is opened to the desired side, across the line if it has to be.

Each triangle moves one robot, its third, which the triangle after it has as R2; the first triangle also moves
R2, away from R1. The law's rates mean little near a singular point: there the first triangle is slowed down.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from central_controller.planning import approaches
from maniple.core.geometry import Floats
from maniple.core.messages import Led
from maniple.core.scenario import types

Kind: TypeAlias = Literal["p", "q", "median", "height"]

RELEASE = 1.25
"""A robot is let go where the margin is exceeded by this factor, if the law does not lead it back."""

FREE = 2.0
"""Beyond the margin by this factor it is let go whatever the law does."""

AIM = 1.5
"""As far as it is led."""

RATE_PER_S = 0.5
"""Robots are led at the margin times this: 0.075 m/s with the default margin."""

DEEP = 0.25
"""Below this share of the margin it acts even if the law leads outwards: directions mean little there."""

_LEVER = 3.0
"""How far beyond R1 and R2 their line is taken to turn with them."""

_NOWHERE_M = 1e-9


Complex: TypeAlias = NDArray[np.complex128]
"""Points or velocities of n robots, x + iy, (n,)."""


class Watch(NamedTuple):
    """What is watched of one triangle."""

    kind: Kind
    triangle: int
    robot: int
    """The one that is moved."""


class Guided(NamedTuple):
    """What the supervisor makes of the law's velocities."""

    velocities: Floats
    """Of the control points, (n, 2) in m/s."""
    notes: tuple[str, ...]
    """A line for each triangle acted on."""


class Supervisor:
    """Watches the triangles of one chain. `signed` is the law's shape angle; `names` are its robots."""

    def __init__(self, parameters: types.Supervisor, signed: bool = True, names: Sequence[str] = ()) -> None:
        self._enabled = parameters.enabled
        self._margin = parameters.margin_m
        self._signed = signed
        self._names = tuple(names)
        self._acting: dict[Watch, float] = {}
        """What is acted on, and which way round the robot is led: 1 counter-clockwise, -1 clockwise."""

    @property
    def memory(self) -> tuple[Led, ...]:
        """What the next one of the same chain has to `recall` to go on."""
        return tuple(Led(*watch, way) for watch, way in self._acting.items())

    def recall(self, memory: Sequence[Led]) -> None:
        """Go on with what was acted on."""
        n = len(self._names)
        known = [watch for robot in range(1, n) for watch in _watches(robot, n, self._signed)]
        for led in memory:
            found = [watch for watch in known if watch == (led.kind, led.triangle, led.robot)]
            self._acting.update(dict.fromkeys(found, led.way))

    def step(self, points: Floats, places: Floats, velocities: Floats) -> Guided:
        """What the robots do instead of `velocities` (n, 2) in m/s, what the law wants of the control points.

        `points` (n, 2) is where they are and `places` (n, 2) where they are to be now, in m in one frame and
        in the order of the chain. Where a desired triangle is itself smaller than twice the margin, half of
        its own length is the margin.
        """
        if not self._enabled:
            return Guided(velocities, ())
        sizes = _sizes(points, self._signed)
        if not self._acting and sizes.min() >= self._margin:
            return Guided(velocities, ())
        margins = np.minimum(self._margin, 0.5 * _sizes(places, self._signed))
        now, goal, v = _complex(points), _complex(places), _complex(velocities)
        notes = []
        for robot in range(1, len(now)):
            engaged = {
                watch: pull
                for watch in _watches(robot, len(now), self._signed)
                if (pull := self._pull(watch, sizes, margins, now, goal, v)) is not None
            }
            if not engaged:
                continue
            worst = min(engaged, key=lambda watch: _of(watch, sizes) / _of(watch, margins))
            led: complex | None = engaged[worst]
            if worst.triangle == 0:
                _calm(v, self._margin * RATE_PER_S)
                led = self._pull(worst, sizes, margins, now, goal, v)
            if led is not None:
                v[robot] = led
                notes.append(self._note(worst, sizes))
        return Guided(np.column_stack([v.real, v.imag]), tuple(notes)) if notes else Guided(velocities, ())

    def _pull(
        self,
        watch: Watch,
        sizes: Floats,
        margins: Floats,
        now: Complex,
        goal: Complex,
        v: Complex,
    ) -> complex | None:
        """The velocity that leads the robot away from what is watched, None where it is let alone."""
        size, margin = _of(watch, sizes), _of(watch, margins)
        if margin <= 0.0 or (watch not in self._acting and size >= margin):
            self._acting.pop(watch, None)
            return None
        hazard = _hazard(watch, now, goal, v)
        arm = now[watch.robot] - hazard.at
        speed = v[watch.robot] - hazard.velocity
        if watch.kind == "height":
            return self._opened(watch, size, margin, hazard, arm, speed)
        outward = (speed * arm.conjugate()).real
        if watch in self._acting:
            if size >= RELEASE * margin and (outward >= 0.0 or size >= FREE * margin):
                self._acting.pop(watch, None)
                return None
        elif outward > 0.0 and size >= DEEP * margin:
            return None
        round_it = math.copysign(1.0, (hazard.side * arm.conjugate()).imag)
        round_it = self._acting.setdefault(watch, round_it)
        scale = 2.0 if watch.kind == "median" else 1.0
        pace = scale * self._margin * RATE_PER_S
        return hazard.velocity + _led(arm, speed, hazard.side, round_it, scale * margin, pace)

    def _opened(
        self, watch: Watch, size: float, margin: float, hazard: "Hazard", arm: complex, speed: complex
    ) -> complex | None:
        """Likewise for a triangle that is nearly flat: across the line of R1 R2, to the desired side."""
        offset = (arm * hazard.side.conjugate()).real
        opening = (speed * hazard.side.conjugate()).real
        right = offset > 0.0
        if watch in self._acting:
            if right and size >= RELEASE * margin and (opening >= 0.0 or size >= FREE * margin):
                self._acting.pop(watch, None)
                return None
        elif right and opening > 0.0 and size >= DEEP * margin:
            return None
        self._acting[watch] = 0.0
        return hazard.velocity + speed + max(self._margin * RATE_PER_S - opening, 0.0) * hazard.side

    def _note(self, watch: Watch, sizes: Floats) -> str:
        corners = range(watch.triangle, watch.triangle + 3)
        triangle = ", ".join(self._name(corner) for corner in corners)
        return f"{triangle}: {watch.kind} {_of(watch, sizes):.2f} m, moves {self._name(watch.robot)}"

    def _name(self, robot: int) -> str:
        return self._names[robot] if self._names else str(robot)


class Hazard(NamedTuple):
    """A point that a robot must not come near."""

    at: complex
    velocity: complex
    side: complex
    """The direction from there where the robot belongs, of length 1."""


def _watches(robot: int, n: int, signed: bool) -> list[Watch]:
    """What a robot of a chain of n is moved for."""
    found = [Watch("p", robot - 1, robot)] if robot <= n - 2 else []
    if robot >= 2:
        found += [Watch("q", robot - 2, robot), Watch("median", robot - 2, robot)]
        found += [] if signed else [Watch("height", robot - 2, robot)]
    return found


_COLUMN: dict[Kind, int] = {"p": 0, "q": 1, "median": 2, "height": 3}


def _of(watch: Watch, values: Floats) -> float:
    return float(values[watch.triangle, _COLUMN[watch.kind]])


def _sizes(points: Floats, signed: bool) -> Floats:
    """p, q, median and, with the unsigned angle, the smallest height of every triangle: (n - 2, 3 or 4)."""
    corners = _complex(points)
    d2, d3 = corners[1:-1] - corners[:-2], corners[2:] - corners[:-2]
    p, q = np.abs(d2), np.abs(d3)
    columns = [p, q, 0.5 * np.abs(d2 + d3)]
    if not signed:
        longest = np.maximum(np.maximum(p, q), np.abs(d3 - d2))
        columns.append(np.abs((d2.conj() * d3).imag) / np.maximum(longest, _NOWHERE_M))
    return np.column_stack(columns)


def _hazard(watch: Watch, now: Complex, goal: Complex, v: Complex) -> Hazard:
    """What a robot is to be led round, and to which side."""
    j, robot = watch.triangle, watch.robot
    if watch.kind in ("p", "q"):
        return Hazard(complex(now[j]), complex(v[j]), _direction(goal[robot] - goal[j]))
    d2, d3 = goal[j + 1] - goal[j], goal[j + 2] - goal[j]
    sequence = math.copysign(1.0, (d2.conjugate() * d3).imag)
    along = now[j + 1] - now[j]
    if abs(along) < _NOWHERE_M:
        along = d2
    side = 1j * sequence * _direction(along)
    if watch.kind == "median":
        return Hazard(complex(2.0 * now[j] - now[j + 1]), complex(2.0 * v[j] - v[j + 1]), side)
    share = ((now[robot] - now[j]) * along.conjugate()).real / abs(along) ** 2
    share = min(max(share, -_LEVER), _LEVER)
    return Hazard(complex(now[j] + share * along), complex(v[j] + share * (v[j + 1] - v[j])), side)


def _led(arm: complex, speed: complex, side: complex, round_it: float, margin: float, pace: float) -> complex:
    """The velocity relative to a hazard of a robot that is `arm` away from it and would move at `speed`:
    outwards to `AIM` times the margin, and round it as long as the law leads inwards."""
    distance = abs(arm)
    out = arm / distance if distance > _NOWHERE_M else side
    relative = speed * out.conjugate()
    relative *= min(1.0, pace / max(abs(relative), _NOWHERE_M))
    eager = min(max((AIM * margin - distance) / ((AIM - RELEASE) * margin), 0.0), 1.0)
    around = relative.imag if relative.real >= 0.0 else round_it * max(pace, round_it * relative.imag)
    return out * complex(max(relative.real, pace * eager), around)


def _calm(v: Complex, pace: float) -> None:
    """Let no robot of the first triangle move faster than `pace` against its centroid, all in proportion."""
    middle = v[:3].mean()
    against = v[:3] - middle
    v[:3] = middle + against * min(1.0, pace / max(float(np.abs(against).max()), _NOWHERE_M))


def _direction(d: complex) -> complex:
    return complex(d / abs(d)) if abs(d) > _NOWHERE_M else 1.0 + 0.0j


def _complex(points: Floats) -> Complex:
    """Points (n, 2) as x + iy (n,), a copy."""
    return np.asarray(points[:, 0] + 1j * points[:, 1])


WORTH_M2 = 0.01
"""An exchange that makes the sum of the squared ways less by no more than this is not worth it."""


def exchange(
    points: Floats, places: Floats, order: Sequence[int], movable: NDArray[np.bool_], clearance_m: float
) -> tuple[int, ...] | None:
    """Who takes which place once robots that are in each other's way have exchanged theirs; None if none are.

    The robots' control points are at `points` (n, 2), robot `order[k]` goes to the k-th of `places` (n, 2),
    and robots i and j may exchange where `movable[i, j]`, (n, n). Two are in each other's way if they would
    come nearer than `clearance_m` on straight ways in step, and exchange if that makes the sum of the squares
    of their ways less: with x where they are and g where they go, if (x_i - x_j) (g_i - g_j) < 0.
    """
    current = list(order)
    while True:
        starts = points[current]
        gain = -2.0 * ((starts[:, None] - starts[None]) * (places[:, None] - places[None])).sum(axis=-1)
        allowed = movable[np.ix_(current, current)] & (approaches(starts, places) < clearance_m)
        gain = np.where(allowed, gain, 0.0)
        if gain.max() <= WORTH_M2:
            break
        i, j = np.unravel_index(gain.argmax(), gain.shape)
        current[i], current[j] = current[j], current[i]
    return tuple(current) if current != list(order) else None
