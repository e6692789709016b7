import numpy as np
import pytest

from maniple.core.scenario.types import Box, Circle, Polygon, Wall
from simulator.world import Scene, corners_of, rectangle, shapes_of

L_SHAPE = Polygon(points=((0, 0), (0, 3), (1, 3), (1, 1), (2, 1), (2, 0)))  # clockwise


def area(corners: np.ndarray) -> float:
    return float(0.5 * (corners.conj() * np.roll(corners, -1)).imag.sum())


def test_corners_run_counter_clockwise() -> None:
    assert area(corners_of(L_SHAPE)) == pytest.approx(4.0)
    assert area(corners_of(Box(centre=(1, 2), size=(3, 2), angle_rad=2.5))) == pytest.approx(6.0)
    assert area(rectangle(3.0, 2.0)) == pytest.approx(6.0)
    assert corners_of(Wall(start=(1, 2), end=(3, 4))).tolist() == [1 + 2j, 3 + 4j]


def test_shapes_are_rounded_rectangles_that_remember_their_obstacle() -> None:
    shapes = shapes_of(
        [
            Circle(centre=(1, 2), radius_m=0.3),
            L_SHAPE,
            Box(centre=(5, 5), size=(4, 2), angle_rad=0.5),
            Wall(start=(0, 0), end=(0, 4)),
        ]
    )
    assert shapes.thing.tolist() == [0, *[1] * 6, 2, 3]
    assert shapes.radius.tolist() == [0.3, *[0.0] * 8]
    assert shapes.half[7] == 2 + 1j
    assert shapes.centre[8] == 2j
    assert shapes.half[8] == 2
    assert shapes.heading[8] == pytest.approx(np.pi / 2)
    ends = shapes.half[1:7].real * np.exp(1j * shapes.heading[1:7])
    corners = corners_of(L_SHAPE)
    assert shapes.centre[1:7] - ends == pytest.approx(corners)
    assert shapes.centre[1:7] + ends == pytest.approx(np.roll(corners, -1))


def test_no_obstacles() -> None:
    assert len(shapes_of([]).radius) == 0
    scene = Scene([], np.array([0.25 + 0.2j]))
    assert len(scene.middle) == 4
    assert scene.first_robot == 0


def test_robots_are_placed() -> None:
    scene = Scene([Wall(start=(0, 0), end=(1, 0))], np.array([0.25 + 0.2j, 0.5 + 0.4j]))
    scene.place(np.array([1 + 1j, 5 + 5j]), np.array([0.3, -2.0]))
    for i, (centre, heading, size) in enumerate([(1 + 1j, 0.3, (0.5, 0.4)), (5 + 5j, -2.0, (1.0, 0.8))]):
        edges = slice(1 + 4 * i, 5 + 4 * i)
        corners = centre + np.exp(1j * heading) * rectangle(*size)
        assert (scene.middle - scene.half)[edges] == pytest.approx(corners)
        assert (scene.middle + scene.half)[edges] == pytest.approx(np.roll(corners, -1))
        assert (scene.shape[edges] == 1 + i).all()
        assert scene.centre[1 + i] == centre
