import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.geometry import Floats
from maniple.core.scenario.types import Box, Circle, Obstacle, Polygon, Wall
from simulator.collisions import FAR_M, Collisions, separation
from simulator.world import Complexes, corners_of, rectangle, shapes_of

HALF = np.array([0.2555 + 0.2125j, 0.2555 + 0.2125j, 0.3 + 0.2j, 0.2 + 0.2j])
OBSTACLES: tuple[Obstacle, ...] = (
    Circle(centre=(2.0, 1.0), radius_m=0.4),
    Box(centre=(0.5, -2.5), size=(2.0, 0.6), angle_rad=0.4),
    Polygon(points=((-2, 2), (-2, 4), (-1, 4), (-1, 3), (0, 3), (0, 2))),
    Wall(start=(-3.0, -3.0), end=(4.0, -4.0)),
)


def body(half: complex, position: complex, heading: float) -> shapely.Polygon:
    corners = position + np.exp(1j * heading) * rectangle(2 * half.real, 2 * half.imag)
    return shapely.Polygon([(z.real, z.imag) for z in corners])


def solids() -> list[shapely.Geometry]:
    shapes: list[shapely.Geometry] = []
    for o in OBSTACLES:
        if isinstance(o, Circle):
            shapes.append(shapely.Point(o.centre).buffer(o.radius_m, quad_segs=2000))
        elif isinstance(o, Wall):
            shapes.append(shapely.LineString([o.start, o.end]))
        else:
            shapes.append(shapely.Polygon([(z.real, z.imag) for z in corners_of(o)]))
    return shapes


def by_shapely(position: Complexes, heading: Floats) -> Floats:
    """Distance from each robot to the nearest anything."""
    robots = [body(h, p, a) for h, p, a in zip(HALF, position, heading, strict=False)]
    things = solids()
    return np.array(
        [
            min(robot.distance(thing) for thing in things + robots[:i] + robots[i + 1 :])
            for i, robot in enumerate(robots)
        ]
    )


SIZE = st.sampled_from([0.0, 0.1, 0.5, 2.0])


@settings(deadline=None, derandomize=True, max_examples=300)
@given(
    st.tuples(SIZE, SIZE, SIZE, SIZE),
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(-4, 4),
    st.floats(-4, 4),
)
def test_separation_agrees_with_shapely(
    sizes: tuple[float, float, float, float], x: float, y: float, first: float, second: float
) -> None:
    half = np.array([[complex(sizes[0], sizes[1])], [complex(sizes[2], sizes[3])]])
    other = half[::-1]
    corners = np.stack([other, other.conj(), -other, -other.conj()])[:, None]
    turn = np.exp(-1j * np.array([[[first], [second]]]))
    distance = separation(np.array([[complex(x, y)]]), turn, half, corners)[0, 0]

    def hull(half: complex, place: complex, heading: float) -> shapely.Geometry:
        points = place + np.exp(1j * heading) * rectangle(2 * half.real, 2 * half.imag)
        return shapely.MultiPoint([(z.real, z.imag) for z in points]).convex_hull

    expected = hull(half[0, 0], 0j, first).distance(hull(half[1, 0], complex(x, y), second))
    assert distance == pytest.approx(expected, abs=1e-6)


def start() -> tuple[Complexes, Floats]:
    return np.array([-1.0 + 0.0j, 1.0 - 0.5j, 3.5 + 1.2j, -3.0 - 1.0j]), np.array([0.0, 0.5, 2.0, -1.0])


def watch() -> Collisions:
    return Collisions(["r1", "r2", "r3", "r4"], HALF, shapes_of(OBSTACLES), *start(), 0.01)


def test_clearances_at_the_start() -> None:
    clearances, contacts = watch().report()
    assert clearances == pytest.approx(by_shapely(*start()), abs=1e-6)
    assert contacts == ()


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_least_clearances_are_exact_along_random_walks(seed: int) -> None:
    random = np.random.default_rng(seed)
    position, heading = start()
    collisions = watch()
    least = by_shapely(position, heading)
    velocity, rate = np.zeros(4, dtype=complex), np.zeros(4)
    for step in range(600):
        velocity = 0.97 * velocity + 0.002 * (random.normal(size=4) + 1j * random.normal(size=4))
        rate = 0.97 * rate + 0.005 * random.normal(size=4)
        moved = np.abs(velocity) + np.abs(rate) * np.abs(HALF)
        free = collisions.clear(moved)
        touching = collisions.overlaps(position + velocity, heading + rate)
        if free:
            assert not touching
        if touching:
            velocity[:] = rate[:] = 0.0
        position, heading = position + velocity, heading + rate
        collisions.record(position[None], heading[None], moved)
        distance = by_shapely(position, heading)
        assert distance.min() > 0
        least = np.minimum(least, distance)
        if step % 5 == 4:
            clearances, _ = collisions.report()
            assert clearances == pytest.approx(least, abs=1e-6)
            least = distance


def test_an_onset_is_counted_once_until_the_pair_has_parted() -> None:
    collisions = watch()
    position, heading = start()
    near = position.copy()
    near[0] = 1.3 + 1.0j
    collisions.record(
        np.asarray(np.linspace(position, near, 60), dtype=np.complex128),
        np.tile(heading, (60, 1)),
        np.full(4, 3.0),
    )
    touching = near.copy()
    touching[0] = 1.4 + 1.0j
    for _ in range(3):
        collisions.clear(np.full(4, 0.2))
        assert collisions.overlaps(touching, heading) == [(0, 4)]
        collisions.stop((0, 4))
        collisions.record(near[None], heading[None], np.full(4, 0.2))
    assert collisions.count == 1
    clearances, contacts = collisions.report()
    assert contacts == ("r1|obstacle 0",)
    assert clearances[0] == 0.0
    assert clearances[1] > 0.0
    away = near - np.array([0.002, 0, 0, 0])
    collisions.record(away[None], heading[None], np.full(4, 0.002))
    collisions.report()
    clearances, contacts = collisions.report()
    assert contacts == ()
    assert clearances[0] == pytest.approx(1.6 - 1.298 - 0.2555, abs=1e-9)
    collisions.stop((0, 4))
    assert collisions.count == 2


def test_contacts_of_two_robots_are_named_once() -> None:
    half = HALF[:2]
    collisions = Collisions(["a", "b"], half, shapes_of([]), np.array([0j, 0.52 + 0j]), np.zeros(2), 0.01)
    assert collisions.overlaps(np.array([0j, 0.51 + 0j]), np.zeros(2)) == [(0, 1)]
    collisions.stop((0, 1))
    clearances, contacts = collisions.report()
    assert contacts == ("a|b",)
    assert (clearances == 0.0).all()
    assert collisions.count == 1


def test_a_robot_alone_is_far_from_everything() -> None:
    collisions = Collisions(["a"], HALF[:1], shapes_of([]), np.array([0j]), np.zeros(1), 0.01)
    assert collisions.clear(np.array([0.05]))
    collisions.record(np.array([[0.05 + 0j]]), np.zeros((1, 1)), np.array([0.05]))
    clearances, contacts = collisions.report()
    assert clearances.tolist() == [FAR_M]
    assert contacts == ()


def test_crossed_bars_overlap_although_no_corner_lies_inside() -> None:
    half = np.array([2.0 + 0.1j, 2.0 + 0.1j])
    collisions = Collisions(["a", "b"], half, shapes_of([]), np.array([0j, 5.0 + 0j]), np.zeros(2), 10.0)
    assert collisions.overlaps(np.array([0j, 0j]), np.array([0.0, math.pi / 2])) == [(0, 1)]
