"""Adaptive dynamic compensation of one robot (Martins et al. 2008, doi 10.1016/j.conengprac.2008.03.004).

The drive follows a reference with dynamics of its own (see `RobotModel.theta`). The law inverts them with
parameters that it adapts; tilde is desired minus measured:

    s1 = u_d' + l_u tanh(k_u u~ / l_u)       s2 = w_d' + l_w tanh(k_w w~ / l_w)
    u_ref = th1 s1 + th4 u_d - th3 w w_d
    w_ref = th2 s2 + th6 w_d + th5 u w_d + th3 (u_d w - u w_d)
    th' = gamma r - sigma th
    r = [s1 u~, s2 w~, (u_d w - u w_d) w~ - w w_d u~, u_d u~, u w_d w~, w_d w~]

With the true parameters, and from u~ = w~ = 0, the drive follows u_d and w_d exactly. The sideways speed v of
a robot that has one is treated like u, without coupling.

What the paper leaves open: derivatives come from a filter, see `Derivative`; a parameter stays within a
factor of `SPREAD` of the model's, and th3 and th5, which may be of either sign, within `SPREAD` times the
model's either way, or `COUPLING`. Nothing is adapted, nor forgotten, while the error is not the parameters'
doing: while the robot is not told what the law gave (`free`), while that is more than its speed,
acceleration and steering limits let it do, and while it is to stand.
"""

import math
from typing import NamedTuple

from maniple.control.limits import Velocity, curvature_max
from maniple.control.parts import refuse_options
from maniple.core.scenario.types import Compensation, RobotModel, Six

SPREAD = 1.6
"""A parameter is adapted to at most this many times the model's, and at least its inverse. Enough for a model
that is wrong by a third. s1 u~ is a square but for u_d', so th1 and th2 only ever grow while errors last, and
the feedback k_u th1^ / th1 with them: at twice the true parameter the loop sampled at 0.1 s rings."""

COUPLING = 0.1
"""What th3 and th5 may be in any case, s m/rad^2 and s/m: a little more than any measured Pioneer's."""


class Derivative:
    """The derivative of a signal that is sampled, as a first-order lag sees it: d + tau d' = x'.

    Exact for a signal that is straight between its samples, whatever their distance. It lags `tau_s` behind
    the true derivative (2 % more when that is two samples), and amplifies an error of one sample by at most
    1 / tau_s, where the plain difference does by 1 / dt.
    """

    def __init__(self, tau_s: float) -> None:
        self._tau = tau_s
        self._last: float | None = None
        self._value = 0.0

    def step(self, x: float, dt_s: float) -> float:
        """The derivative after `dt_s`; with 0 it begins anew, from 0."""
        if dt_s <= 0.0 or self._last is None:
            self._value = 0.0
        else:
            self._value -= math.expm1(-dt_s / self._tau) * ((x - self._last) / dt_s - self._value)
        self._last = x
        return self._value


class Terms(NamedTuple):
    """What the law is made of at one moment."""

    desired: Velocity
    measured: Velocity
    corrected: Velocity
    """s1 and s2 (and that of v), m/s^2 and rad/s^2."""


def corrected(parameters: Compensation, desired: Velocity, measured: Velocity, rates: Velocity) -> Velocity:
    """s1, s2 and that of v, from the desired velocity and its derivative `rates`."""
    k_u, l_u, k_w, l_w = parameters.k_u, parameters.l_u, parameters.k_w, parameters.l_w
    return Velocity(
        rates.u + l_u * math.tanh(k_u * (desired.u - measured.u) / l_u),
        rates.w + l_w * math.tanh(k_w * (desired.w - measured.w) / l_w),
        rates.v + l_u * math.tanh(k_u * (desired.v - measured.v) / l_u),
    )


