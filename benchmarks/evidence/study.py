"""What becomes of the starts: convergence, Lyapunov's function, the ultimate bound, a push."""

import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from benchmarks.evidence.platoons import (
    DT_S,
    KAPPA,
    ORIGIN,
    REST,
    SATURATION,
    SEED,
    Case,
    Platoons,
    headings,
    places,
    side_m,
    starts,
)
from central_controller import formation
from central_controller.chain import Chain, Desired
from central_controller.supervisor import Supervisor
from maniple.core.geometry import Floats, Pose, wrap_array
from maniple.core.scenario import types
from maniple.core.streams import stream

CHUNK = 125
"""Starts that are computed as one array: small enough for a processor's cache."""
TOLERANCE_M = 0.02
"""A platoon is in formation when no control point is farther from its place."""
SETTLED_M = 1e-3
"""A robot this near stands at its place for those that come after it in the chain."""
RISE = 1e-9
"""What V may gain in a step by rounding."""
FINE_DT_S = 1e-3
"""Step in which those starts are repeated whose first V rose."""
FINE_S = 30.0
PASS_S = 300.0
"""For how long they are repeated with the supervisor."""

SPEEDS_MPS, RADIUS_M = (0.2, 0.4), 2.0
"""Of the reference in the study of the bound, which goes round a circle and does not turn, so that the robots
of a large formation are no faster than those of a small one."""
SCATTER_M, FACING_RAD = 0.5, 0.5
"""How far off its place and its heading each robot starts there."""

SCATTERS_M = (0.5, 1.0, 2.0, 4.0)
"""How far off their places the robots of the largest platoon start, where they do not start anywhere."""

PUSH_M, PUSHED, PUSHED_OF = 0.3, 2, 12
"""One robot (counted from 0) of a standing platoon is pushed sideways."""

Category: TypeAlias = Literal[
    "mirrored, at rest", "mirrored, moving", "at rest elsewhere", "thrown apart", "under way"
]
CATEGORIES: tuple[Category, ...] = (
    "mirrored, at rest",
    "mirrored, moving",
    "at rest elsewhere",
    "thrown apart",
    "under way",
)


class Outcome(NamedTuple):
    """What became of the starts of a case; arrays over the starts first."""

    time_s: Floats
    """When the platoon was in formation for good, (s,); NaN where it was not at the horizon."""
    rise: Floats
    """The most that V of each triangle gained in a step, (s, n - 2)."""
    settled_rise: Floats
    """The same while all robots before the third stood at their places, -inf where that never was."""
    farthest_m: Floats
    """The most that each robot was away from its place, (s, n)."""
    fastest_mps: Floats
    """The fastest velocity that any control point was told, (s,)."""
    nearest_m: Floats
    """The smallest side or median of the first triangle before the step in which its V rose most, (s,)."""
    category: tuple[Category | None, ...]
    """Of those that are not in formation."""


class Bound(NamedTuple):
    """Errors and what they are bounded by, over the second half of a run round a circle."""

    error: Floats
    """The largest ||q_des - q|| of each triangle, (s, n - 2)."""
    printed: Floats
    """The largest ||delta_v|| of each triangle over lambda_min(kappa), (s, n - 2)."""
    exact: Floats
    """Norm of (L_i / kappa_i) atanh(|delta_i| / L_i), delta_i the largest of each component; infinite where
    that exceeds L_i."""


class Circle(NamedTuple):
    """Pioneers that follow a reference round a circle."""

    n: int
    speed_mps: float


class Spread(NamedTuple):
    """How far from its place each robot gets, (n,) in m, by the reference of later triangles."""

    formation: Floats
    neighbours: Floats


class Trip(NamedTuple):
    """The first three robots on their way into formation."""

    nearest_m: float
    """The smallest side or median of their triangle on the way."""
    fastest_mps: float
    """The fastest velocity that any of their control points was told."""
    time_s: float
    """When they were at their places for good; the horizon if they were not."""


class Extent(NamedTuple):
    """How much is computed."""

    sizes: tuple[int, ...]
    starts: int
    horizon_s: float
    bound_s: float


