import math
from itertools import pairwise
from typing import Any

import pytest

from maniple.core.scenario.parse import scenario_of
from maniple.core.scenario.places import desired_shapes, end_pose, heading, start_pose
from maniple.core.scenario.types import Line


def test_the_frame_travels_facing_along_the_line() -> None:
    task = Line(start=(1, 2), end=(1, 5), speed_mps=0.1)
    assert start_pose(task) == pytest.approx((1, 2, math.pi / 2))
    assert end_pose(task) == pytest.approx((1, 5, math.pi / 2))
    assert heading(Line(start=(0, 0), end=(-1, -1), speed_mps=1)) == pytest.approx(-0.75 * math.pi)


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