def reference(theta: tuple[float, ...], terms: Terms) -> Velocity:
    """What the drive is to be told: the inverse dynamics."""
    (u_d, w_d, v_d), (u, w, _), (s1, s2, s3) = terms
    th1, th2, th3, th4, th5, th6 = theta
    return Velocity(
        th1 * s1 + th4 * u_d - th3 * w * w_d,
        th2 * s2 + th6 * w_d + th5 * u * w_d + th3 * (u_d * w - u * w_d),
        th1 * s3 + th4 * v_d,
    )


def regressor(terms: Terms) -> Six:
    """r: which way the errors pull each parameter."""
    (u_d, w_d, v_d), (u, w, v), (s1, s2, s3) = terms
    du, dw, dv = u_d - u, w_d - w, v_d - v
    return (
        s1 * du + s3 * dv,
        s2 * dw,
        (u_d * w - u * w_d) * dw - w * w_d * du,
        u_d * du + v_d * dv,
        u * w_d * dw,
        w_d * dw,
    )


class Adaptive:
    """The layer "adaptive": the law above and its state."""

    def __init__(self, parameters: Compensation, model: RobotModel) -> None:
        refuse_options(parameters.options)
        self._parameters = parameters
        self._bounds = bounds(model.theta)
        self._theta = tuple(parameters.initial * th for th in model.theta)
        self._model = model
        self._told = Velocity()
        self._rates = tuple(Derivative(parameters.filter_s) for _ in Velocity())

    @property
    def parameters(self) -> tuple[float, ...]:
        """th1 .. th6 as they are now."""
        return self._theta

    def recall(self, parameters: tuple[float, ...]) -> None:
        """Go on with what was learnt.

        Raises:
            ValueError: there are not six of them.
        """
        self._theta = tuple(
            min(max(th, low), high) for th, (low, high) in zip(parameters, self._bounds, strict=True)
        )

    def step(self, desired: Velocity, measured: Velocity, free: bool, dt_s: float) -> Velocity:
        """See `CompensationLaw`."""
        rates = Velocity(*(d.step(x, dt_s) for d, x in zip(self._rates, desired, strict=True)))
        terms = Terms(desired, measured, corrected(self._parameters, desired, measured, rates))
        told = reference(self._theta, terms)
        if self._parameters.adapt and free and any(desired) and self._can(told, dt_s):
            self._adapt(regressor(terms), dt_s)
        self._told = told
        return told

    def _adapt(self, pull: Six, dt_s: float) -> None:
        """th' = gamma r - sigma th over `dt_s`, exact for a constant r."""
        p = self._parameters
        after = []
        for th, gamma, sigma, r, (low, high) in zip(
            self._theta, p.gamma, p.sigma, pull, self._bounds, strict=True
        ):
            lasting = -math.expm1(-sigma * dt_s) / sigma if sigma > 0.0 else dt_s
            after.append(min(max(th + lasting * (gamma * r - sigma * th), low), high))
        self._theta = tuple(after)

    def _can(self, told: Velocity, dt_s: float) -> bool:
        """Whether the robot can do what it is told after what it was told before."""
        model, before = self._model, self._told
        return (
            abs(told.u) <= model.u_max_mps
            and abs(told.w) <= model.w_max_radps
            and abs(told.v) <= (model.v_max_mps or 0.0)
            and (model.drive != "car" or abs(told.w) <= curvature_max(model) * abs(told.u))
            and abs(told.u - before.u) <= model.u_accel_mps2 * dt_s
            and abs(told.w - before.w) <= model.w_accel_radps2 * dt_s
            and abs(told.v - before.v) <= model.u_accel_mps2 * dt_s
        )


def bounds(theta: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """The least and the most that each parameter is adapted to."""
    th1, th2, th3, th4, th5, th6 = theta

    def positive(th: float) -> tuple[float, float]:
        return th / SPREAD, th * SPREAD

    def coupling(th: float) -> tuple[float, float]:
        most = max(SPREAD * abs(th), COUPLING)
        return -most, most

    return positive(th1), positive(th2), coupling(th3), positive(th4), coupling(th5), positive(th6)