FULL = Extent((3, 4, 6, 10, 20, 50), 500, 400.0, 120.0)
QUICK = Extent((3, 4, 6, 10), 40, 200.0, 120.0)


class Study(NamedTuple):
    """Everything the tables are made of."""

    extent: Extent
    outcomes: dict[Case, Outcome]
    scattered: dict[Case, Outcome]
    """Starts near the places, of the largest platoon."""
    refined: dict[int, int]
    """By n: in how many of the starts in which the first V rose it did so in steps of FINE_DT_S too."""
    passes: dict[int, list[tuple[Trip, Trip]]]
    """By n: the same starts, under the law alone and with the supervisor."""
    bounds: dict[Circle, Bound]
    spread: Spread


def variants(n: int) -> list[Case]:
    """The cases of one size of platoon."""
    cases = [Case(n, signed=False), Case(n), Case(n, assigned=True), Case(n, slow_angles=True)]
    cases += [Case(n, assigned=True, slow_angles=True)]
    if n > 3:
        cases += [Case(n, neighbours=True), Case(n, neighbours=True, slow_angles=True)]
    pioneers = Case(n, pioneers=True)
    return [*cases, pioneers, pioneers._replace(assigned=True), pioneers._replace(slow_angles=True)]


def converge(case: Case, first: int, count: int, horizon_s: float) -> Outcome:
    """What becomes of the starts `first` to `first + count` of a formation that stands."""
    chosen = slice(first, first + count)
    platoons = Platoons(case, starts(case, first + count)[chosen], headings(case, first + count)[chosen])
    triangles = (count, case.n - 2)
    rise, settled_rise = np.full(triangles, -math.inf), np.full(triangles, -math.inf)
    out_at, fastest, nearest = np.zeros(count), np.zeros(count), np.zeros(count)
    farthest = platoons.distances()
    before, were_settled = np.full(triangles, math.inf), np.zeros(triangles, dtype=bool)
    size_before = np.zeros(count)
    steps, step = round(horizon_s / DT_S), 0
    for step in range(1, steps + 1):
        distance, size = platoons.distances(), _smallest(platoons.positions[:, :3])
        told = platoons.step(platoons.desired())
        energy = 0.5 * (told.errors**2).sum(axis=-1)
        settled = np.logical_and.accumulate(distance < SETTLED_M, axis=-1)[:, 1:-1]
        gained = energy - before
        np.copyto(nearest, size_before, where=gained[:, 0] > rise[:, 0])
        np.maximum(rise, gained, out=rise)
        np.maximum(settled_rise, gained, out=settled_rise, where=were_settled & settled)
        before, were_settled, size_before = energy, settled, size
        np.maximum(farthest, distance, out=farthest)
        np.maximum(fastest, np.hypot(*np.moveaxis(told.velocities, -1, 0)).max(axis=-1), out=fastest)
        worst = distance.max(axis=-1)
        out_at[worst >= TOLERANCE_M] = step * DT_S
        if step % 50 == 0 and (worst < 1e-2 * SETTLED_M).all():
            break
    reached = out_at < step * DT_S
    category = tuple(None if ok else kind for ok, kind in zip(reached, categories(platoons), strict=True))
    times = np.where(reached, out_at, math.nan)
    return Outcome(times, rise, settled_rise, farthest, fastest, nearest, category)


def _smallest(corners: Floats) -> Floats:
    """The smallest of p, q and the median through R1 of triangles (s, 3, 2), (s,) in m."""
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.min([np.hypot(d[:, 0], d[:, 1]) for d in (p, q, 0.5 * (p + q))], axis=0))


def categories(platoons: Platoons) -> list[Category]:
    """What each platoon is doing, as one that is not in formation.

    The first robot of the chain that is not at its place decides: if its triangle has no error and the other
    sequence, that is mirrored. A platoon moves if any robot is told more than 1 mm/s; it is thrown apart if
    any is farther from its place than three times the square they start in.
    """
    told = platoons.told(platoons.desired())
    distance = platoons.distances()
    triangle = np.maximum((distance > TOLERANCE_M).argmax(axis=-1) - 2, 0)[:, None]
    errors = np.take_along_axis(np.linalg.norm(told.errors, axis=-1), triangle, axis=-1)[:, 0]
    signed = Chain(platoons.places)
    turned = (
        signed.triangles(platoons.positions).variables()[..., 5] * signed.desired(ORIGIN, REST).q[:, 5] < 0
    )
    mirrored = (errors < TOLERANCE_M) & np.take_along_axis(turned, triangle, axis=-1)[:, 0]
    moving = np.hypot(*np.moveaxis(told.velocities, -1, 0)).max(axis=-1) > 1e-3
    far = distance.max(axis=-1) > 3.0 * side_m(platoons.case.n)
    return [_category(*each) for each in zip(mirrored, moving, far, strict=True)]


