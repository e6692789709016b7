"""Plane geometry: angles, poses, frames. SI, radians, x forward/east, y left/north, counter-clockwise."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Pose(NamedTuple):
    """Position (m) and heading (rad, counter-clockwise from +x) of one frame in another."""

    x: float
    y: float
    psi: float

    def compose(self, child: "Pose") -> "Pose":
        """Pose of `child`, given in this frame, in the frame this pose is given in."""
        c, s = math.cos(self.psi), math.sin(self.psi)
        return Pose(
            self.x + c * child.x - s * child.y,
            self.y + s * child.x + c * child.y,
            wrap(self.psi + child.psi),
        )

    def inverse(self) -> "Pose":
        """Pose of the outer frame in this one: `p.compose(p.inverse())` is the identity."""
        c, s = math.cos(self.psi), math.sin(self.psi)
        return Pose(-c * self.x - s * self.y, s * self.x - c * self.y, wrap(-self.psi))

    def rotate(self, vx: float, vy: float) -> tuple[float, float]:
        """A free vector of this frame, seen in the outer frame."""
        c, s = math.cos(self.psi), math.sin(self.psi)
        return c * vx - s * vy, s * vx + c * vy

    def advance(self, forward: float, turn: float, left: float = 0.0) -> "Pose":
        """Pose after a way of `forward` and `left` (m) at constant velocities through the angle `turn` (rad),
        integrated exactly: an arc, whose chord points half of the turn aside."""
        half = 0.5 * turn
        shrink = math.sin(half) / half if abs(half) > 1e-9 else 1.0
        ahead, aside = shrink * forward, shrink * left
        c, s = math.cos(self.psi + half), math.sin(self.psi + half)
        return Pose(self.x + ahead * c - aside * s, self.y + ahead * s + aside * c, wrap(self.psi + turn))


def wrap(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = math.remainder(angle, 2 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def wrap_array(angles: Floats) -> Floats:
    """The same angles in (-pi, pi], any shape."""
    return np.asarray(np.pi - np.mod(np.pi - angles, 2 * np.pi))


def rotation(psi: float) -> Floats:
    """The (2, 2) matrix that turns a vector counter-clockwise by `psi` (rad)."""
    c, s = math.cos(psi), math.sin(psi)
    return np.array([[c, -s], [s, c]])
