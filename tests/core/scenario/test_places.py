import math
from itertools import pairwise
from typing import Any

import pytest

from maniple.core.geometry import Pose
from maniple.core.scenario.parse import scenario_of
from maniple.core.scenario.places import desired_shapes, end_pose, fastest_mps, fastest_place_mps, start_pose
from maniple.core.scenario.types import Line, Orbit, Positioning, Samples, Sequence
from maniple.core.scenario.ways import way_of


def test_the_frame_travels_facing_along_the_line() -> None:
    task = Line(start=(1, 2), end=(1, 5), speed_mps=0.1)
    assert start_pose(task) == pytest.approx((1, 2, math.pi / 2))
    assert end_pose(task) == pytest.approx((1, 5, math.pi / 2))


def test_where_the_frame_is_placed_is_not_where_it_is_to_go() -> None:
    task = Positioning(start=(1, 2, 3), target=(4, 5, 0.5))
    assert start_pose(task) == (1, 2, 3)
    assert end_pose(task) == (4, 5, 0.5)


def test_a_sequence_starts_with_its_first_task_and_ends_with_its_last() -> None:
    line = Line(start=(1, 2), end=(1, 5), speed_mps=0.1)
    samples = Samples(times_s=(0, 1, 3), poses=((0, 0, 0), (1, 0, 0), (2, 1, 1)))
    assert start_pose(Sequence(tasks=(line, samples))) == start_pose(line)
    assert end_pose(Sequence(tasks=(line, samples))) == pytest.approx((2, 1, 1))
    assert start_pose(samples) == (0, 0, 0)


def test_the_outside_of_a_turn_is_faster() -> None:
    orbit = Orbit(centre=(0, 0), radius_m=2.0, speed_mps=0.3)
    assert fastest_mps(orbit) == pytest.approx(0.3)
    assert fastest_mps(orbit, (0.0, -1.0)) == pytest.approx(0.3 * 3 / 2)
    assert fastest_mps(orbit, (0.0, 2.0)) == pytest.approx(0.0, abs=1e-15)
    assert fastest_mps(orbit, (1.5, 0.0)) == pytest.approx(0.3 * 2.5 / 2)


def test_a_fixed_heading_has_no_outside() -> None:
    orbit = Orbit(centre=(0, 0), radius_m=2.0, speed_mps=0.3, facing="fixed")
    assert fastest_mps(orbit, (0.0, -1.0)) == pytest.approx(0.3)


def test_the_fastest_of_samples_is_what_finite_differences_say() -> None:
    task = Samples(times_s=(0, 1, 3, 4), poses=((0, 0, 0), (1, 0, 0.5), (2, 2, 1), (2, 4, -1)))
    way = way_of(task)
    step = 1e-4
    poses = [way.at(k * step)[0] for k in range(40_001)]
    place = Pose(0.4, -0.3, 0.0)
    spots = [pose.compose(place) for pose in poses]
    speed = max(math.dist(a[:2], b[:2]) / step for a, b in pairwise(spots))
    assert fastest_mps(task, place[:2]) == pytest.approx(speed, rel=0.01)


def test_a_sequence_is_as_fast_as_its_fastest() -> None:
    slow, fast = (Line(start=(0, 0), end=(1, 0), speed_mps=v) for v in (0.1, 0.4))
    assert fastest_mps(Sequence(tasks=(slow, fast, Positioning(target=(0, 0, 0))))) == pytest.approx(0.4)
    assert fastest_mps(Positioning(target=(0, 0, 0)), (3.0, 1.0)) == 0.0


def test_shapes_of_known_triangles(data: dict[str, Any]) -> None:
    data["formation"]["points"] = [[0, 0], [3, 0], [0, 4]]
    (shape,) = desired_shapes(scenario_of(data))
    assert shape.robots == ("r1", "r2", "r3")
    assert (shape.p, shape.q, shape.beta) == pytest.approx((3, 4, math.pi / 2))
    assert (shape.median, shape.height) == pytest.approx((2.5, 2.4))


def test_the_other_sequence_has_the_other_sign(data: dict[str, Any]) -> None:
    data["formation"]["points"] = [[0, 0], [0, 4], [3, 0]]
    assert desired_shapes(scenario_of(data))[0].beta == pytest.approx(-math.pi / 2)


def test_a_chain_has_a_triangle_for_each_robot_but_two(data: dict[str, Any]) -> None:
    data["robots"] += [{"id": f"r{k}", "model": "cart", "sensor": "eye"} for k in (4, 5)]
    data["formation"]["points"] += [[-1, 0], [-1, 1]]
    shapes = desired_shapes(scenario_of(data))
    assert [shape.robots for shape in shapes] == [("r1", "r2", "r3"), ("r2", "r3", "r4"), ("r3", "r4", "r5")]
    for before, after in pairwise(shapes):
        r = math.sqrt(before.p**2 + before.q**2 - 2 * before.p * before.q * math.cos(before.beta))
        assert after.p == pytest.approx(r), "the next triangle's p is the side opposite R1"


def test_the_fastest_place_of_a_formation(data: dict[str, Any]) -> None:
    data["task"] = {"kind": "circle", "centre": [0, 0], "radius_m": 2, "speed_mps": 0.3}
    data["formation"]["points"] = [[0, 0.5], [1.5, 0], [0, -0.4]]
    assert fastest_place_mps(scenario_of(data)) == pytest.approx(0.3 * 2.5 / 2)
    data["formation"]["points"] = [[0, 0.5], [0, 1], [0.1, 1]]
    assert fastest_place_mps(scenario_of(data)) == pytest.approx(0.3), "of the frame itself"
