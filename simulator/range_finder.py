"""Range finders: one windowed kernel over all sensors of a type.

Each object in range covers a sector, and so an interval of beam indices, known in closed form. The
intervals of all (sensor, object) pairs are expanded into one ragged list of (pair, beam), whose distances
are closed forms again. They are kept as nearness, 1 / distance: the nearest is the largest, and that of
an edge is a dot product.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maniple.core.geometry import Floats
from maniple.core.scenario.types import RangeFinder
from simulator.world import Complexes, Scene

Indices = NDArray[np.intp]

_EDGE = 1e-9
"""Beams that miss an object by less than this share of the increment count as hits."""
_THIN = 1e-12
"""Edges that span less than half this (m^2) with the origin are seen from their end, that is not at all."""


class Fan:
    """The beams of one type of range finder, in the sensor's frame, counter-clockwise.

    Fans of up to a full turn are possible: (beams - 1) * increment must not exceed 2 pi.
    """

    def __init__(self, sensor: RangeFinder) -> None:
        self.beams = sensor.beams
        self.range_max_m = sensor.range_max_m
        angles = sensor.first_angle_rad + sensor.increment_rad * np.arange(sensor.beams)
        self.cos: Floats = np.cos(angles)
        self.sin: Floats = np.sin(angles)
        self._first_rad = sensor.first_angle_rad
        self._per_rad = 1.0 / sensor.increment_rad
        span = (sensor.beams - 1) * sensor.increment_rad
        self._blind = max(2.0 * math.pi - span, 0.0)
        # What subtends less than the blind sector can't meet the fan at both of its ends.
        self.turns = 1 if self._blind >= math.pi - 1e-6 else 2

    def windows(self, lowest: Floats, width: Floats) -> tuple[Indices, Indices]:
        """First beam and number of beams of the sectors from `lowest` (rad, sensor's frame)
        counter-clockwise over `width` < pi, both of shape (p,). Each sector has `turns` windows, one after
        the other, shape (p * turns,)."""
        start = np.mod(lowest + (self._blind - self._first_rad), 2.0 * math.pi)
        start -= self._blind
        end = start + width
        if self.turns > 1:
            start = (start[:, None] - _TURNS).ravel()
            end = (end[:, None] - _TURNS).ravel()
        start *= self._per_rad
        start -= _EDGE
        end *= self._per_rad
        end += _EDGE
        first = np.maximum(np.ceil(start), 0.0)
        count = np.minimum(np.floor(end), self.beams - 1.0)
        count -= first
        count += 1.0
        return first.astype(np.intp), np.maximum(count, 0.0).astype(np.intp)


_TURNS = np.array([0.0, 2.0 * math.pi])


class Sectors(NamedTuple):
    """What p (sensor, object) pairs look like to the sensor, in its frame."""

    sensor: Indices
    """Row of the sensor."""
    lowest: Floats
    """Where the object begins, rad."""
    width: Floats
    """What it subtends, rad, less than pi."""
    vector: Complexes
    """Centre of a circle, m; of an edge, what gives the nearness (1/m) by a dot product with the beam."""


def sweep(fan: Fan, origin: Complexes, heading: Floats, own: Indices, scene: Scene) -> Floats:
    """True ranges of k sensors of one type.

    Args:
        fan: their beams.
        origin: where they are, world frame, m, shape (k,).
        heading: where they point, world frame, rad, shape (k,).
        own: index of the robot that carries each and is not seen by it, or -1; shape (k,).
        scene: what can be hit.

    Returns:
        Distances in m, shape (k, beams); 0 from inside a solid, `range_max_m` where nothing is hit.
    """
    turn = np.exp(-1j * heading)
    circles, power, in_circle = _circles(fan, origin, turn, scene)
    edges, in_solid = _edges(fan, origin, turn, own, scene)
    sensor = np.concatenate([circles.sensor, edges.sensor])
    vector = np.concatenate([circles.vector, edges.vector])
    first, count = fan.windows(
        np.concatenate([circles.lowest, edges.lowest]), np.concatenate([circles.width, edges.width])
    )
    pair, beam = _expand(first, count, fan.turns)
    nearness = fan.cos[beam] * vector.real[pair]
    nearness += fan.sin[beam] * vector.imag[pair]
    if len(power):
        hits = int(count[: len(power) * fan.turns].sum())
        along, product = nearness[:hits], power[pair[:hits]]
        half_chord = along * along
        half_chord -= product
        along += np.sqrt(np.maximum(half_chord, 0.0))
        along /= product  # the product of the distances to both intersections is the power of the origin

    furthest = 1.0 / fan.range_max_m
    best = np.full(len(origin) * fan.beams, furthest)
    np.maximum.at(best, beam + (sensor * fan.beams)[pair], nearness)
    nothing = best <= furthest
    ranges = np.reciprocal(best)
    ranges[nothing] = fan.range_max_m
    ranges = ranges.reshape(len(origin), fan.beams)
    ranges[in_circle] = 0.0
    ranges[in_solid] = 0.0
    return np.asarray(ranges)


def _circles(fan: Fan, origin: Complexes, turn: Complexes, scene: Scene) -> tuple[Sectors, Floats, Indices]:
    """The circles in range, the power of the origin with respect to each (m^2), and the sensors inside."""
    offset = scene.circles - origin[:, None]
    square = offset.real**2
    square += offset.imag**2
    sensor, circle = np.nonzero(square < (scene.radii + fan.range_max_m) ** 2)
    square = square[sensor, circle]
    radius = scene.radii[circle]
    power = square - radius * radius
    if len(power) and power.min() <= 0.0:
        outside = power > 0.0
        inside = sensor[~outside]
        sensor, circle, square, radius = sensor[outside], circle[outside], square[outside], radius[outside]
        power = power[outside]
    else:
        inside = sensor[:0]
    centre = offset[sensor, circle] * turn[sensor]
    half = np.arcsin(radius / np.sqrt(square))
    return Sectors(sensor, _angle(centre) - half, 2.0 * half, centre), power, inside


def _edges(
    fan: Fan, origin: Complexes, turn: Complexes, own: Indices, scene: Scene
) -> tuple[Sectors, Indices]:
    """The visible edges of walls, solids and other robots in range, and the sensors inside a solid."""
    offset = scene.centre - origin[:, None]
    square = offset.real**2
    square += offset.imag**2
    near = square < (scene.bound + fan.range_max_m) ** 2
    carried = np.flatnonzero(own >= 0)
    near[carried, own[carried] + scene.first_robot] = False
    sensor, edge = np.nonzero(near[:, scene.shape])
    rotation = turn[sensor]
    middle = (scene.middle[edge] - origin[sensor]) * rotation
    half = scene.half[edge] * rotation
    start = middle - half
    product = start.conj() * (middle + half)
    subtended = _angle(product)
    # The angles that the edges of a solid subtend add up to a full turn around what is inside.
    shapes = len(scene.bound)
    winding = np.bincount(sensor * shapes + scene.shape[edge], weights=subtended)
    inside = np.flatnonzero(winding > 1.5 * math.pi) // shapes

    # A solid's edge seen from outside runs clockwise; what runs counter-clockwise is behind another.
    area = product.imag
    seen = np.flatnonzero((area < -_THIN) | (scene.wall[edge] & (area > _THIN)))
    area, subtended, half = area[seen], subtended[seen], half[seen]
    lowest = _angle(start[seen])
    lowest += np.minimum(subtended, 0.0)
    # distance = cross(middle, half) / cross(beam, half), and area = 2 cross(middle, half)
    return Sectors(sensor[seen], lowest, np.abs(subtended), half * (-2j / area)), inside


def _expand(first: Indices, count: Indices, turns: int) -> tuple[Indices, Indices]:
    """Pair and beam of every beam of every window."""
    ends = count.cumsum()
    window = np.repeat(np.arange(len(count)), count)
    beam = np.arange(len(window))
    beam += (first - ends + count)[window]
    return (window if turns == 1 else window // turns), beam


def _angle(points: Complexes) -> Floats:
    return np.asarray(np.arctan2(points.imag, points.real))
