import math
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from maniple.core.geometry import Floats
from maniple.core.scenario import outline
from maniple.core.scenario.types import Box, Circle, Obstacle, Polygon, RangeFinder, Wall
from maniple.core.streams import stream
from simulator.node import cone_of
from simulator.range_finder import Fan, sweep
from simulator.world import Complexes, Scene, corners_of, rectangle

OBSTACLES: tuple[Obstacle, ...] = (
    Circle(centre=(2.0, 1.0), radius_m=0.4),
    Circle(centre=(-3.0, 0.5), radius_m=1.0),
    Box(centre=(0.5, -2.5), size=(2.0, 0.6), angle_rad=0.4),
    Polygon(points=((-1, 2), (-1, 4), (0, 4), (0, 3), (1, 3), (1, 2))),
    Polygon(points=((4, -4), (6, -4), (5, -3), (6, -1), (4, -2))),
    Wall(start=(-6.0, -5.0), end=(7.0, -5.0)),
    Wall(start=(7.0, -5.0), end=(7.0, 6.0)),
)
BODIES = np.array([0.25 + 0.2j, 0.3 + 0.25j, 0.2 + 0.2j])
POSITIONS = np.array([0.0 + 0.0j, 1.5 + 2.0j, -2.0 - 2.0j])
HEADINGS = np.array([0.3, -1.0, 2.8])


def sensor(beams: int, first: float, increment: float, range_max: float = 8.0) -> RangeFinder:
    return RangeFinder(beams=beams, first_angle_rad=first, increment_rad=increment, range_max_m=range_max)


def solids(obstacles: Sequence[Obstacle]) -> list[shapely.Geometry]:
    shapes = []
    for o in obstacles:
        if isinstance(o, Circle):
            shapes.append(shapely.Point(o.centre).buffer(o.radius_m, quad_segs=4000))
        elif isinstance(o, Wall):
            shapes.append(shapely.LineString([o.start, o.end]))
        else:
            shapes.append(shapely.Polygon([(z.real, z.imag) for z in corners_of(o)]))
    return shapes


def bodies(skip: int) -> list[shapely.Geometry]:
    shapes = []
    for i, body in enumerate(BODIES):
        if i != skip:
            corners = POSITIONS[i] + np.exp(1j * HEADINGS[i]) * rectangle(2 * body.real, 2 * body.imag)
            shapes.append(shapely.Polygon([(z.real, z.imag) for z in corners]))
    return shapes


def by_shapely(kind: RangeFinder, origin: complex, heading: float, shapes: list[shapely.Geometry]) -> Floats:
    ranges = np.full(kind.beams, kind.range_max_m)
    start = shapely.Point(origin.real, origin.imag)
    for k in range(kind.beams):
        angle = heading + kind.first_angle_rad + k * kind.increment_rad
        end = origin + kind.range_max_m * complex(math.cos(angle), math.sin(angle))
        ray = shapely.LineString([(origin.real, origin.imag), (end.real, end.imag)])
        for shape in shapes:
            if ray.intersects(shape):
                ranges[k] = min(ranges[k], start.distance(ray.intersection(shape)))
    return ranges


def by_force(
    kind: RangeFinder, origin: Complexes, heading: Floats, own: Sequence[int], scene: Scene
) -> Floats:
    """Every beam of every sensor against every circle and every edge, without windows or culling."""
    angles = heading[:, None] + kind.first_angle_rad + kind.increment_rad * np.arange(kind.beams)
    beam = np.exp(1j * angles)[:, :, None]
    centre = (scene.circles - origin[:, None])[:, None]
    along = (beam.conj() * centre).real
    chord = scene.radii**2 - np.abs(centre) ** 2 + along**2
    near = along - np.sqrt(np.where(chord >= 0, chord, np.inf))
    far = along + np.sqrt(np.where(chord >= 0, chord, -0.0))
    hit = np.where(chord >= 0, np.where(near >= 0, near, np.where(far >= 0, 0.0, np.inf)), np.inf)
    ranges = np.minimum(hit.min(axis=2, initial=np.inf), kind.range_max_m)

    start = (scene.middle - scene.half - origin[:, None])[:, None]
    along_edge = (2 * scene.half)[None, None]
    cross = (beam.conj() * along_edge).imag
    with np.errstate(all="ignore"):
        distance = (start.conj() * along_edge).imag / cross
        share = (start.conj() * beam).imag / cross
    valid = (distance >= 0) & (share >= 0) & (share <= 1)
    for row, robot in enumerate(own):
        if robot >= 0:
            valid[row, :, scene.shape == robot + scene.first_robot] = False
    return np.asarray(np.minimum(ranges, np.where(valid, distance, np.inf).min(axis=2)))


