"""Many platoons of control points under the formation law, all as one array: no messages, ranges, guard or
supervisor. They are told their velocities ten times a second."""

import math
from typing import NamedTuple

import numpy as np

from central_controller import formation, planning
from central_controller.chain import Chain, Desired
from central_controller.formation import Correction, Gains
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Controller
from maniple.core.streams import stream
from simulator.dynamics import VelocityDynamics, integrate

SEED = 1
KAPPA, SATURATION = 0.25, 0.10
"""The paper's gains."""
SLOW = (0.10, 0.10, 0.02, 0.10, 0.10, 0.02)
"""L with smaller entries for psi_F and beta, rad/s."""
DT_S = 0.1
"""Control period."""

THETA = (0.2604, 0.2509, -0.000499, 0.9965, 0.00263, 1.0768)
"""Pioneer 3-DX with SICK laser (catalogue entry pioneer-3dx), as its limits are."""
U_MAX, W_MAX = 0.75, 1.745
CONTROL_POINT_M = 0.2
SUBSTEPS = 2
"""Steps of the velocity dynamics in a control period."""

ORIGIN, REST = Pose(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


class Case(NamedTuple):
    """What a set of platoons is, and how it starts."""

    n: int
    signed: bool = True
    neighbours: bool = False
    assigned: bool = False
    """Whether the robots are labelled so that the sum of the squared ways is least."""
    slow_angles: bool = False
    """Whether L is SLOW."""
    pioneers: bool = False
    """Unicycles with the velocity dynamics and limits of a Pioneer 3-DX, instead of ideal points."""
    scatter_m: float | None = None
    """Each starts off its place by up to this much along x and along y, instead of anywhere."""

    @property
    def variant(self) -> str:
        """All but n, in words."""
        words = ["signed" if self.signed else "printed"]
        flags = ("neighbours", "assigned", "slow_angles", "pioneers")
        words += [flag.replace("_", " ") for flag in flags if getattr(self, flag)]
        return ", ".join(words)


def places(n: int) -> Floats:
    """The desired formation: triangles in a column, two abreast, (n, 2) in m, its centroid at the origin."""
    rank = np.arange(n)
    points = np.column_stack([-0.8 * rank, np.where(rank % 2, -0.6, 0.6)])
    return np.asarray(points - points.mean(axis=0))


def side_m(n: int) -> float:
    """Of the square in which robots start: 6 m, and for more than six robots as many to a square metre."""
    return 6.0 * max(1.0, math.sqrt(n / 6.0))


def starts(case: Case, count: int) -> Floats:
    """Random control points, (count, n, 2) in m; the first `count` of any larger number."""
    n, where = case.n, places(case.n)
    if case.scatter_m is not None:
        off = stream(SEED, f"evidence/scatter/{n}").uniform(-1.0, 1.0, size=(count, n, 2))
        return where + case.scatter_m * off
    half = 0.5 * side_m(n)
    points = stream(SEED, f"evidence/start/{n}").uniform(-half, half, size=(count, n, 2))
    if not case.assigned:
        return points
    return np.stack([each[list(planning.optimal(each, where))] for each in points])


def headings(case: Case, count: int) -> Floats:
    """Random headings, (count, n) in rad; the first `count` of any larger number."""
    draws = stream(SEED, f"evidence/heading/{case.n}").uniform(-math.pi, math.pi, size=(count, case.n))
    return np.asarray(draws)


class Platoons:
    """Platoons of one case that move under the law, each on its own.

    `positions` are their control points, (s, n, 2) in m; `facing`, (s, n) in rad, are the headings of
    Pioneers. Ideal points keep the velocity they are told for `dt_s`.
    """

    def __init__(self, case: Case, positions: Floats, facing: Floats, dt_s: float = DT_S) -> None:
        count, n, _ = positions.shape
        self.case, self.positions, self.places = case, positions, places(n)
        self.chain = Chain(self.places, case.signed)
        self.gains = Gains.of(Controller(kappa=KAPPA, saturation=SLOW if case.slow_angles else SATURATION))
        self._dt_s = dt_s
        self._all = Chain(np.tile(self.places, (count, 1)), case.signed, neighbours=True)
        self._robots = _Pioneers(positions, facing, dt_s) if case.pioneers else None

    def desired(self, pose: Pose = ORIGIN, velocity: tuple[float, float, float] = REST) -> Desired:
        """q_des and q_des', (n - 2, 6), or with neighbours (s, n - 2, 6)."""
        own = self.chain.desired(pose, velocity)
        if not self.case.neighbours:
            return own
        # One chain over the robots of all platoons; the triangles across two platoons are dropped.
        leaning = self._all.desired(pose, velocity, self.positions.reshape(-1, 2))
        return Desired(*(self._parted(every, first) for every, first in zip(leaning, own, strict=True)))

    def _parted(self, every: Floats, first: Floats) -> Floats:
        count, n, _ = self.positions.shape
        out = np.concatenate([every, every[:2]]).reshape(count, n, 6)[:, : n - 2].copy()
        out[:, 0] = first[0]
        return out

    def told(self, desired: Desired) -> Correction:
        """What the law makes of where the robots are now."""
        return formation.step(self.chain, self.gains, self.positions, desired)

    def step(self, desired: Desired) -> Correction:
        """Tell every robot its velocity and let it move for one period."""
        told = self.told(desired)
        if self._robots is None:
            self.positions = self.positions + self._dt_s * told.velocities
        else:
            self.positions = self._robots.move(told.velocities)
        return told

    def distances(self) -> Floats:
        """Of every control point from its place in the formation at the origin, (s, n) in m."""
        return np.asarray(np.hypot(*np.moveaxis(self.positions - self.places, -1, 0)))


class _Pioneers:
    """Differential-drive robots all at once: eq. (2), the drives' limits, Martins et al. 2008."""

    def __init__(self, positions: Floats, facing: Floats, dt_s: float) -> None:
        self._shape = positions.shape
        self._step_s = dt_s / SUBSTEPS
        self._dynamics = VelocityDynamics([THETA] * facing.size, self._step_s)
        self._velocity = np.zeros((2, facing.size))
        self._travel = np.stack([np.zeros(facing.size), facing.ravel()])
        self._axle = positions.reshape(-1, 2) @ [1, 1j] - CONTROL_POINT_M * np.exp(1j * self._travel[1])

    def move(self, velocities: Floats) -> Floats:
        """Where the control points are, (s, n, 2), a period after they were told (s, n, 2)."""
        own = velocities.reshape(-1, 2) @ [1, 1j] * np.exp(-1j * self._travel[1])
        u, w = np.clip(own.real, -U_MAX, U_MAX), np.clip(own.imag / CONTROL_POINT_M, -W_MAX, W_MAX)
        drive = self._dynamics.input_gain * np.stack([u, w])
        course = np.empty((SUBSTEPS + 1, *self._velocity.shape))
        course[0] = self._velocity
        for k in range(SUBSTEPS):
            self._dynamics.step(course[k], drive, course[k + 1])
        _, travels, axles = integrate(course, self._travel, self._axle, self._step_s)
        self._velocity, self._travel, self._axle = course[-1], travels[-1], axles[-1]
        points = self._axle + CONTROL_POINT_M * np.exp(1j * self._travel[1])
        return np.stack([points.real, points.imag], axis=-1).reshape(self._shape)
