import math
from collections.abc import Sequence

import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Point
from shapely.geometry import Polygon as Shape

from maniple.core.geometry import Pose
from maniple.core.scenario import outline
from maniple.core.scenario.types import Box, Circle, Polygon, Wall

quick = settings(deadline=None, derandomize=True, max_examples=200)
near = st.floats(-2.0, 2.0)
point = st.tuples(near, near)
grid = st.tuples(st.integers(-3, 3), st.integers(-3, 3))
pose = st.tuples(near, near, st.floats(-4.0, 4.0))
size = st.floats(0.05, 2.0)


@st.composite
def stars(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Simple polygons, most of them not convex: corners by growing angle around a centre."""
    cx, cy = draw(point)
    count = draw(st.integers(3, 8))
    radii = draw(st.lists(st.floats(0.2, 2.0), min_size=count, max_size=count))
    turn = draw(st.floats(0.0, 6.0))
    angles = [turn + 2.0 * math.pi * k / count for k in range(count)]
    return [(cx + r * math.cos(a), cy + r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]


@quick
@given(pose, size, size, pose, size, size)
def test_gap_between_rectangles(
    a: Sequence[float], la: float, wa: float, b: Sequence[float], lb: float, wb: float
) -> None:
    first, second = outline.rectangle(a, la, wa), outline.rectangle(b, lb, wb)
    expected = Shape(first).distance(Shape(second))
    assert outline.gap(first, second) == pytest.approx(expected, abs=1e-9)
    assert outline.gap(second, first) == pytest.approx(expected, abs=1e-9)


@quick
@given(pose, size, size, stars())
def test_gap_to_polygons(
    at: Sequence[float], length: float, width: float, corners: list[tuple[float, float]]
) -> None:
    body = outline.rectangle(at, length, width)
    expected = Shape(body).distance(Shape(corners))
    assert outline.gap_to(body, Polygon(points=tuple(corners))) == pytest.approx(expected, abs=1e-9)


@quick
@given(pose, size, size, point, st.floats(0.01, 2.0))
def test_gap_to_circles(
    at: Sequence[float], length: float, width: float, centre: tuple[float, float], r: float
) -> None:
    body = outline.rectangle(at, length, width)
    expected = max(0.0, Shape(body).distance(Point(centre)) - r)
    assert outline.gap_to(body, Circle(centre=centre, radius_m=r)) == pytest.approx(expected, abs=1e-9)


@quick
@given(pose, size, size, point, point)
def test_gap_to_walls(
    at: Sequence[float], length: float, width: float, start: tuple[float, float], end: tuple[float, float]
) -> None:
    assume(start != end)
    body = outline.rectangle(at, length, width)
    expected = Shape(body).distance(LineString([start, end]))
    assert outline.gap_to(body, Wall(start=start, end=end)) == pytest.approx(expected, abs=1e-9)


@quick
@given(pose, size, size, pose, size, size)
def test_gap_to_boxes(
    a: Sequence[float], la: float, wa: float, b: Sequence[float], lb: float, wb: float
) -> None:
    body = outline.rectangle(a, la, wa)
    box = Box(centre=(b[0], b[1]), size=(lb, wb), angle_rad=b[2])
    turned = shapely.affinity.rotate(
        shapely.box(b[0] - lb / 2, b[1] - wb / 2, b[0] + lb / 2, b[1] + wb / 2), b[2], use_radians=True
    )
    assert outline.gap_to(body, box) == pytest.approx(Shape(body).distance(turned), abs=1e-9)


def test_touching_counts_as_no_gap() -> None:
    square = outline.rectangle((0, 0, 0), 2.0, 2.0)
    assert outline.gap(square, outline.rectangle((2.0, 0, 0), 2.0, 2.0)) == 0.0
    assert outline.gap(square, outline.rectangle((2.0, 2.0, 0), 2.0, 2.0)) == 0.0
    assert outline.gap(square, square) == 0.0
    assert outline.gap_to(square, Circle(centre=(1.5, 0.0), radius_m=0.5)) == 0.0
    assert outline.gap_to(square, Wall(start=(1.0, -5.0), end=(1.0, 5.0))) == 0.0


def test_one_inside_the_other_has_no_gap() -> None:
    small, large = outline.rectangle((0, 0, 1), 0.1, 0.1), outline.rectangle((0, 0, 0), 4.0, 4.0)
    assert outline.gap(small, large) == outline.gap(large, small) == 0.0
    assert outline.gap_to(large, Wall(start=(-0.1, 0), end=(0.1, 0))) == 0.0
    assert outline.gap_to(large, Circle(centre=(0.3, 0.3), radius_m=0.01)) == 0.0


def test_a_robot_in_the_notch_of_a_polygon_is_clear_of_it() -> None:
    notch = Polygon(points=((-2, -2), (2, -2), (2, 2), (1, 2), (1, -1), (-1, -1), (-1, 2), (-2, 2)))
    assert outline.gap_to(outline.rectangle((0, 0.5, 0), 1.0, 1.0), notch) == pytest.approx(0.5)


@quick
@given(st.lists(grid, min_size=3, max_size=7))
def test_simple_polygons_are_those_that_shapely_finds_valid(corners: list[tuple[int, int]]) -> None:
    points = [(float(x), float(y)) for x, y in corners]
    simple = shapely.LinearRing(points).is_simple if len(set(points)) > 2 else False
    repeated = any(a == b for a, b in zip(points, [*points[1:], points[0]], strict=True))
    assert (outline.self_contact(points) is None) == (simple and not repeated)


@pytest.mark.parametrize(
    ("corners", "edges"),
    [
        ([(0, 0), (1, 1), (1, 0), (0, 1)], (0, 2)),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], (1, 1)),
        ([(0, 0), (2, 0), (1, 0), (1, 1)], (0, 1)),
        ([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)], (0, 2)),
    ],
)
def test_where_a_polygon_meets_itself(corners: list[tuple[float, float]], edges: tuple[int, int]) -> None:
    assert outline.self_contact(corners) == edges


@quick
@given(stars())
def test_area(corners: list[tuple[float, float]]) -> None:
    assert outline.area(corners) == pytest.approx(Shape(corners).area)
    assert outline.area(corners[::-1]) == pytest.approx(-Shape(corners).area)


@quick
@given(stars(), point)
def test_inside(corners: list[tuple[float, float]], at: tuple[float, float]) -> None:
    shape = Shape(corners)
    assume(shape.exterior.distance(Point(at)) > 1e-9)
    assert outline.inside(corners, at) == shape.contains(Point(at))


def test_corners_are_in_the_robots_frame() -> None:
    corners = outline.rectangle((1.0, 2.0, math.pi / 2), 0.6, 0.2)
    expected = [(0.9, 2.3), (0.9, 1.7), (1.1, 1.7), (1.1, 2.3)]
    assert [tuple(c) for c in corners] == [pytest.approx(e) for e in expected]
    assert Pose(1.0, 2.0, math.pi / 2).compose(Pose(0.3, 0.1, 0.0))[:2] == pytest.approx(corners[0])


@pytest.mark.parametrize(
    ("obstacle", "expected"),
    [
        (Circle(centre=(1, 2), radius_m=0.5), ((0.5, 1.5), (1.5, 2.5))),
        (Wall(start=(3, 1), end=(0, 2)), ((0, 1), (3, 2))),
        (Box(centre=(0, 0), size=(2, 1), angle_rad=math.pi / 2), ((-0.5, -1), (0.5, 1))),
        (Polygon(points=((0, 0), (4, 0), (0, 3))), ((0, 0), (4, 3))),
    ],
)
def test_box_around(
    obstacle: Circle | Wall | Box | Polygon, expected: tuple[tuple[float, float], ...]
) -> None:
    assert [tuple(c) for c in outline.box_around(obstacle)] == [pytest.approx(e) for e in expected]


@quick
@given(stars())
def test_triangles_cover_a_polygon(corners: list[tuple[float, float]]) -> None:
    shape = Shape(corners)
    assume(shape.area > 1e-3)
    for order in (corners, corners[::-1]):
        parts = [Shape([order[index] for index in one]) for one in outline.triangulated(order)]
        assert len(parts) == len(corners) - 2
        assert sum(part.area for part in parts) == pytest.approx(shape.area)
        assert all(part.area < 1e-9 or shape.buffer(1e-6).covers(part) for part in parts)
