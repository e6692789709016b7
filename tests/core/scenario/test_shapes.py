import math
from itertools import combinations
from typing import get_args, get_type_hints

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapely import Polygon

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats
from maniple.core.scenario.shapes import LARGEST_STRIP, SHAPES, points
from maniple.core.scenario.types import Shape

SIZES = (3, 4, 5, 6, 7, 12, LARGEST_STRIP, LARGEST_STRIP + 1, 33, 50)


def triangles(places: Floats) -> Floats:
    return np.array([places[k : k + 3] for k in range(len(places) - 2)])


def test_every_kind_of_the_scenario_is_there() -> None:
    assert set(SHAPES) == set(get_args(get_type_hints(Shape)["kind"]))


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", SHAPES)
def test_places_are_a_spacing_apart_around_the_origin(kind: str, n: int) -> None:
    places = np.array(points(kind, n, 1.5))
    assert places.shape == (n, 2)
    assert_allclose(places.mean(axis=0), 0.0, atol=1e-12)
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)[~np.eye(n, dtype=bool)]
    assert distance.reshape(n, n - 1).min(axis=1) == pytest.approx(np.full(n, 1.5))


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", SHAPES)
def test_no_triangle_is_singular_by_either_angle(kind: str, n: int) -> None:
    flat = math.sin(math.pi / n) if kind == "polygon" else 0.4
    for first, second, third in triangles(np.array(points(kind, n, 1.0))):
        a, b = second - first, third - first
        assert min(np.hypot(*a), np.hypot(*b)) > 0.999
        assert np.hypot(*(a + b)) / 2 > 0.2
        height = abs(a[0] * b[1] - a[1] * b[0]) / max(map(np.hypot, *np.array([a, b, a - b]).T))
        assert height > 0.999 * flat


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", SHAPES)
def test_triangles_do_not_overlap(kind: str, n: int) -> None:
    shapes = [Polygon(corners) for corners in triangles(np.array(points(kind, n, 1.0)))]
    shared = [a.intersection(b).area for a, b in combinations(shapes, 2)]
    if kind == "polygon" and n > LARGEST_STRIP:
        assert sum(area > 1e-9 for area in shared) == 1
        assert sum(shared) < 0.2
    else:
        assert max(shared, default=0.0) < 1e-9


def test_who_is_where() -> None:
    ahead = {kind: np.array(points(kind, 7, 1.0)) for kind in SHAPES}
    assert ahead["wedge"][:, 0].argmax() == 0
    assert ahead["vee"][:, 0].argmin() == 0
    assert np.ptp(ahead["column"][:, 0]) == pytest.approx(3.0)
    assert np.ptp(ahead["line-abreast"][:, 1]) == pytest.approx(3.0)
    assert_allclose(np.hypot(*ahead["polygon"].T), 0.5 / math.sin(math.pi / 7))
    assert ahead["polygon"][:, 0].argmax() == 0


@pytest.mark.parametrize(
    ("kind", "n", "spacing_m", "said"),
    [
        ("star", 5, 1.0, "must be one of line-abreast"),
        ("vee", 2, 1.0, "at least 3"),
        ("vee", 3, 0.0, "must be > 0"),
        ("vee", 3, math.nan, "must be > 0"),
    ],
)
def test_what_makes_no_shape_is_refused(kind: str, n: int, spacing_m: float, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        points(kind, n, spacing_m)
