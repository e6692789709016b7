import builtins
import math
import time
from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely import LineString, Polygon

from central_controller import planning
from central_controller.formation import Gains
from central_controller.planning import METHODS, Straight
from maniple.core.errors import MissingExtraError
from maniple.core.geometry import Floats
from maniple.core.scenario.shapes import SHAPES, points
from maniple.core.scenario.types import Controller
from maniple.core.streams import stream

seeds = st.integers(0, 2**32 - 1)


def scattered(name: str, n: int, side_m: float = 8.0, apart_m: float = 0.0) -> Floats:
    """n points in a square, drawn one by one where they are clear of those before."""
    rng = stream(1, name)
    found: list[list[float]] = []
    while len(found) < n:
        point = rng.uniform(0.0, side_m, 2).tolist()
        if all(math.dist(point, other) > apart_m for other in found):
            found.append(point)
    return np.array(found)


@pytest.mark.parametrize("method", METHODS)
@given(seeds, st.integers(3, 12))
@settings(max_examples=40, deadline=None)
def test_every_method_gives_every_place_to_one_robot(method: str, seed: int, n: int) -> None:
    positions, places = np.random.default_rng(seed).uniform(0, 8, (2, n, 2))
    found = planning.plan(METHODS[method], positions, places)
    assert sorted(found.order) == list(range(n))


@pytest.mark.parametrize("method", METHODS)
def test_a_plan_does_not_depend_on_where_the_world_begins(method: str) -> None:
    positions, places = scattered("world", 14).reshape(2, 7, 2)
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    here = planning.plan(METHODS[method], positions, places)
    there = planning.plan(METHODS[method], positions @ turned.T + 5.0, places @ turned.T + 5.0)
    assert here.order == there.order
    assert_allclose(here[1:], there[1:])


def test_given_is_the_users_order() -> None:
    assert list(METHODS["given"](np.zeros((4, 2)), np.ones((4, 2)))) == [0, 1, 2, 3]


def test_final_reorganization_starts_far_away_and_goes_on_to_the_nearest() -> None:
    places = np.array([(0.0, 0.0), (1.0, 1.0), (2.0, 0.0), (3.0, 1.0)])
    positions = np.array([(0.0, -1.0), (7.0, 0.0), (3.0, -1.0), (4.5, -1.0)])
    assert list(METHODS["final-reorganization"](positions, places)) == [1, 3, 2, 0]


def test_distance_to_a_formation_is_that_to_its_nearest_place() -> None:
    places = np.array([(0.0, 0.0), (10.0, 1.0), (20.0, 0.0)])
    positions = np.array([(10.0, 5.0), (-3.0, 0.0), (23.0, 0.0)])
    assert METHODS["final-reorganization"](positions, places)[0] == 0


def test_proximity_seats_the_farthest_robot_first() -> None:
    """R1 of the first algorithm is robot 2; its nearest place is the last, and the chain is gone back."""
    places = np.array([(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)])
    positions = np.array([(1.0, 1.5), (0.0, -0.5), (5.0, 0.0)])
    assert list(METHODS["proximity"](positions, places)) == [1, 0, 2]


def test_proximity_respects_the_sequence() -> None:
    """Robot 2 is nearer to place 2, but would make ACB of what is to be ABC."""
    places = np.array([(0.0, 0.0), (2.0, 0.0), (1.0, 1.0), (2.5, 1.5)])
    positions = np.array([(-4.0, 0.0), (2.0, -0.2), (1.0, -0.5), (1.0, 2.5)])
    assert list(METHODS["proximity"](positions, places)) == [0, 1, 3, 2]


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_proximity_keeps_the_sequence_wherever_a_free_robot_has_it(seed: int) -> None:
    """By its own rule, written down once more: outward from the first seat along the chain."""
    n = 6
    positions, places = np.random.default_rng(seed).uniform(0, 8, (2, n, 2))
    order = list(METHODS["proximity"](positions, places))
    seat = order.index(METHODS["final-reorganization"](positions, places)[0])
    taken = [seat]
    for place in (*range(seat + 1, n), *range(seat - 1, -1, -1)):
        free = [order[k] for k in range(n) if k not in taken]
        window = next(
            (
                w
                for w in ([place - 2, place - 1, place], [place, place + 1, place + 2])
                if _known(w, place, taken)
            ),
            None,
        )
        chosen = free
        if window is not None:
            same = [r for r in free if _ccw(positions, [r if k == place else order[k] for k in window])
                    == _ccw(places, window)]  # fmt: skip
            chosen = same or free
        nearest = min(chosen, key=lambda robot: math.dist(positions[robot], places[place]))
        assert order[place] == nearest
        taken.append(place)