def _category(mirrored: bool, moving: bool, far: bool) -> Category:
    if mirrored:
        return "mirrored, moving" if moving else "mirrored, at rest"
    if far:
        return "thrown apart"
    return "under way" if moving else "at rest elsewhere"


def rises_in_fine_steps(case: Case, start: int) -> bool:
    """Whether V of the first triangle rises within FINE_S when the law is stepped a hundred times finer."""
    platoons = Platoons(case, starts(case, start + 1)[start:], headings(case, start + 1)[start:], FINE_DT_S)
    energy = math.inf
    for _ in range(round(FINE_S / FINE_DT_S)):
        error = platoons.step(platoons.desired()).errors[0, 0]
        before, energy = energy, 0.5 * float(error @ error)
        if energy > before + RISE:
            return True
    return False


def bound(circle: Circle, first: int, count: int, duration_s: float) -> Bound:
    """Pioneers that start near their places and follow a reference round a circle.

    delta_v is what eq. (8) has, averaged over a control period: q_ref' less how q really changed.
    """
    n = circle.n
    rng = stream(SEED, f"evidence/bound/{n}")
    off = rng.uniform(-SCATTER_M, SCATTER_M, (first + count, n, 2))[first:]
    facing = rng.uniform(-FACING_RAD, FACING_RAD, (first + count, n))[first:]
    platoons = Platoons(Case(n, pioneers=True), places(n) + off, facing)
    error, largest = np.zeros((count, n - 2)), np.zeros((count, n - 2))
    each = np.zeros((count, n - 2, 6))
    steps = round(duration_s / DT_S)
    for step in range(steps):
        before = platoons.chain.triangles(platoons.positions).variables()
        told = platoons.step(_on_circle(platoons, circle.speed_mps, step * DT_S))
        if step < steps // 2:
            continue
        change = platoons.chain.triangles(platoons.positions).variables() - before
        change[..., 2::3] = wrap_array(change[..., 2::3])
        rates = _on_circle(platoons, circle.speed_mps, (step + 0.5) * DT_S).rates
        delta = formation.law(rates, told.errors, platoons.gains) - change / DT_S
        np.maximum(error, np.linalg.norm(told.errors, axis=-1), out=error)
        np.maximum(largest, np.linalg.norm(delta, axis=-1), out=largest)
        np.maximum(each, np.abs(delta), out=each)
    return Bound(error, largest / KAPPA, np.linalg.norm(exact_bound(each), axis=-1))


def exact_bound(delta: Floats) -> Floats:
    """Where each component of eq. (8) comes to rest under a constant delta_v, in any shape: L tanh(L^-1 kappa
    e) = delta_v; infinite where delta_v is L or more."""
    share = np.abs(delta) / SATURATION
    out: Floats = np.full_like(share, math.inf)
    np.arctanh(share, out=out, where=share < 1.0)
    out *= SATURATION / KAPPA
    return out


def _on_circle(platoons: Platoons, speed_mps: float, t_s: float) -> Desired:
    angle = speed_mps / RADIUS_M * t_s
    c, s = math.cos(angle), math.sin(angle)
    return platoons.desired(
        Pose(RADIUS_M * s, RADIUS_M * (1.0 - c), 0.0), (speed_mps * c, speed_mps * s, 0.0)
    )


def pushed(n: int = PUSHED_OF, robot: int = PUSHED, push_m: float = PUSH_M) -> Spread:
    """Ideal robots stand in formation when one is pushed sideways: how far each gets from its place."""
    return Spread(*(_pushed(Case(n, neighbours=leaning), robot, push_m) for leaning in (False, True)))