def scene_of(obstacles: Sequence[Obstacle] = OBSTACLES) -> Scene:
    scene = Scene(obstacles, BODIES)
    scene.place(POSITIONS, HEADINGS)
    return scene


FANS = [
    sensor(181, -math.pi / 2, math.pi / 180),
    sensor(361, -math.pi, math.pi / 180),
    sensor(360, 0.0, math.pi / 180),
    sensor(270, -2.4, 2 * math.pi / 360),
    sensor(16, -1.0, 0.13, 3.0),
    sensor(1, 0.7, 0.1),
    sensor(50, 11.0, 0.12),
]


@pytest.mark.parametrize("kind", FANS)
def test_agrees_with_shapely(kind: RangeFinder) -> None:
    own = np.arange(3)
    ranges = sweep(Fan(kind), POSITIONS, HEADINGS, own, scene_of())
    assert ranges.shape == (3, kind.beams)
    for i in range(3):
        expected = by_shapely(kind, POSITIONS[i], HEADINGS[i], solids(OBSTACLES) + bodies(skip=i))
        assert ranges[i] == pytest.approx(expected, abs=1e-5)


@settings(deadline=None, derandomize=True, max_examples=100)
@example([(-2.0, 2.0, 0.0), (-2.0, 2.0, 0.0)], 1, 0.0, 1.0, 2.0)
@given(
    st.lists(st.tuples(st.floats(-7, 8), st.floats(-6, 7), st.floats(-7, 7)), min_size=1, max_size=4),
    st.integers(1, 200),
    st.floats(-7, 7),
    st.floats(0.1, 1.0),
    st.floats(0.3, 12.0),
)
def test_agrees_with_brute_force(
    poses: list[tuple[float, float, float]], beams: int, first: float, share: float, range_max: float
) -> None:
    kind = sensor(beams, first, share * 2 * math.pi / beams, range_max)
    table = np.array(poses)
    origin, heading = table[:, 0] + 1j * table[:, 1], table[:, 2]
    own = np.full(len(poses), -1)
    scene = scene_of()
    things = solids(OBSTACLES) + bodies(skip=-1)
    points = [shapely.Point(z.real, z.imag) for z in origin]
    edges = [thing.boundary if thing.area else thing for thing in things]
    assume(all(edge.distance(point) > 1e-6 for edge in edges for point in points))
    inside = [any(point.within(thing) for thing in things) for point in points]
    ranges = sweep(Fan(kind), origin, heading, own, scene)
    # A beam that grazes a corner may hit by one rounding and miss by another, as one that is turned a little.
    turned = [by_force(kind, origin, heading + turn, own.tolist(), scene) for turn in (0.0, -1e-9, 1e-9)]
    for expected in turned:
        expected[inside] = 0.0
    off = np.min([np.abs(ranges - expected) / (1 + expected) for expected in turned], axis=0)
    assert off.max() <= 1e-6


@pytest.mark.parametrize(
    "origin", [2.1 + 1.1j, 0.6 - 2.4j, -0.5 + 3.5j, 4.4 - 3.0j, 1.5 + 2.0j, -2.9 + 0.6j, 2.0 + 1.0j]
)
def test_reads_zero_inside_a_solid(origin: complex) -> None:
    for kind in FANS:
        ranges = sweep(Fan(kind), np.array([origin]), np.array([0.4]), np.array([-1]), scene_of())
        assert (ranges == 0.0).all()


