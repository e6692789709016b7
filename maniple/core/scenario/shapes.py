"""Named shapes of the formation: places for any number of robots, in the order of the triangle chain.

The order runs to and fro between two sides, so that every three places in succession make a triangle that
is not flat, and each triangle of the chain shares only an edge with the next: a strip without overlaps.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Formation, Point

LARGEST_STRIP = 15
"""Of a polygon with more corners the first triangle would be too flat to have its tip as R1."""


def pointed(formation: Formation, n: int) -> Formation:
    """The formation of `n` robots with its shape, if it is a named one, as points."""
    if formation.shape is None or formation.points:
        return formation
    return Formation(points=points(formation.shape.kind, n, formation.shape.spacing_m))


def points(kind: str, n: int, spacing_m: float) -> tuple[Point, ...]:
    """The places of `n` robots, (x forward, y left) in m around their centroid, in the order of the chain.

    `kind` is one of `SHAPES`. `spacing_m` is the distance between neighbours.

    Raises:
        ScenarioError: an unknown kind, less than three robots, or a spacing that is not positive.
    """
    if kind not in SHAPES:
        raise ScenarioError(f"formation.shape.kind = {kind!r}: must be one of {', '.join(SHAPES)}")
    if n < 3:
        raise ScenarioError(f"robots: there are {n}; must be at least 3, for one triangle")
    if not 0.0 < spacing_m < math.inf:
        raise ScenarioError(f"formation.shape.spacing_m = {spacing_m}: must be > 0")
    unit = SHAPES[kind](n)
    return tuple((x, y) for x, y in (spacing_m * (unit - unit.mean(axis=0))).tolist())


def column(n: int) -> Floats:
    """Equilateral triangles one behind the other: two files, each half a step behind the other."""
    rank = np.arange(n)
    return np.column_stack([-0.5 * rank, math.sqrt(0.1875) * np.where(rank % 2, -1.0, 1.0)])


def line_abreast(n: int) -> Floats:
    """Equilateral triangles side by side, from left to right: two ranks."""
    along, across = column(n).T
    return np.column_stack([across, along])


def vee(n: int) -> Floats:
    """One robot at the back and two arms from there, 45 degrees forward to the left and to the right."""
    rank = np.arange(n)
    out = math.sqrt(0.5) * ((rank + 1) // 2)
    return np.column_stack([out, np.where(rank % 2, out, -out)])


def wedge(n: int) -> Floats:
    """A vee turned round: one robot in front and two arms back from there."""
    return -vee(n)


def polygon(n: int) -> Floats:
    """The corners of a regular polygon, the first one in front.

    The first triangle has the height sin(pi / n). With more than `LARGEST_STRIP` corners its tip is not R1
    but R2, for R1 would be nearly midway between R2 and R3; then it overlaps the second one.
    """
    rank = np.arange(n)
    corner = np.where(rank % 2, (rank + 1) // 2, -(rank // 2))
    if n > LARGEST_STRIP:
        corner[:2] = corner[1::-1]
    angle = 2.0 * math.pi / n * corner
    return np.column_stack([np.cos(angle), np.sin(angle)]) / (2.0 * math.sin(math.pi / n))


SHAPES: Mapping[str, Callable[[int], Floats]] = {
    "line-abreast": line_abreast,
    "vee": vee,
    "wedge": wedge,
    "polygon": polygon,
    "column": column,
}
"""The places (n, 2) of every kind with neighbours 1 m apart, anywhere in the plane."""