def _pushed(case: Case, robot: int, push_m: float) -> Floats:
    positions = places(case.n)[None].copy()
    positions[0, robot, 1] += push_m
    platoons = Platoons(case, positions, np.zeros((1, case.n)))
    farthest: Floats = platoons.distances()[0]
    for _ in range(600):
        platoons.step(platoons.desired())
        np.maximum(farthest, platoons.distances()[0], out=farthest)
    return farthest


def trip(case: Case, start: int, supervised: bool, horizon_s: float = PASS_S) -> Trip:
    """One start of ideal points, with the supervisor of the controller after the law or without."""
    platoons = Platoons(case, starts(case, start + 1)[start:], headings(case, start + 1)[start:])
    supervisor = Supervisor(types.Supervisor(enabled=supervised), case.signed)
    nearest, fastest, time_s = math.inf, 0.0, 0.0
    for step in range(1, round(horizon_s / DT_S) + 1):
        nearest = min(nearest, float(_smallest(platoons.positions[:, :3])[0]))
        if platoons.distances()[0, :3].max() >= TOLERANCE_M:
            time_s = step * DT_S
        velocities = platoons.told(platoons.desired()).velocities[0]
        velocities = supervisor.step(platoons.positions[0], platoons.places, velocities).velocities
        fastest = max(fastest, float(np.hypot(*velocities[:3].T).max()))
        platoons.positions = platoons.positions + DT_S * velocities
    return Trip(nearest, fastest, time_s)


class _Job(NamedTuple):
    what: Case | Circle
    first: int
    starts: int
    duration_s: float


def study(extent: Extent, workers: int = 2) -> Study:
    """Compute everything; the result does not depend on `workers` (1: in this process)."""
    cases = [case for n in extent.sizes for case in variants(n)]
    scattered = [Case(extent.sizes[-1], scatter_m=scatter) for scatter in SCATTERS_M]
    circles = [Circle(n, speed) for n in extent.sizes for speed in SPEEDS_MPS]
    jobs = [
        _Job(what, first, min(CHUNK, extent.starts - first), duration_s)
        for group, duration_s in (((*cases, *scattered), extent.horizon_s), (circles, extent.bound_s))
        for what in group
        for first in range(0, extent.starts, CHUNK)
    ]
    jobs.sort(key=lambda job: -job.what.n)
    outcomes: dict[Case, list[Outcome]] = {}
    bounds: dict[Circle, list[Bound]] = {}
    for job, part in zip(jobs, _computed(jobs, workers), strict=True):
        if isinstance(part, Bound):
            bounds.setdefault(Circle(*job.what), []).append(part)
        else:
            outcomes.setdefault(Case(*job.what), []).append(part)
    joined = {case: _joined(outcomes[case]) for case in (*cases, *scattered)}
    risen = {n: (joined[Case(n)].rise[:, 0] > RISE).nonzero()[0].tolist() for n in extent.sizes}
    return Study(
        extent,
        {case: joined[case] for case in cases},
        {case: joined[case] for case in scattered},
        {n: sum(rises_in_fine_steps(Case(n), start) for start in risen[n]) for n in extent.sizes},
        {n: [(trip(Case(n), k, False), trip(Case(n), k, True)) for k in risen[n]] for n in extent.sizes},
        {circle: Bound(*map(np.concatenate, zip(*bounds[circle], strict=True))) for circle in circles},
        pushed(),
    )


def _computed(jobs: Sequence[_Job], workers: int) -> list[Outcome | Bound]:
    if workers == 1:
        return [_compute(job) for job in jobs]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        return list(pool.map(_compute, jobs))


def _compute(job: _Job) -> Outcome | Bound:
    if isinstance(job.what, Circle):
        return bound(job.what, job.first, job.starts, job.duration_s)
    return converge(job.what, job.first, job.starts, job.duration_s)


def _joined(parts: Sequence[Outcome]) -> Outcome:
    whole = {name: [getattr(part, name) for part in parts] for name in Outcome._fields}
    kinds = tuple(kind for part in whole.pop("category") for kind in part)
    return Outcome(**{name: np.concatenate(arrays) for name, arrays in whole.items()}, category=kinds)