def _known(window: list[int], place: int, taken: list[int]) -> bool:
    return all(k == place or k in taken for k in window)


def _ccw(points: Floats, three: Sequence[int]) -> bool:
    return bool(Polygon(points[list(three)]).exterior.is_ccw)


@pytest.mark.parametrize("n", range(3, 8))
def test_optimal_is_the_best_of_all_assignments(n: int) -> None:
    positions, places = scattered(f"brute/{n}", 2 * n).reshape(2, n, 2)
    costs = {order: float(((positions[list(order)] - places) ** 2).sum()) for order in permutations(range(n))}
    assert tuple(METHODS["optimal"](positions, places)) == min(costs, key=costs.__getitem__)


def test_optimal_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object) -> object:
        if name.startswith("scipy"):
            raise ImportError(name)
        return real(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"maniple\[planning\]"):
        METHODS["optimal"](np.zeros((3, 2)), np.ones((3, 2)))


def test_what_is_no_assignment_is_refused() -> None:
    with pytest.raises(ValueError, match="an order of 0 to 2"):
        planning.plan(lambda positions, places: (0, 0, 1), np.zeros((3, 2)), np.ones((3, 2)))


@pytest.mark.parametrize("seed", range(5))
def test_figures_are_those_of_shapely_and_of_sampling(seed: int) -> None:
    starts, places = scattered(f"figures/{seed}", 16).reshape(2, 8, 2)
    found = planning.plan(METHODS["given"], starts, places)
    ways = [LineString(pair) for pair in np.stack([starts, places], axis=1)]
    assert found.crossings == sum(a.intersects(b) for a, b in combinations(ways, 2))
    assert found.total_m == pytest.approx(sum(way.length for way in ways))
    assert found.longest_m == pytest.approx(max(way.length for way in ways))
    share = np.linspace(0, 1, 5001)[:, None, None]
    at = starts + share * (places - starts)
    apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1) + 1e9 * np.eye(8)
    assert found.separation_m == pytest.approx(apart.min(), abs=1e-3)


@pytest.mark.parametrize("seed", range(40))
def test_optimal_straight_ways_in_step_keep_discs_apart(seed: int) -> None:
    """CAPT: starts and places 2 sqrt(2) R apart, then never nearer than 2 R."""
    radius = 0.4
    starts = scattered(f"capt/start/{seed}", 10, 8.0, 2 * math.sqrt(2) * radius)
    places = scattered(f"capt/place/{seed}", 10, 8.0, 2 * math.sqrt(2) * radius)
    assert planning.plan(METHODS["optimal"], starts, places).separation_m > 2 * radius


def test_the_bound_is_tight() -> None:
    """At 2 sqrt(2) R apart, two that turn a right angle around each other do touch."""
    starts, places = np.array([(1.0, 0.0), (-1.0, 0.0)]), np.array([(0.0, 1.0), (0.0, -1.0)])
    assert planning.plan(METHODS["optimal"], starts, places).separation_m == pytest.approx(math.sqrt(2))


def test_straight_begins_and_ends_together_at_rest() -> None:
    start, end = scattered("straight", 12).reshape(2, 6, 2)
    way = Straight(start, end, 0.2)
    times = np.linspace(0, way.duration_s, 2001)
    at = np.array([way.at(t)[0] for t in times])
    speed = np.array([way.at(t)[1] for t in times])
    assert_allclose(np.gradient(at, times, axis=0)[1:-1], speed[1:-1], atol=1e-6)
    assert_allclose(at[[0, -1]], [start, end], atol=1e-12)
    assert_allclose(speed[[0, -1]], 0.0, atol=1e-12)
    assert np.linalg.norm(speed, axis=-1).max() == pytest.approx(0.2, rel=1e-6)
    share = np.linalg.norm(at - start, axis=-1) / np.linalg.norm(end - start, axis=-1)
    assert_allclose(share, share[:, :1].repeat(6, axis=1), atol=1e-12)
    for t, points_there in ((-1.0, start), (way.duration_s + 1.0, end)):
        assert_allclose(way.at(t)[0], points_there)
        assert_allclose(way.at(t)[1], 0.0)


