"""Scattered robots build a formation: who takes which place, how far they go, and who runs into whom.

`python -m benchmarks.planning [--starts N]` prints the table of docs/planning.md. The robots are Pioneers
within the catalogue's limits whose drives follow with a first-order lag, guided at 10 Hz. Nothing stops them
when they meet: counted are the starts in which circles round two bodies, or the bodies, overlapped.
"""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from benchmarks.common import Budget, Row
from central_controller import formation, planning
from central_controller.chain import Chain
from central_controller.formation import Gains
from central_controller.planning import METHODS, Straight
from central_controller.reference import REST
from central_controller.supervisor import Supervisor, exchange
from maniple.cli.loading import completed
from maniple.control import guard
from maniple.control.avoidance import Impedances
from maniple.control.limits import Limits, Velocity, limits_of
from maniple.control.returns import Returns
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario import types
from maniple.core.scenario.shapes import points
from maniple.core.streams import stream

TITLE = "Building the formation"

STARTS, QUICK_STARTS = 200, 4
SIDES_M = {6: 6.0, 12: 8.0}
"""Of the square the robots start in, by their number."""
APART_M = 1.0
"""The least distance between the centres of two robots at the start."""
SPACING_M = 1.5
"""Of the column they build."""
SPEED_MPS = 0.20
DT_S = 0.1
SETTLE_S = 40.0
"""Given to late robots after the end of the straight lines."""
REACH_M = 1.5
"""Robots farther away than this, from centre to centre, matter to no layer."""
NOTHING = Returns(np.empty(0), np.empty(0), sees_ahead=True, sees_behind=False)
IN_THE_WAY_M = 1.1
"""Control points this near to each other belong to bodies that may touch."""
FORMED_M = 0.05
"""The formation stands when every control point is this near to its place."""


class Case(NamedTuple):
    """How a formation is built."""

    method: str
    exchanged: bool = False
    """Whether robots that would be in each other's way exchange their places first."""
    layered: bool = False
    """Whether avoidance and the guard's clearance rules are on."""
    build: Literal["straight", "law"] = "straight"
    """Along straight lines in step, or by the formation law and the supervisor."""


CASES = (
    *(Case(method) for method in METHODS),
    *(Case(method, exchanged=True) for method in METHODS if method != "optimal"),
    Case("optimal", build="law"),
    Case("optimal", layered=True),
)


class Outcome(NamedTuple):
    """What became of one start."""

    total_m: float
    longest_m: float
    formed_s: float
    """NaN if it was not."""
    circles_m: float
    """The least distance between the circles round two robots; negative where they overlapped."""
    bodies: bool
    """Whether two bodies overlapped."""


def platoon(n: int) -> types.Scenario:
    """n Pioneers at the places of a column."""
    return completed(
        types.Scenario(
            name="building",
            robots=tuple(types.Robot(id=f"r{k}") for k in range(n)),
            formation=types.Formation(points=points("column", n, SPACING_M)),
            task=types.Line(start=(0.0, 0.0), end=(5.0, 0.0), speed_mps=0.1),
        )
    )


def scattered(n: int, start: int) -> tuple[Floats, Floats]:
    """Centres (n, 2) and headings (n,) of robots in a square, each drawn clear of those before."""
    rng = stream(start, f"planning/{n}")
    centres: list[Floats] = []
    while len(centres) < n:
        centre = rng.uniform(-0.5 * SIDES_M[n], 0.5 * SIDES_M[n], 2)
        if all(math.dist(centre, other) > APART_M for other in centres):
            centres.append(centre)
    return np.array(centres), rng.uniform(-math.pi, math.pi, n)


def outcomes(n: int, case: Case, first: int, last: int) -> list[Outcome]:
    """What becomes of the starts from `first` up to before `last`, all at once."""
    scenario = platoon(n)
    places, a = np.array(scenario.formation.points), scenario.robots[0].control_point_m
    robots, ways, plans = [], [], []
    for start in range(first, last):
        centres, headings = scattered(n, start)
        heads = centres + a * np.column_stack([np.cos(headings), np.sin(headings)])
        order = planning.plan(METHODS[case.method], heads, places).order
        if case.exchanged:
            anyone = np.ones((n, n), dtype=bool)
            order = exchange(heads, places, order, anyone, IN_THE_WAY_M) or order
        who = list(order)
        robots.append(np.column_stack([centres, headings])[who])
        ways.append(Straight(heads[who], places, SPEED_MPS))
        plans.append(planning.plan(lambda positions, places: range(len(places)), heads[who], places))
    formed, circles, bodies = _simulate(scenario, np.array(robots), ways, places, case)
    return [
        Outcome(plan.total_m, plan.longest_m, *found)
        for plan, *found in zip(plans, formed.tolist(), circles.tolist(), bodies.tolist(), strict=True)
    ]


