import math

import numpy as np
import pytest
from shapely import Polygon

from benchmarks import planning
from benchmarks.planning import APART_M, SIDES_M, Case, outcomes, platoon, scattered
from maniple.core.scenario import outline


@pytest.mark.parametrize("n", SIDES_M)
def test_starts_are_scattered_clear_of_each_other_and_the_same_again(n: int) -> None:
    centres, headings = scattered(n, 3)
    assert centres.shape == (n, 2)
    assert np.abs(centres).max() <= 0.5 * SIDES_M[n]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[~np.eye(n, dtype=bool)]
    assert apart.min() > APART_M
    again, _ = scattered(n, 3)
    assert (again == centres).all()
    assert not np.allclose(headings, scattered(n, 4)[1])


def test_a_case_comes_out_the_same_however_it_is_shared() -> None:
    case = Case("proximity")
    together = outcomes(6, case, 0, 3)
    assert together == outcomes(6, case, 0, 1) + outcomes(6, case, 1, 3)


def test_straight_ways_of_the_best_assignment_form_without_a_collision() -> None:
    for case in (Case("optimal"), Case("optimal", layered=True)):
        (found,) = outcomes(6, case, 0, 1)
        assert found.circles_m > 0.0
        assert not found.bodies
        assert found.formed_s < 60.0


def test_bodies_touch_as_shapely_says() -> None:
    rng = np.random.default_rng(0)
    model = platoon(3).models["pioneer-3dx"]
    for _ in range(200):
        first, second = rng.uniform((-0.5, -0.5, -math.pi), (0.5, 0.5, math.pi), (2, 3))
        bodies = [Polygon(outline.body(tuple(pose), model)) for pose in (first, second)]
        assert planning._touch(first, second, model) == bodies[0].intersects(bodies[1])


def test_a_robot_sees_the_circle_round_another_in_front_and_none_behind() -> None:
    poses = np.array([(0.0, 0.0, 0.0), (1.2, 0.0, 2.0), (-1.0, 0.0, 0.0), (9.0, 0.0, 0.0)])
    seen = planning._seen(poses, 0, 0.3)
    assert len(seen.distance) == 5
    assert seen.distance.min() == pytest.approx(0.9)
    assert seen.bearing[seen.distance.argmin()] == pytest.approx(0.0)
    assert np.abs(seen.bearing).max() < math.asin(0.3 / 1.2)
    at = seen.distance[:, None] * np.column_stack([np.cos(seen.bearing), np.sin(seen.bearing)])
    assert np.hypot(*(at - (1.2, 0.0)).T) == pytest.approx(np.full(5, 0.3))
    assert len(planning._seen(poses, 3, 0.3).distance) == 0
