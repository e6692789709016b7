"""Three robots as one triangle: q = f(x), its inverse and its Jacobian, eqs. (3) to (6).

Arrays hold m triangles: positions (m, 3, 2) of R1, R2, R3 in m, and

    q = [x_F, y_F, psi_F, p, q, beta]                                             (m, 6)

with the centroid (x_F, y_F) in m, its orientation psi_F from the midpoint of R2 R3 to R1, clockwise from +y
(the only angle of the package that is not counter-clockwise from +x), the sides p = |R1 R2| and q = |R1 R3|
in m, and the angle beta from R1 R2 to R1 R3, counter-clockwise in [-pi, pi]. Its sign is the sequence of the
robots: beta > 0 is ABC, eq. (5); beta < 0 is ACB, eq. (6). With `signed=False` beta is the printed arccos of
eq. (4), in [0, pi], the same for a triangle and its mirror image. Axes before m are kept as they are.

Inside, a point is the complex number x + iy, so that a rotation is a product.
"""

import cmath

import numpy as np
from numpy.typing import NDArray

from maniple.core.geometry import Floats, Pose

_NEAR_M = 0.02
"""Lengths are divided by no less than this: velocities stay finite where the Jacobian is singular, and a
platoon that passes there at 10 Hz is not flung away."""


class Triangles:
    """Triangles at `positions` (m, 3, 2): what `f` and the inverse Jacobian have in common, once."""

    __slots__ = ("_beta", "_first", "_lengths", "_signed", "_vectors")

    def __init__(self, positions: Floats, signed: bool = True) -> None:
        corners = as_complex(positions)[..., 0]
        self._first = corners[..., 0]
        vectors = np.empty((3, *self._first.shape), dtype=np.complex128)
        d2, d3, median = vectors
        np.subtract(corners[..., 1], self._first, out=d2)
        np.subtract(corners[..., 2], self._first, out=d3)
        np.add(d2, d3, out=median)
        median *= -0.5
        turn = d2.conj() * d3
        self._vectors = vectors
        self._lengths = np.abs(vectors)
        self._beta = np.arctan2(turn.imag, turn.real)
        self._signed = signed

    def variables(self) -> Floats:
        """q of every triangle, (m, 6): eqs. (3) and (4)."""
        _, _, median = self._vectors
        out = np.empty((*median.shape, 6))
        np.subtract(self._first, median * (2 / 3), out=as_complex(out)[..., 0])
        np.arctan2(median.real, median.imag, out=out[..., 2])
        out[..., 3] = self._lengths[0]
        out[..., 4] = self._lengths[1]
        out[..., 5] = self._beta if self._signed else np.abs(self._beta)
        return out

    def velocities(self, rates: Floats) -> Floats:
        """J^-1 applied to the rates q' (m, 6) in m/s and rad/s: the robots' velocities (m, 3, 2) in m/s.

        With the sides d2 = R2 - R1 and d3 = R3 - R1, d2'/d2 = p'/p + i phi' and
        d3'/d3 = q'/q + i (phi' + beta'), where phi', the turning of d2, is what makes the median
        m = -(d2 + d3)/2 turn counter-clockwise at -psi_F'.
        Unsigned, this is the inverse Jacobian of the sequence that each triangle has now.
        """
        sides, median = self._vectors[:2], self._vectors[2]
        p, q, height = np.maximum(self._lengths, _NEAR_M)
        growth = np.zeros(sides.shape, dtype=np.complex128)
        np.divide(rates[..., 3], p, out=growth.real[0])
        np.divide(rates[..., 4], q, out=growth.real[1])
        growth.imag[1] = rates[..., 5] if self._signed else np.copysign(1.0, self._beta) * rates[..., 5]
        moved = sides * growth
        growth_m = (moved[0] + moved[1]) * median.conj() / (-2.0 * height * height)
        turning = 1j * (growth_m.imag + rates[..., 2])
        growth -= turning
        growth_m -= turning
        growth *= sides
        growth_m *= median
        out = np.empty((*median.shape, 3), dtype=np.complex128)
        first = as_complex(rates)[..., 0] + growth_m * (2 / 3)
        out[..., 0] = first
        np.add(first, growth[0], out=out[..., 1])
        np.add(first, growth[1], out=out[..., 2])
        return out.view(np.float64).reshape(*out.shape, 2)


def f(positions: Floats, signed: bool = True) -> Floats:
    """q (m, 6) of the triangles at `positions` (m, 3, 2): eqs. (3) and (4)."""
    return Triangles(positions, signed).variables()