def _simulate(
    scenario: types.Scenario, poses: Floats, ways: list[Straight], places: Floats, case: Case
) -> tuple[Floats, Floats, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
    """Robots at `poses` (starts, n, 3) go to their places: when they had formed (s), how near their circles
    came (m), and whether bodies overlapped, each (starts,)."""
    count, n, _ = poses.shape
    robot, model = scenario.robots[0], scenario.model_of(scenario.robots[0])
    limits, gains, chain = limits_of(scenario, robot), Gains.of(scenario.controller), Chain(places)
    desired = chain.desired(Pose(0.0, 0.0, 0.0), REST)
    a, supervisors = robot.control_point_m, [Supervisor(scenario.supervisor) for _ in ways]
    keepers = [[_Keeper(scenario, limits) for _ in range(n)] for _ in ways] if case.layered else None
    told, moving = np.zeros((count, n, 2)), np.zeros((count, n, 2))
    formed = np.full(count, np.nan)
    circles, bodies = np.full(count, np.inf), np.zeros(count, dtype=bool)
    pairs = np.triu_indices(n, 1)
    for tick in range(round((max(way.duration_s for way in ways) + SETTLE_S) / DT_S)):
        psi = poses[..., 2]
        ahead = np.stack([np.cos(psi), np.sin(psi)], axis=-1)
        heads = poses[..., :2] + a * ahead
        formed = np.where(np.abs(heads - places).max(axis=(1, 2)) > FORMED_M, np.nan, formed)
        formed = np.where(
            np.isnan(formed) & (np.abs(heads - places).max(axis=(1, 2)) <= FORMED_M), tick * DT_S, formed
        )
        if case.build == "straight":
            at, speeds = (np.array(part) for part in zip(*(way.at(tick * DT_S) for way in ways), strict=True))
            wanted = planning.follow(at, speeds, heads, gains)
        else:
            wanted = formation.step(chain, gains, heads, desired).velocities
            pairs_of = zip(supervisors, heads, wanted, strict=True)
            wanted = np.array([guide.step(head, places, want).velocities for guide, head, want in pairs_of])
        u = (wanted * ahead).sum(axis=-1)
        w = (wanted[..., 1] * ahead[..., 0] - wanted[..., 0] * ahead[..., 1]) / a
        asked = np.stack([u, w], axis=-1)
        if keepers is None:
            top = np.array([limits.u_max, limits.w_max])
            gain = np.array([limits.u_accel, limits.w_accel]) * DT_S
            told = np.clip(np.clip(asked, -top, top), told - gain, told + gain)
        else:
            for s, row in enumerate(keepers):
                for k, keeper in enumerate(row):
                    told[s, k] = keeper.step(asked[s, k], poses[s], k, moving[s, k])
        lags = np.array([limits.u_lag_s, limits.w_lag_s])
        moving = told + (moving - told) * np.exp(-DT_S / lags)
        middle = psi + 0.5 * DT_S * moving[..., 1]
        poses[..., :2] += DT_S * moving[..., :1] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
        poses[..., 2] += DT_S * moving[..., 1]
        gap = np.linalg.norm(poses[:, pairs[0], :2] - poses[:, pairs[1], :2], axis=-1) - 2.0 * limits.radius
        circles = np.minimum(circles, gap.min(axis=1))
        for s, pair in zip(*(gap < 0.0).nonzero(), strict=True):
            bodies[s] |= _touch(poses[s, pairs[0][pair]], poses[s, pairs[1][pair]], model)
    return formed, circles, bodies


class _Keeper:
    """Avoidance and guard of one robot that sees the circles round the others in front of it."""

    def __init__(self, scenario: types.Scenario, limits: Limits) -> None:
        self._avoidance = Impedances(scenario.avoidance, scenario.model_of(scenario.robots[0]))
        self._guard, self._limits = scenario.guard, limits
        self._sent = Velocity()

    def step(self, asked: Floats, poses: Floats, own: int, moving: Floats) -> tuple[float, float]:
        """What is told to the drive of robot `own` instead of `asked`, both (u, w)."""
        seen = _seen(poses, own, self._limits.radius)
        avoiding = self._avoidance.step(Velocity(*asked.tolist()), seen, DT_S)
        verdict = guard.step(
            self._guard, self._limits, self._sent, avoiding, 0.0, seen, DT_S, Velocity(*moving.tolist())
        )
        self._sent = verdict.velocity
        return self._sent.u, self._sent.w


def _seen(poses: Floats, own: int, radius: float) -> Returns:
    """What a laser of 180 degrees sees of the circles round the other robots: five returns of each."""
    others = poses[:, :2] - poses[own, :2]
    distance = np.hypot(*others.T)
    near = (distance < REACH_M) & (distance > 0.0)
    if not near.any():
        return NOTHING
    distance = np.maximum(distance[near], radius + 1e-3)[:, None]
    bearing = np.arctan2(others[near, 1], others[near, 0])[:, None] - poses[own, 2]
    half = np.arcsin(radius / distance) * np.array([-0.98, -0.6, 0.0, 0.6, 0.98])
    ranges = distance * np.cos(half) - np.sqrt(np.maximum(radius**2 - (distance * np.sin(half)) ** 2, 0.0))
    bearings = np.remainder(bearing + half + math.pi, 2.0 * math.pi) - math.pi
    front = np.abs(bearings) <= 0.5 * math.pi
    return Returns(ranges[front], bearings[front], sees_ahead=True, sees_behind=False)


def _touch(first: Floats, second: Floats, model: types.RobotModel) -> bool:
    """Whether the bodies of two robots at these poses overlap: no side of either parts them."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (0.5 * model.length_m, 0.5 * model.width_m)
    boxes = []
    for x, y, psi in (first, second):
        turn = np.array([[math.cos(psi), -math.sin(psi)], [math.sin(psi), math.cos(psi)]])
        boxes.append((corners @ turn.T + (x, y), turn))
    for _, axes in boxes:
        a, b = (box @ axes for box, _ in boxes)
        if ((a.min(axis=0) > b.max(axis=0)) | (b.min(axis=0) > a.max(axis=0))).any():
            return False
    return True


def measured(n: int, case: Case, starts: int) -> list[Outcome]:
    """What becomes of that many starts, shared between two processes."""
    if starts < 2 * QUICK_STARTS:
        return outcomes(n, case, 0, starts)
    half = starts // 2
    with ProcessPoolExecutor(2) as pool:
        parts = pool.map(partial(outcomes, n, case), (0, half), (half, starts))
        return [outcome for part in parts for outcome in part]


def rows(quick: bool = False) -> list[Row]:
    """For each number of robots: the starts in which circles overlapped, and the sum of the ways, if places
    are given by least squares, against the user's own order."""
    starts = QUICK_STARTS if quick else STARTS
    found = []
    for n in SIDES_M:
        ours, reference = (measured(n, Case(method), starts) for method in ("optimal", "given"))
        of = f"of {starts}"
        hits = [sum(one.circles_m < 0.0 for one in side) for side in (ours, reference)]
        ways = [sum(one.total_m for one in side) / starts for side in (ours, reference)]
        found.append(Row(f"{n} robots, collisions", hits[0], of, "given order", hits[1], Budget(0, "ours")))
        found.append(Row(f"{n} robots, way of all", ways[0], "m", "given order", ways[1]))
    return found


HEADINGS = (
    "robots",
    "who takes which place",
    "how",
    "layers",
    "way of all",
    "longest",
    "formed in",
    "not formed",
    "circles met",
    "bodies met",
)


def lines(starts: int) -> Iterator[str]:
    """All cases as a Markdown table, line by line: mean ways, median times, and numbers of starts."""
    yield "| " + " | ".join(HEADINGS) + " |"
    yield "|" + "---|" * len(HEADINGS)
    for n in SIDES_M:
        for case in CASES:
            yield f"| {n} | " + " | ".join(_cells(case, measured(n, case, starts))) + " |"


def _cells(case: Case, found: Sequence[Outcome]) -> Iterator[str]:
    times = [one.formed_s for one in found if not math.isnan(one.formed_s)]
    yield case.method + ", then exchanges" * case.exchanged
    yield case.build
    yield "on" if case.layered else "off"
    yield f"{sum(one.total_m for one in found) / len(found):.1f} m"
    yield f"{sum(one.longest_m for one in found) / len(found):.1f} m"
    yield f"{np.median(times):.0f} s" if times else "-"
    yield str(len(found) - len(times))
    yield str(sum(one.circles_m < 0.0 for one in found))
    yield str(sum(one.bodies for one in found))


def main() -> None:
    """Print the table, and how long it took."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning", description=TITLE)
    parser.add_argument("--starts", type=int, default=STARTS, help="scattered starts of each case")
    begin = time.perf_counter()
    for line in lines(parser.parse_args().starts):
        print(line, flush=True)
    print(f"\n{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
