"""The task as a reference: where the formation's frame is to be at each moment, and how fast it moves."""

import math
from typing import NamedTuple

import numpy as np

from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.places import legs_of
from maniple.core.scenario.types import Controller, Leg, Positioning, Task
from maniple.core.scenario.ways import REST as REST
from maniple.core.scenario.ways import Velocity, way_of

LEAST_DISTANCE_M = 1.0
"""Robots that are to take up a position are thought to be at least this far from it."""


class Reference(NamedTuple):
    """The desired formation's frame in the formation frame."""

    pose: Pose
    velocity: Velocity
    """(m/s, m/s, rad/s counter-clockwise)."""


class Course:
    """What a task asks of the formation's frame, leg by leg: a sequence has several, any other task one.

    `controller` is the law that positioning is done by, of which it is estimated how long that takes.

    Raises:
        ScenarioError: the file of a leg has not been loaded.
    """

    def __init__(self, task: Task, controller: Controller | None = None) -> None:
        law = controller or Controller()
        legs = legs_of(task)
        self._tasks = legs
        self._ways = tuple(way_of(leg) for leg in legs)
        self._durations = tuple(
            _duration_s(leg, way.travel_s, law) for leg, way in zip(legs, self._ways, strict=True)
        )

    @property
    def legs(self) -> int:
        """How many parts the task has."""
        return len(self._ways)

    @property
    def total_s(self) -> float:
        """How long all legs take."""
        return math.fsum(self._durations)

    def duration_s(self, leg: int) -> float:
        """How long a leg takes: the way, and the rest at its end; an estimate for positioning."""
        return self._durations[leg]

    def at(self, leg: int, t_s: float) -> Reference:
        """The reference `t_s` after a leg began: before 0 at its start, after its way at its end, at rest in
        both."""
        way = self._ways[leg]
        if 0.0 <= t_s < way.travel_s:
            return Reference(*way.at(t_s))
        return Reference(way.at(0.0 if t_s < 0.0 else way.travel_s)[0], REST)

    def positioning(self, leg: int) -> Positioning | None:
        """The leg, where it is over by being reached and not after its duration; see `reached`."""
        task = self._tasks[leg]
        return task if isinstance(task, Positioning) else None


def reached(positioning: Positioning, errors: Floats) -> bool:
    """Whether the triangles with these errors, (m, 6), are where a leg of positioning wants them."""
    return within(errors, positioning.tolerance_m, positioning.tolerance_rad)


def within(errors: Floats, tolerance_m: float, tolerance_rad: float) -> bool:
    """Whether all errors (m, 6) of the triangles are within the tolerances: x, y, p and q in m, psi_F and
    beta in rad; never without a triangle."""
    off = np.abs(np.asarray(errors, dtype=np.float64).reshape(-1, 6))
    angles = off[:, [2, 5]] <= tolerance_rad
    lengths = off[:, [0, 1, 3, 4]] <= tolerance_m
    return len(off) > 0 and bool(angles.all() and lengths.all())


def _duration_s(leg: Leg, travel_s: float, law: Controller) -> float:
    if not isinstance(leg, Positioning):
        return travel_s + leg.settle_s
    (x0, y0, psi0), (x1, y1, psi1) = leg.start, leg.target
    off = max(math.hypot(x1 - x0, y1 - y0), LEAST_DISTANCE_M)
    turn = abs(math.remainder(psi1 - psi0, 2.0 * math.pi))
    kappa, saturation = _diagonal(law.kappa), _diagonal(law.saturation)
    moving = [_decay_s(off, leg.tolerance_m, kappa[k], saturation[k]) for k in (0, 1)]
    return max(*moving, _decay_s(turn, leg.tolerance_rad, kappa[2], saturation[2])) + leg.settle_s


def _diagonal(gain: float | tuple[float, ...]) -> tuple[float, ...]:
    return gain if isinstance(gain, tuple) else (gain,) * 6


def _decay_s(error: float, tolerance: float, kappa: float, saturation: float) -> float:
    """How long eq. (7), e' = -L tanh(kappa e / L), takes: sinh(kappa e / L) decays as exp(-kappa t)."""
    if error <= tolerance:
        return 0.0
    slope = kappa / saturation
    return (_log_sinh(slope * error) - _log_sinh(slope * tolerance)) / kappa


def _log_sinh(x: float) -> float:
    """log(sinh x) for x > 0, where sinh overflows too."""
    return x + math.log(-math.expm1(-2.0 * x)) - math.log(2.0)