def f_inverse(q: Floats) -> Floats:
    """Positions (m, 3, 2) of the triangles `q` (m, 6): eq. (5) where beta >= 0, else eq. (6).

    One formula serves both: the angle alpha from R1 R2 to the median through R1 takes the sign of beta.
    """
    x, y, psi, p, q_side, beta = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    along, across = p + q_side * np.cos(beta), q_side * np.sin(beta)
    alpha = np.arctan2(across, along)
    to_first = np.hypot(along, across) / 3.0
    x1, y1 = x + to_first * np.sin(psi), y + to_first * np.cos(psi)
    x2, y2 = x1 - p * np.sin(alpha + psi), y1 - p * np.cos(alpha + psi)
    x3, y3 = x1 + q_side * np.sin(beta - alpha - psi), y1 - q_side * np.cos(beta - alpha - psi)
    flat = np.stack([x1, y1, x2, y2, x3, y3], axis=-1)
    return flat.reshape(*flat.shape[:-1], 3, 2)


def jacobian(positions: Floats, signed: bool = True) -> Floats:
    """dq/dx (m, 6, 6), with x = [x1, y1, x2, y2, x3, y3]: each row the gradient of one of the six.

    Singular where R1 and another coincide (p = 0 or q = 0) and where R1 is exactly midway between R2 and R3;
    not for other robots in a line. This is the readable form; `apply_inverse_jacobian` is the fast one.
    """
    r1, r2, r3 = np.moveaxis(np.asarray(positions, dtype=np.float64), -2, 0)
    d2, d3 = r2 - r1, r3 - r1
    median = -0.5 * (d2 + d3)
    p, q = np.linalg.norm(d2, axis=-1), np.linalg.norm(d3, axis=-1)
    toward2, toward3 = d2 / p[..., None], d3 / q[..., None]
    turn2, turn3 = _gradient_of_direction(d2), _gradient_of_direction(d3)
    psi = -_gradient_of_direction(median)
    sign = 1.0 if signed else np.copysign(1.0, d2[..., 0] * d3[..., 1] - d2[..., 1] * d3[..., 0])[..., None]
    out = np.zeros((*p.shape, 6, 6))
    out[..., 0, 0::2] = 1 / 3
    out[..., 1, 1::2] = 1 / 3
    out[..., 2, :] = np.concatenate([psi, -0.5 * psi, -0.5 * psi], axis=-1)
    out[..., 3, 0:2], out[..., 3, 2:4] = -toward2, toward2
    out[..., 4, 0:2], out[..., 4, 4:6] = -toward3, toward3
    out[..., 5, :] = np.concatenate([sign * (turn2 - turn3), -sign * turn2, sign * turn3], axis=-1)
    return out


def apply_inverse_jacobian(positions: Floats, rates: Floats, signed: bool = True) -> Floats:
    """Velocities (m, 3, 2) in m/s that change q at `rates` (m, 6): the inverse Jacobian, never built.

    Within 2 cm of where that is singular (see `jacobian`) the result is finite but not exact.
    """
    return Triangles(positions, signed).velocities(rates)


def carried(q: Floats, frame: Pose, velocity: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """q and q', both (m, 6), of triangles that are `q` in a frame that carries them along.

    The frame is at `frame` and moves at `velocity` (m/s, m/s, rad/s counter-clockwise).
    """
    vx, vy, turning = velocity
    arms = as_complex(q)[:, 0] * cmath.rect(1.0, frame.psi)
    out = q.copy()
    as_complex(out)[:, 0] = arms + complex(frame.x, frame.y)
    out[:, 2] -= frame.psi
    rates = np.zeros_like(q)
    as_complex(rates)[:, 0] = arms * complex(0.0, turning) + complex(vx, vy)
    rates[:, 2] = -turning
    return out, rates


def as_complex(values: Floats) -> NDArray[np.complex128]:
    """Neighbours along the last axis as x + iy: (..., k) -> (..., k / 2), a view where that is possible."""
    if values.dtype != np.float64 or values.strides[-1] != values.itemsize:
        values = np.ascontiguousarray(values, dtype=np.float64)
    return values.view(np.complex128)


def _gradient_of_direction(d: Floats) -> Floats:
    """Gradient of the counter-clockwise direction of `d` (..., 2) in d."""
    perpendicular = np.stack([-d[..., 1], d[..., 0]], axis=-1)
    return np.asarray(perpendicular / np.sum(d * d, axis=-1, keepdims=True))
