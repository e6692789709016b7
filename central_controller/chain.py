"""The chain of triangles: triangle j is robots j, j+1 and j+2 of the platoon's order.

Triangle 0 commands its three robots, every later triangle only its third: n robots take n - 2 triangles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from central_controller.triangle import Triangles, as_complex, carried, f
from maniple.core.geometry import Floats, Pose


class Desired(NamedTuple):
    """Where the triangles are to be and how that changes, each (n - 2, 6)."""

    q: Floats
    rates: Floats


class Chain:
    """The triangles of a platoon.

    `points` is the desired formation, (n, 2) in m in the formation's own frame; `signed` chooses the shape
    angle, see `central_controller.triangle`. With `neighbours` the desired pose of the triangles after the
    first is built on the two robots they share with the one before, wherever these are; else it is the one
    the triangle has in the desired formation.
    """

    def __init__(
        self, points: Sequence[tuple[float, float]] | Floats, signed: bool = True, neighbours: bool = False
    ) -> None:
        self.points: Floats = np.array(points, dtype=np.float64)
        self._signed = signed
        self._neighbours = neighbours
        self._own = f(_windows(self.points), signed)

    def desired(
        self, reference: Pose, velocity: tuple[float, float, float], positions: Floats | None = None
    ) -> Desired:
        """q_des and q_des' of every triangle when the formation's frame, a rigid body, is at `reference` and
        moves at `velocity` (m/s, m/s, rad/s counter-clockwise). With "neighbours" the control points are now
        at `positions`, (n, 2)."""
        desired = Desired(*carried(self._own, reference, velocity))
        if self._neighbours and positions is not None:
            _lean_on_neighbours(desired, reference, velocity, positions, self._signed)
        return desired

    def triangles(self, positions: Floats) -> Triangles:
        """The triangles of control points at `positions`, (..., n, 2)."""
        return Triangles(_windows(positions), self._signed)

    def select(self, velocities: Floats) -> Floats:
        """What each robot is told, (..., n, 2), of what the triangles want of theirs, (..., n - 2, 3, 2)."""
        return np.concatenate([velocities[..., 0, :2, :], velocities[..., 2, :]], axis=-2)


def _lean_on_neighbours(
    desired: Desired,
    reference: Pose,
    velocity: tuple[float, float, float],
    positions: Floats,
    signed: bool,
) -> None:
    """Put the desired triangles after the first on their first two robots, at `positions` (n, 2), in place.

    The third robot's place has the desired q and beta; p is what it is. The frame carries the triangle.
    """
    corners = np.ascontiguousarray(positions, dtype=np.float64).view(np.complex128)[:, 0]
    first, second = corners[1:-2], corners[2:-1]
    side = second - first
    length = np.maximum(np.abs(side), 1e-9)
    beta = desired.q[1:, 5]
    if not signed:  # on the side where the third robot is now
        across = (side.conj() * (corners[3:] - first)).imag
        beta = np.copysign(beta, across)
    third = first + desired.q[1:, 4] * np.exp(1j * beta) * side / length
    q = f(np.stack([_as_points(first), _as_points(second), _as_points(third)], axis=1), signed)
    desired.q[1:, :4] = q[:, :4]
    arms = as_complex(q)[:, 0] - complex(reference.x, reference.y)
    as_complex(desired.rates)[1:, 0] = arms * complex(0.0, velocity[2]) + complex(velocity[0], velocity[1])
    desired.rates[1:, 2] = -velocity[2]
    desired.rates[1:, 3] = 0.0


def _as_points(values: np.ndarray[tuple[int, ...], np.dtype[np.complex128]]) -> Floats:
    """x + iy (k,) as points (k, 2)."""
    return np.ascontiguousarray(values).view(np.float64).reshape(-1, 2)


def _windows(points: Floats) -> Floats:
    """Points (..., n, 2) as triangles (..., n - 2, 3, 2): an overlapping view, only to be read."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    *batch, n, _ = points.shape
    step = points.strides[-2:]
    return np.ndarray((*batch, n - 2, 3, 2), buffer=points, strides=(*points.strides[:-1], *step))
