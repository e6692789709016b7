"""The chain of triangles: triangle j is robots j, j+1 and j+2 of the platoon's order.

Triangle 0 commands its three robots, every later triangle only its third: n robots take n - 2 triangles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from central_controller.triangle import Triangles, carried, f
from maniple.core.geometry import Floats, Pose


class Desired(NamedTuple):
    """Where the triangles are to be and how that changes, each (n - 2, 6)."""

    q: Floats
    rates: Floats


class Chain:
    """The triangles of a platoon.

    `points` is the desired formation, (n, 2) in m in the formation's own frame; `signed` chooses the shape
    angle, see `central_controller.triangle`. The desired pose of every triangle is the one it has in the
    desired formation.
    """

    def __init__(self, points: Sequence[tuple[float, float]] | Floats, signed: bool = True) -> None:
        self._signed = signed
        self._own = f(_windows(np.asarray(points, dtype=np.float64)), signed)

    def desired(self, reference: Pose, velocity: tuple[float, float, float]) -> Desired:
        """q_des and q_des' of every triangle when the formation's frame, a rigid body, is at `reference` and
        moves at `velocity` (m/s, m/s, rad/s counter-clockwise)."""
        return Desired(*carried(self._own, reference, velocity))

    def triangles(self, positions: Floats) -> Triangles:
        """The triangles of control points at `positions`, (..., n, 2)."""
        return Triangles(_windows(positions), self._signed)

    def select(self, velocities: Floats) -> Floats:
        """What each robot is told, (..., n, 2), of what the triangles want of theirs, (..., n - 2, 3, 2)."""
        return np.concatenate([velocities[..., 0, :2, :], velocities[..., 2, :]], axis=-2)


def _windows(points: Floats) -> Floats:
    """Points (..., n, 2) as triangles (..., n - 2, 3, 2): an overlapping view, only to be read."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    *batch, n, _ = points.shape
    step = points.strides[-2:]
    return np.ndarray((*batch, n - 2, 3, 2), buffer=points, strides=(*points.strides[:-1], *step))