def test_a_formation_that_stands_already_takes_no_time() -> None:
    places = scattered("there", 4)
    way = Straight(places, places, 0.1)
    assert way.duration_s == 0.0
    assert_allclose(way.at(0.0)[0], places)


def test_points_come_back_to_their_straight_ways_and_stay_there() -> None:
    """The error of each coordinate obeys e' = -L tanh(kappa / L e), whose solution has a closed form."""
    start, end = scattered("follow", 12).reshape(2, 6, 2)
    way, gains = Straight(start, end, 0.2), Gains.of(Controller(kappa=0.25, saturation=0.1))
    dt, lasts_s = 0.01, 8.0
    x = start + 0.5 * np.sign(start - 4.0)
    first = way.at(0.0)[0] - x
    for k in range(round(lasts_s / dt)):
        x = x + dt * planning.follow(*way.at((k + 0.5) * dt), x, gains)
    left = np.arcsinh(np.sinh(2.5 * first) * math.exp(-0.25 * lasts_s)) / 2.5
    assert_allclose(way.at(lasts_s)[0] - x, left, atol=1e-3)
    on_the_way = way.at(5.0)
    assert_allclose(planning.follow(*on_the_way, on_the_way[0], gains), on_the_way[1])


@pytest.mark.parametrize("n", [3, 5, 9, 20])
def test_overlaps_are_those_of_shapely(n: int) -> None:
    places = scattered(f"overlap/{n}", n)
    shapes = [Polygon(places[k : k + 3]) for k in range(n - 2)]
    expected = sum(a.intersection(b).area > 1e-9 for a, b in combinations(shapes, 2))
    assert planning.overlaps(places) == expected


@pytest.mark.parametrize("n", [4, 5, 6])
def test_relabel_is_the_best_of_all_orders(n: int) -> None:
    for seed in range(3):
        places = scattered(f"relabel/{n}/{seed}", n)
        least = min(
            planning.overlaps(places[list(order)])
            for order in permutations(range(n))
            if not planning.singular(places[list(order)], signed=False)
        )
        order = list(planning.relabel(places, signed=False))
        assert planning.overlaps(places[order]) == least
        assert not planning.singular(places[order], signed=False)


@pytest.mark.parametrize("n", [3, 6, 7, 8, 15, 50])
@pytest.mark.parametrize("kind", SHAPES)
def test_shuffled_shapes_are_chained_without_overlap(kind: str, n: int) -> None:
    places = np.array(points(kind, n, 1.0))
    shuffled = places[stream(n, kind).permutation(n)]
    order = list(planning.relabel(shuffled))
    assert planning.overlaps(shuffled[order]) == 0
    assert not planning.singular(shuffled[order])


@pytest.mark.parametrize("kind", SHAPES)
def test_what_is_good_stays_as_it_is(kind: str) -> None:
    for n in (3, 5, 7, 12):
        assert planning.relabel(np.array(points(kind, n, 1.0))) == tuple(range(n))


def test_scattered_places_are_chained_soon() -> None:
    places = scattered("fifty", 50)
    begin = time.process_time()
    order = list(planning.relabel(places))
    assert time.process_time() - begin < 1.0
    assert planning.overlaps(places[order]) <= 10 < planning.overlaps(places)
    assert not planning.singular(places[order])


@pytest.mark.parametrize("lost", range(8))
@pytest.mark.parametrize("kind", SHAPES)
def test_a_chain_that_lost_a_robot_is_whole_again(kind: str, lost: int) -> None:
    rest = np.delete(np.array(points(kind, 8, 1.0)), lost, axis=0)
    for signed in (True, False):
        order = planning.rechain(rest, signed)
        assert sorted(order) == list(range(7))
        assert not planning.singular(rest[list(order)], signed)
        if not planning.singular(rest, signed):
            assert order == tuple(range(7))


def test_places_in_a_line_are_chained_for_the_signed_angle() -> None:
    line = np.column_stack([np.arange(5.0), np.zeros(5)])
    between = line[[1, 0, 2, 3, 4]]
    assert planning.singular(between)
    assert not planning.singular(between[list(planning.rechain(between))])
    assert planning.singular(line, signed=False)
