"""Obstacle avoidance of one robot: virtual forces act on mechanical impedances, eqs. (9) to (14).

Where the paper is silent or contradicts itself: the force stays at F_max below d_min; it slows the robot
by F cos(beta), as the text describes, instead of the printed F sin(beta), which is nothing dead ahead; and
one object counts once, on the side of its nearest return, or what is dead ahead would push both ways.
"""

import math
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from maniple.control.limits import Velocity
from maniple.control.parts import refuse_options
from maniple.control.returns import Returns
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Avoidance, Impedance, RobotModel


class Force(NamedTuple):
    """The force on one side and the bearing of what causes it."""

    force: float
    bearing: float
    """rad."""


class Sides(NamedTuple):
    """The forces of one scan. The right is [-90, 0] degrees, the left (0, 90]."""

    right: Force
    left: Force


class AvoidanceState(NamedTuple):
    """State of both impedances: the corrections of eqs. (11) and (12), and their rates."""

    u_cor: float = 0.0
    """m/s."""
    u_rate: float = 0.0
    w_cor: float = 0.0
    """rad/s."""
    w_rate: float = 0.0


NO_FORCE = Force(0.0, 0.0)
CALM = Sides(NO_FORCE, NO_FORCE)
REST = AvoidanceState()

_FRONT = np.array([-0.5 * math.pi, math.nextafter(0.5 * math.pi, math.inf)])
"""Both ends of what counts, [-90, 90] degrees, as `searchsorted` needs them."""


class Impedances:
    """The layer "impedance": what is wanted minus u_cor and plus w_cor, eqs. (11) and (12)."""

    def __init__(self, parameters: Avoidance, _model: RobotModel) -> None:
        refuse_options(parameters.options)
        self._parameters = parameters
        self._state = REST
        self._returns: Returns | None = None
        self._sides = CALM

    @property
    def memory(self) -> tuple[float, ...]:
        """See `Remembering`: an `AvoidanceState`."""
        return () if self._state == REST else tuple(self._state)

    def recall(self, memory: tuple[float, ...]) -> None:
        """See `Remembering`."""
        u_cor, u_rate, w_cor, w_rate = memory or REST
        self._state = AvoidanceState(u_cor, u_rate, w_cor, w_rate)

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
        """See `AvoidanceLaw`. While nothing is known the corrections fade."""
        if returns is not self._returns:
            self._returns = returns
            self._sides = CALM if returns is None else forces(self._parameters, returns)
        self._state = step(self._parameters, self._state, self._sides, dt_s)
        u, w, v = wanted
        return Velocity(u - self._state.u_cor, w + self._state.w_cor, v)


def force(parameters: Avoidance, distance: float) -> float:
    """The virtual force at a distance (m), eq. (9), and F_max of eq. (10) nearer than d_min."""
    if distance > parameters.d_max_m:
        return 0.0
    depth = parameters.d_max_m - max(distance, parameters.d_min_m)
    return parameters.b * max(depth, 0.0) ** 2


def forces(parameters: Avoidance, returns: Returns) -> Sides:
    """The force on each side: that of the nearest object, or of the nearest return ("returns")."""
    distance, bearing = returns.distance, returns.bearing
    near = (distance <= parameters.d_max_m).nonzero()[0]
    if not near.size:
        return CALM
    near = near[bearing[near].argsort(kind="stable")]
    bearing = bearing[near]
    front = slice(*bearing.searchsorted(_FRONT))
    distance, bearing = distance[near[front]], bearing[front]
    if parameters.split == "objects":
        nearest = _nearest_of_objects(distance, bearing, parameters.gap_m)
    else:
        nearest = list(zip(distance.tolist(), bearing.tolist(), strict=True))
    return Sides(
        _strongest(parameters, [pair for pair in nearest if pair[1] <= 0.0]),
        _strongest(parameters, [pair for pair in nearest if pair[1] > 0.0]),
    )


def step(parameters: Avoidance, state: AvoidanceState, sides: Sides, dt_s: float) -> AvoidanceState:
    """Both impedances after `dt_s` under constant forces, eqs. (13) and (14), integrated exactly."""
    right, left = sides
    if state == REST and right.force == 0.0 == left.force:
        return state
    shape = math.cos if parameters.form == "cos" else math.sin
    linear = right.force * shape(right.bearing) + left.force * shape(left.bearing)
    angular = right.force - left.force
    return AvoidanceState(
        *respond(parameters.linear, state.u_cor, state.u_rate, linear, dt_s),
        *respond(parameters.angular, state.w_cor, state.w_rate, angular, dt_s),
    )


def respond(impedance: Impedance, x: float, rate: float, load: float, dt_s: float) -> tuple[float, float]:
    """x and x' of I x'' + B x' + K x = F after `dt_s` under the constant load F, exactly."""
    stiffness = impedance.stiffness
    xx, xv, vx, vv = transition(impedance.inertia, impedance.damping, stiffness, dt_s)
    settled = load / stiffness
    offset = x - settled
    return settled + xx * offset + xv * rate, vx * offset + vv * rate


@lru_cache(maxsize=64)
def transition(
    inertia: float, damping: float, stiffness: float, dt_s: float
) -> tuple[float, float, float, float]:
    """exp([[0, 1], [-K/I, -B/I]] dt) by rows, in closed form for every kind of damping."""
    decay = 0.5 * damping / inertia
    square = stiffness / inertia
    discriminant = decay * decay - square
    if discriminant > 0.0:
        spread = 2.0 * math.sqrt(discriminant)
        slow = math.exp(-square / (decay + 0.5 * spread) * dt_s)
        s = slow * -math.expm1(-spread * dt_s) / spread
        c = 0.5 * slow * (1.0 + math.exp(-spread * dt_s))
    else:
        omega = math.sqrt(-discriminant)
        fading = math.exp(-decay * dt_s)
        s = fading * (math.sin(omega * dt_s) / omega if omega > 0.0 else dt_s)
        c = fading * math.cos(omega * dt_s)
    return c + decay * s, s, -square * s, c - decay * s


def _nearest_of_objects(distance: Floats, bearing: Floats, gap: float) -> list[tuple[float, float]]:
    """(distance, bearing) of the nearest return of every object, objects parted by more than `gap`.

    Returns are in the order of their bearings. Of equally near ones the rightmost stands for the object.
    """
    if not distance.size:
        return []
    before, after = distance[:-1], distance[1:]
    steps = before * before + after * after - 2.0 * before * after * np.cos(bearing[1:] - bearing[:-1])
    ends = (steps > gap * gap).nonzero()[0] + 1
    edges = [0, *ends.tolist(), distance.size]
    picks = [a + int(distance[a:b].argmin()) for a, b in pairwise(edges)]
    return [(float(distance[k]), float(bearing[k])) for k in picks]


def _strongest(parameters: Avoidance, candidates: list[tuple[float, float]]) -> Force:
    if not candidates:
        return NO_FORCE
    distance, bearing = min(candidates)
    return Force(force(parameters, distance), bearing)