def test_reads_a_distance_in_the_notch_of_a_polygon() -> None:
    ranges = sweep(Fan(FANS[2]), np.array([0.5 + 3.5j]), np.array([0.0]), np.array([-1]), scene_of())
    assert ranges[0, 180] == pytest.approx(0.5)
    assert ranges[0, 270] == pytest.approx(0.5)


def test_nothing_seen_is_the_largest_range_exactly() -> None:
    kind = sensor(181, -math.pi / 2, math.pi / 180, 5.3)
    scene = Scene([], BODIES[:1])
    scene.place(np.array([0j]), np.array([0.0]))
    ranges = sweep(Fan(kind), np.array([0j]), np.array([0.0]), np.array([0]), scene)
    assert (ranges == 5.3).all()


@pytest.mark.parametrize("place", [1.0 - 5.0j, -10.0 - 5.0j])
def test_a_wall_seen_from_its_end_or_from_on_it_is_nothing(place: complex) -> None:
    scene = Scene([Wall(start=(-6.0, -5.0), end=(7.0, -5.0))], BODIES[:1])
    scene.place(np.array([50 + 50j]), np.array([0.0]))
    ranges = sweep(Fan(FANS[2]), np.array([place]), np.array([0.0]), np.array([-1]), scene)
    assert (ranges == 8.0).all()


def test_shapes_move_and_turn_with_the_world() -> None:
    """Moving sensors and obstacles together changes nothing."""
    kind = FANS[3]
    before = sweep(Fan(kind), POSITIONS, HEADINGS, np.arange(3), scene_of(OBSTACLES[2:3]))
    box = OBSTACLES[2]
    assert isinstance(box, Box)
    turn, shift = np.exp(0.7j), 3.0 - 8.0j
    centre = turn * complex(*box.centre) + shift
    moved = Box(centre=(centre.real, centre.imag), size=box.size, angle_rad=box.angle_rad + 0.7)
    scene = Scene([moved], BODIES)
    scene.place(turn * POSITIONS + shift, HEADINGS + 0.7)
    after = sweep(Fan(kind), turn * POSITIONS + shift, HEADINGS + 0.7, np.arange(3), scene)
    assert after == pytest.approx(before, abs=1e-9)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.floats(-3.0, 3.0), st.floats(0.05, 1.0), st.integers(0, 10**6))
def test_a_cone_reads_the_nearest_point_within_it(heading: float, cone: float, seed: int) -> None:
    """Against the distance from its tip to what of the obstacle lies in the sector, by shapely."""
    random = stream(seed, "cone")
    kind = RangeFinder(transducers=((0.0, 0.0, 0.0),), cone_rad=cone, range_max_m=5.0)
    x, y = random.uniform(-3.0, 3.0, 2).tolist()
    if math.hypot(x, y) < 1.0:
        return
    length, width = random.uniform(0.2, 0.8, 2).tolist()
    box = Box(centre=(x, y), size=(length, width), angle_rad=float(random.uniform(-3, 3)))
    scene = Scene([box], np.array([], dtype=complex))
    fan = Fan(cone_of(kind))
    ranges = sweep(fan, np.array([0j]), np.array([heading]), np.array([-1]), scene)
    edge = [heading - 0.5 * cone + cone * k / 200 for k in range(201)]
    sector = shapely.Polygon([(0, 0), *((9 * math.cos(a), 9 * math.sin(a)) for a in edge)])
    part = shapely.Polygon(outline.corners_of(box)).intersection(sector)
    reading = float(ranges.min())
    if part.is_empty:
        assert reading == 5.0
    else:
        exact = part.distance(shapely.Point(0, 0))
        assert exact - 1e-3 <= reading
        if reading < 5.0:  # rays a degree apart may miss the tip of a corner, or come in half a degree later
            assert reading <= exact * (1 + 1e-3) + math.radians(1.0) * exact
