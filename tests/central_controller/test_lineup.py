from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.testing import assert_allclose

from central_controller.lineup import Lineup, fitted
from central_controller.planning import METHODS
from central_controller.reference import REST, Reference
from maniple.core.geometry import Pose
from maniple.core.messages import unpack_floats
from maniple.core.scenario.types import Formation, Line, Planning, Robot, Scenario
from tests.central_controller.places import placed

POINTS = ((2.0, 0.9), (1.2, -0.9), (0.4, 0.9), (-0.4, -0.9), (-1.2, 0.9), (-2.0, -0.9))
IDS = tuple(f"r{k}" for k in range(1, 7))
HERE = Reference(Pose(3.0, -1.0, 0.7), REST)


def lineup(method: str = "given", **changes: Any) -> Lineup:
    scenario = Scenario(
        name="test",
        robots=tuple(Robot(id=name) for name in IDS),
        formation=Formation(points=POINTS),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
    )
    return Lineup(replace(scenario, **changes), METHODS[method])


def at_places(order: tuple[int, ...] = (0, 1, 2, 3, 4, 5)) -> dict[str, tuple[float, float]]:
    """Robot k at the place order[k]."""
    return {name: POINTS[place] for name, place in zip(IDS, order, strict=True)}


def test_at_first_every_robot_has_the_place_of_its_number() -> None:
    one = lineup()
    assert one.robots == IDS
    assert_allclose(one.places, POINTS)
    assert one.reach_m == pytest.approx(np.hypot(2.0, 0.9))
    assert_allclose(one.places_at(HERE.pose), placed(POINTS, HERE.pose))
    assert_allclose(unpack_floats(one.packed(), 2), POINTS, rtol=1e-6)


def test_a_plan_gives_everybody_the_place_where_it_stands() -> None:
    one = lineup("optimal")
    one.plan(at_places((3, 0, 5, 1, 2, 4)))
    assert one.robots == ("r2", "r4", "r5", "r1", "r6", "r3")
    assert_allclose(one.places, POINTS)


def test_the_others_keep_their_places_when_one_is_lost_and_it_has_its_own_when_it_is_back() -> None:
    one = lineup()
    one.chain_up([name for name in IDS if name != "r4"])
    assert one.robots == ("r1", "r2", "r3", "r5", "r6")
    assert_allclose(one.places, [POINTS[k] for k in (0, 1, 2, 4, 5)])
    assert one.chain.points.shape == (5, 2)
    one.chain_up(IDS)
    assert_allclose(one.places, POINTS)


def test_a_chain_that_would_be_singular_gets_another_order() -> None:
    """Without r2, r3 would be midway between r1 and r4."""
    row = ((2.0, 0.0), (1.0, 1.0), (0.0, 0.0), (-2.0, 0.0), (-1.0, 1.0))
    robots = tuple(Robot(id=name) for name in IDS[:5])
    one = lineup(robots=robots, formation=Formation(points=row))
    one.chain_up(["r3", "r1", "r4", "r5"])
    places = {name: row[int(name[1]) - 1] for name in one.robots}
    assert_allclose(one.places, [places[name] for name in one.robots])
    assert one.chain.triangles(one.places).variables()[:, 3:5].min() > 0.5
    first, *rest = one.places
    assert np.linalg.norm(first - np.mean(rest[:2], axis=0)) > 0.1


def test_two_robots_are_no_chain_but_have_their_places() -> None:
    one = lineup()
    one.chain_up(["r5", "r2"])
    assert one.robots == ("r2", "r5")
    assert_allclose(one.places, [POINTS[1], POINTS[4]])
    assert_allclose(unpack_floats(one.packed(), 2), [POINTS[1], POINTS[4]], rtol=1e-6)


def test_a_new_shape_while_one_is_lost_leaves_its_place_free() -> None:
    one = lineup("optimal")
    one.set_points([(x, 2 * y) for x, y in POINTS])
    one.plan({name: point for name, point in at_places().items() if name != "r4"})
    assert one.robots == ("r1", "r2", "r3", "r5", "r6")
    assert_allclose(one.places[:, 1], [2 * POINTS[k][1] for k in (0, 1, 2, 4, 5)])


def test_places_may_be_numbered_anew() -> None:
    shuffled = tuple(POINTS[k] for k in (0, 5, 2, 4, 1, 3))
    one = lineup(formation=Formation(points=shuffled), planning=Planning(relabel=True))
    assert sorted(map(tuple, one.places.tolist())) == sorted(POINTS)
    assert one.places.tolist() != [list(point) for point in shuffled]


def test_the_build_up_starts_where_the_robots_are_and_ends_at_their_places() -> None:
    one = lineup()
    start = {name: (x - 1.0, y + 0.5 * k) for k, (name, (x, y)) in enumerate(at_places().items())}
    one.build(start, 0.1)
    assert one.building
    assert_allclose(one.points, list(start.values()))
    for _ in range(1000):
        one.advance(0.1)
    assert not one.building
    assert_allclose(one.points, POINTS)


def test_the_ways_move_with_the_formation_and_their_velocities_are_their_derivatives() -> None:
    one, moving = lineup(), (0.1, -0.2, 0.3)
    one.build({name: (x - 1.0, 0.5 * y) for name, (x, y) in at_places().items()}, 0.1)
    one.advance(3.0)
    points, velocities = one.ways_at(Reference(HERE.pose, moving))
    assert_allclose(points, placed(one.points.tolist(), HERE.pose))
    step = 1e-6
    one.advance(step)
    x, y, psi = (a + step * b for a, b in zip(HERE.pose, moving, strict=True))
    later, _ = one.ways_at(Reference(Pose(x, y, psi), moving))
    assert_allclose((later - points) / step, velocities, atol=1e-5)


def test_another_one_goes_on_with_the_places_and_the_building() -> None:
    one, other = lineup("optimal"), lineup("optimal")
    one.plan(at_places((3, 0, 5, 1, 2, 4)))
    one.chain_up([name for name in IDS if name != "r4"])
    one.build({name: (x - 1.0, 0.5 * y) for name, (x, y) in at_places().items()}, 0.1)
    one.advance(2.0)
    places = {name: one.place_of(name) for name in IDS}
    other.recall(places, one.robots, one.built_from, one.built_s, 0.1)
    for _ in range(1000):
        assert (other.robots, other.building, other.built_s) == (one.robots, one.building, one.built_s)
        assert_allclose(other.points, one.points)
        one.advance(0.1)
        other.advance(0.1)
    assert (one.built_from, one.built_s) == ((), 0.0)
    other.recall(places, IDS, (), 0.0, 0.1)
    assert not other.building
    assert other.place_of("r4") == 1


def test_the_frame_that_fits_is_where_it_was_put() -> None:
    places = np.array(POINTS)
    for frame in (Pose(0.0, 0.0, 0.0), Pose(3.0, -1.0, 2.5), Pose(-1.0, 4.0, -3.0)):
        assert fitted(placed(POINTS, frame), places) == pytest.approx(frame)
    off = placed(POINTS, HERE.pose) + np.random.default_rng(1).normal(scale=0.1, size=(6, 2))
    assert fitted(off, places) == pytest.approx(HERE.pose, abs=0.15)


def test_exchanged_robots_have_each_others_places() -> None:
    one = lineup()
    one.exchange((1, 0, 2, 3, 4, 5))
    assert one.robots == ("r2", "r1", "r3", "r4", "r5", "r6")
    assert_allclose(one.places, POINTS)
