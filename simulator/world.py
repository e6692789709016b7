"""Obstacles and robots' outlines as arrays, in two forms.

`Shapes`, for distances between outlines: every thing is made of rounded rectangles (a circle is a point
with a radius, a wall or a polygon's edge a rectangle without width).

`Scene`, for range finders: circles and segments. Points are complex numbers x + iy, m, world frame.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maniple.core.geometry import Floats
from maniple.core.scenario import outline
from maniple.core.scenario.types import Box, Circle, Obstacle, Point, Polygon, RobotModel, Wall

Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]


class Shapes(NamedTuple):
    """m rectangles, each grown by a radius."""

    centre: Complexes
    """m, shape (m,)."""
    heading: Floats
    """rad, shape (m,)."""
    half: Complexes
    """Half length + i half width, m, shape (m,)."""
    radius: Floats
    """m, shape (m,)."""
    thing: Ints
    """Index of the obstacle each belongs to, shape (m,)."""


def shapes_of(obstacles: Sequence[Obstacle]) -> Shapes:
    """The obstacles as rounded rectangles; of a polygon only the edges."""
    rows: list[tuple[float, ...]] = []
    for index, obstacle in enumerate(obstacles):
        if isinstance(obstacle, Circle):
            rows.append((*obstacle.centre, 0.0, 0.0, 0.0, obstacle.radius_m, index))
        elif isinstance(obstacle, Box):
            length, width = obstacle.size
            rows.append((*obstacle.centre, obstacle.angle_rad, 0.5 * length, 0.5 * width, 0.0, index))
        else:
            corners = corners_of(obstacle)
            ends = np.roll(corners, -1) if isinstance(obstacle, Polygon) else corners[1:]
            for a, b in zip(corners.tolist(), ends.tolist(), strict=False):
                middle, along = 0.5 * (a + b), b - a
                heading = math.atan2(along.imag, along.real)
                rows.append((middle.real, middle.imag, heading, 0.5 * abs(along), 0.0, 0.0, index))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    return Shapes(
        centre=table[0] + 1j * table[1],
        heading=table[2],
        half=table[3] + 1j * table[4],
        radius=table[5],
        thing=table[6].astype(np.int64),
    )


def corners_of(obstacle: Box | Polygon | Wall) -> Complexes:
    """Corners of a box or polygon, counter-clockwise; the two ends of a wall."""
    points = outline.corners_of(obstacle)
    clockwise = isinstance(obstacle, Polygon) and outline.area(points) < 0.0
    return _complex(points[::-1] if clockwise else points)


def rectangle(length: float, width: float) -> Complexes:
    """Corners of a rectangle about the origin, counter-clockwise, shape (4,)."""
    return _complex(outline.rectangle((0.0, 0.0, 0.0), length, width))


def _complex(points: Sequence[Point]) -> Complexes:
    return np.array([complex(*point) for point in points])


def outlines(models: Sequence[RobotModel]) -> Complexes:
    """Half length + i half width of each robot's body, m, shape (n,)."""
    return np.array([complex(0.5 * m.length_m, 0.5 * m.width_m) for m in models])


def centres(position: Complexes, heading: Floats, offset: Floats) -> Complexes:
    """The middles of the bodies of robots at `position` (m) and `heading` (rad), shape (..., n), whose bodies
    are `offset` (m, shape (n,)) ahead of their axles."""
    return position + offset * np.exp(1j * heading) if offset.any() else position


class Scene:
    """What beams can hit: circles, walls, and solids (boxes, polygons, robots) of directed edges.

    An edge runs from `middle - half` to `middle + half`; edges of solids run counter-clockwise around
    them. Every edge belongs to a shape: a solid or a wall. The robots are the last n shapes and their
    edges the last 4 n.

    Args:
        obstacles: what stands in the world.
        bodies: half length + i half width of each robot, m, shape (n,).
    """

    def __init__(self, obstacles: Sequence[Obstacle], bodies: Complexes) -> None:
        circles = [o for o in obstacles if isinstance(o, Circle)]
        self.circles: Complexes = np.array([complex(*o.centre) for o in circles], dtype=np.complex128)
        self.radii: Floats = np.array([o.radius_m for o in circles], dtype=np.float64)

        edged = [o for o in obstacles if not isinstance(o, Circle)]
        starts, ends, sizes, centres, bounds = [], [], [], [], []
        for obstacle in edged:
            corners = corners_of(obstacle)
            wall = isinstance(obstacle, Wall)
            starts.append(corners[:1] if wall else corners)
            ends.append(corners[1:] if wall else np.roll(corners, -1))
            sizes.append(len(starts[-1]))
            centre = complex(corners.mean())
            centres.append(centre)
            bounds.append(float(abs(corners - centre).max()))

        count = len(bodies)
        corners = np.array([rectangle(2 * body.real, 2 * body.imag) for body in bodies.tolist()]).reshape(
            -1, 4
        )
        following = np.roll(corners, -1, axis=1)
        self._body_middle: Complexes = 0.5 * (corners + following)
        self._body_half: Complexes = 0.5 * (following - corners)

        start = np.concatenate([*starts, corners.ravel()])
        end = np.concatenate([*ends, following.ravel()])
        self.middle: Complexes = 0.5 * (start + end)
        self.half: Complexes = 0.5 * (end - start)
        self.shape: Ints = np.repeat(np.arange(len(edged) + count), [*sizes, *[4] * count])
        walls = [isinstance(o, Wall) for o in edged]
        self.wall: NDArray[np.bool_] = np.array([*walls, *[False] * count], dtype=np.bool_)[self.shape]
        self.centre: Complexes = np.array([*centres, *[0j] * count], dtype=np.complex128)
        self.bound: Floats = np.concatenate([bounds, np.abs(bodies)])
        self.first_robot: int = len(edged)

    def place(self, position: Complexes, heading: Floats) -> None:
        """Put the middles of the robots' outlines at `position` and turn them to `heading` (rad), both of
        shape (n,)."""
        count = len(position)
        turn = np.exp(1j * heading)[:, None]
        self.middle[-4 * count :].reshape(count, 4)[:] = self._body_middle * turn + position[:, None]
        self.half[-4 * count :].reshape(count, 4)[:] = self._body_half * turn
        self.centre[self.first_robot :] = position
