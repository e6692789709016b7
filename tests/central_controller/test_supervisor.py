"""Closed loops of ideal control points: x' = v, 10 Hz."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from central_controller import formation, planning
from central_controller.chain import Chain
from central_controller.formation import Gains
from central_controller.reference import REST
from central_controller.supervisor import AIM, Guided, Supervisor, exchange
from maniple.core.geometry import Floats, Pose
from maniple.core.messages import Led
from maniple.core.scenario import types
from maniple.core.scenario.shapes import points
from maniple.core.streams import stream
from tests.central_controller.places import placed

GAINS = Gains.of(types.Controller())
DT_S = 0.1
REACHED_M = 0.02


def in_a_line(start: Floats, rng: np.random.Generator) -> None:
    direction = rng.uniform(0, 2 * math.pi)
    start[:] = start[0] + np.outer(rng.uniform(-3, 3, len(start)), (math.cos(direction), math.sin(direction)))


def in_a_line_with_the_first_midway(start: Floats, rng: np.random.Generator) -> None:
    in_a_line(start, rng)
    midway(start, rng)


def midway(start: Floats, _rng: np.random.Generator) -> None:
    start[0] = (start[1] + start[2]) / 2


def first_two_at_one_place(start: Floats, _rng: np.random.Generator) -> None:
    start[1] = start[0]


def first_and_third_at_one_place(start: Floats, _rng: np.random.Generator) -> None:
    start[2] = start[0]


def second_and_third_at_one_place(start: Floats, _rng: np.random.Generator) -> None:
    start[2] = start[1]


def all_at_one_place(start: Floats, _rng: np.random.Generator) -> None:
    start[:] = start[0]


SINGULAR = (
    in_a_line,
    in_a_line_with_the_first_midway,
    midway,
    first_two_at_one_place,
    first_and_third_at_one_place,
    second_and_third_at_one_place,
    all_at_one_place,
)


class Loop(NamedTuple):
    """What became of a platoon."""

    off_m: float
    """The most any control point is from its place."""
    smallest_m: float
    """The smallest p, q or median on the way."""
    acted: int
    """Ticks."""
    notes: set[str]


def closed_loop(
    start: Floats,
    shape: Floats,
    pose: Pose,
    signed: bool = True,
    enabled: bool = True,
    lasts_s: float = 200.0,
) -> Loop:
    """Until every control point is at its place, or for `lasts_s`."""
    chain, places = Chain(shape, signed), placed(shape, pose)
    desired = chain.desired(pose, REST)
    supervisor = Supervisor(types.Supervisor(enabled=enabled), signed)
    smallest, acted, notes, x = math.inf, 0, set(), start
    for _ in range(round(lasts_s / DT_S)):
        wanted = formation.step(chain, GAINS, x, desired).velocities
        guided = supervisor.step(x, places, wanted)
        notes |= set(guided.notes)
        acted += bool(guided.notes)
        x = x + DT_S * guided.velocities
        smallest = min(smallest, sizes(x))
        if np.abs(x - places).max() < REACHED_M:
            break
    return Loop(float(np.abs(x - places).max()), smallest, acted, notes)


def sizes(x: Floats) -> float:
    """The smallest p, q or median of the chain."""
    first, second, third = x[:-2], x[1:-1], x[2:]
    vectors = (second - first, third - first, first - (second + third) / 2)
    return float(min(np.linalg.norm(vector, axis=1).min() for vector in vectors))


def scene(n: int, seed: int) -> tuple[Floats, Floats, Pose, np.random.Generator]:
    """A random start, a column or its mirror image, and where it is to stand."""
    rng = stream(seed, f"supervisor/{n}")
    shape = np.array(points("column", n, 1.5)) * (1.0, rng.choice((-1.0, 1.0)))
    return rng.uniform(-3, 3, (n, 2)), shape, Pose(*rng.uniform(-2, 2, 3).tolist()), rng


def forms(n: int, make: Callable[[Floats, np.random.Generator], None], signed: bool, seed: int) -> Loop:
    start, shape, pose, rng = scene(n, seed)
    make(start, rng)
    return closed_loop(start, shape, pose, signed)


@pytest.mark.parametrize("signed", [True, False], ids=["signed", "unsigned"])
@pytest.mark.parametrize("n", [3, 4, 6])
@pytest.mark.parametrize("make", SINGULAR)
def test_a_platoon_forms_from_where_the_jacobian_is_singular(
    make: Callable[[Floats, np.random.Generator], None], n: int, signed: bool
) -> None:
    for seed in range(3):
        assert forms(n, make, signed, seed).off_m < REACHED_M, seed


@pytest.mark.slow
@pytest.mark.parametrize("signed", [True, False], ids=["signed", "unsigned"])
@pytest.mark.parametrize("n", [3, 4, 6])
@pytest.mark.parametrize("make", SINGULAR)
def test_a_platoon_forms_from_hundreds_of_singular_starts(
    make: Callable[[Floats, np.random.Generator], None], n: int, signed: bool
) -> None:
    stuck = [seed for seed in range(200) if forms(n, make, signed, seed).off_m >= REACHED_M]
    assert stuck == []


@pytest.mark.parametrize("make", [first_two_at_one_place, first_and_third_at_one_place, all_at_one_place])
def test_robots_at_one_place_stay_there_without_it(
    make: Callable[[Floats, np.random.Generator], None],
) -> None:
    start, shape, pose, rng = scene(3, 0)
    make(start, rng)
    assert closed_loop(start, shape, pose, enabled=False, lasts_s=100.0).off_m > 0.5


@pytest.mark.parametrize("n", [3, 4, 6])
def test_no_scattered_platoon_is_hindered_and_none_gets_singular(n: int) -> None:
    for seed in range(15):
        start, shape, pose, _ = scene(n, seed)
        if sizes(start) < 0.15:
            continue
        loop = closed_loop(start, shape, pose)
        assert loop.off_m < REACHED_M
        assert loop.smallest_m > 0.05


def test_the_law_alone_passes_singular_triangles() -> None:
    """The same starts, so that the test before says something."""
    loops = [closed_loop(*scene(6, seed)[:3], enabled=False) for seed in range(15)]
    assert min(loop.smallest_m for loop in loops) < 0.04


@pytest.mark.parametrize("n", [3, 6, 12])
@pytest.mark.parametrize("kind", ["line-abreast", "vee", "wedge", "polygon", "column"])
def test_it_leaves_a_formation_alone(kind: str, n: int) -> None:
    shape = np.array(points(kind, n, 1.2))
    rng = stream(n, kind)
    loop = closed_loop(shape + rng.uniform(-0.2, 0.2, (n, 2)), shape, Pose(0.0, 0.0, 0.0))
    assert loop.off_m < REACHED_M
    assert loop.acted == 0


def test_a_formation_smaller_than_the_margin_is_let_alone_at_its_places() -> None:
    shape = np.array(points("column", 5, 0.1))
    pose = Pose(0.0, 0.0, 0.0)
    supervisor = Supervisor(types.Supervisor(margin_m=0.15))
    still = np.zeros((5, 2))
    assert supervisor.step(shape, placed(shape, pose), still) == Guided(still, ())


def test_what_it_says_and_whom_it_moves() -> None:
    """Four robots, R1 of the second triangle nearly midway: only the fourth robot moves otherwise."""
    shape = np.array(points("column", 4, 1.5))
    x = shape.copy()
    x[3] = 2 * x[1] - x[2] + (0.1, 0.0)
    wanted = np.full((4, 2), -0.05)
    wanted[3] = (-0.1, -0.05)
    supervisor = Supervisor(types.Supervisor(), names=("a", "b", "c", "d"))
    velocities, notes = supervisor.step(x, shape, wanted)
    assert notes == ("b, c, d: median 0.05 m, moves d",)
    assert_array_equal(velocities[:3], wanted[:3])
    assert velocities[3, 0] > 0.0


def test_it_lets_go_later_than_it_begins() -> None:
    """A robot that the law would send through its hazard is kept between margin and aim, then let go."""
    shape = np.array(points("column", 3, 1.5))
    supervisor = Supervisor(types.Supervisor(margin_m=0.2))
    hazard = 2 * shape[0] - shape[1]
    away = np.array([0.6, 0.8])

    def acts(median_m: float, outwards_mps: float) -> bool:
        x, wanted = shape.copy(), np.zeros((3, 2))
        x[2], wanted[2] = hazard + 2 * median_m * away, outwards_mps * away
        return bool(supervisor.step(x, shape, wanted).notes)

    assert not acts(0.21, -0.1)
    assert not acts(0.19, 0.1)
    assert acts(0.19, -0.1)
    assert acts(0.22, -0.1)
    assert acts(0.22, 0.1)
    assert acts(0.2 * AIM, -0.1)
    assert not acts(0.2 * AIM, 0.1)
    assert not acts(0.22, -0.1)


def test_the_next_one_goes_on_with_what_is_acted_on() -> None:
    """Between margin and release only who has acted before still acts."""
    shape = np.array(points("column", 3, 1.5))
    names = ("a", "b", "c")
    old, new, fresh = (Supervisor(types.Supervisor(margin_m=0.2), names=names) for _ in range(3))
    x, wanted = shape.copy(), np.zeros((3, 2))
    away = np.array([0.6, 0.8])
    x[2], wanted[2] = 2 * shape[0] - shape[1] + 0.38 * away, -0.1 * away
    assert old.step(x, shape, wanted).notes
    (led,) = old.memory
    assert (led.kind, led.triangle, led.robot, abs(led.way)) == ("median", 0, 2, 1.0)
    new.recall([led, Led("median", 5, 2, 1.0), Led("q", 0, 9, 1.0), Led("what", 0, 2, 1.0)])
    assert new.memory == (led,)
    x[2] += 0.06 * away
    one, other = (supervisor.step(x, shape, wanted) for supervisor in (old, new))
    assert_array_equal(one.velocities, other.velocities)
    assert one.notes == other.notes != ()
    assert fresh.step(x, shape, wanted).notes == ()


def test_it_does_nothing_when_it_is_off() -> None:
    wanted = np.ones((3, 2))
    guided = Supervisor(types.Supervisor(enabled=False)).step(np.zeros((3, 2)), np.zeros((3, 2)), wanted)
    assert guided.velocities is wanted
    assert guided.notes == ()


def test_a_triangle_that_travels_is_led_as_one_that_stands() -> None:
    """The same to someone who moves along."""
    shape = np.array(points("column", 3, 1.5))
    x = shape.copy()
    x[0] = (x[1] + x[2]) / 2 + 0.01
    wanted = stream(1, "travel").uniform(-0.1, 0.1, (3, 2))
    still = Supervisor(types.Supervisor()).step(x, shape, wanted)
    along = Supervisor(types.Supervisor()).step(x, shape, wanted + np.array((0.4, -0.3)))
    assert still.notes == along.notes != ()
    np.testing.assert_allclose(along.velocities - (0.4, -0.3), still.velocities, atol=1e-12)


def test_robots_that_face_each_other_exchange_their_places() -> None:
    x = np.array([(0.0, 0.0), (4.0, 0.1), (2.0, 3.0)])
    places = np.array([(4.0, 0.0), (0.0, 0.0), (2.0, 4.0)])
    anyone = np.ones((3, 3), dtype=bool)
    assert exchange(x, places, (0, 1, 2), anyone, 0.7) == (1, 0, 2)
    assert exchange(x, places, (1, 0, 2), anyone, 0.7) is None
    assert exchange(x, places, (0, 1, 2), np.eye(3, dtype=bool), 0.7) is None
    assert exchange(x, places + np.array([(0, 3.0), (0, -3.0), (0, 0)]), (0, 1, 2), anyone, 0.7) is None


@pytest.mark.parametrize("seed", range(30))
def test_exchanges_shorten_the_sum_of_squares_and_leave_nobody_in_the_way_who_could_exchange(
    seed: int,
) -> None:
    rng = stream(seed, "exchange")
    n = 8
    x, places = rng.uniform(0, 8, (2, n, 2))
    order = rng.permutation(n).tolist()
    kinds = rng.integers(0, 2, n)
    movable = kinds[:, None] == kinds[None]
    found = exchange(x, places, order, movable, 0.8) or tuple(order)
    assert sorted(found) == list(range(n))
    assert [kinds[robot] for robot in found] == [kinds[robot] for robot in order]

    def squares(who: tuple[int, ...]) -> float:
        return float(((x[list(who)] - places) ** 2).sum())

    near = planning.approaches(x[list(found)], places) < 0.8
    for i in range(n):
        for j in range(i):
            if near[i, j] and movable[found[i], found[j]]:
                swapped = list(found)
                swapped[i], swapped[j] = swapped[j], swapped[i]
                assert squares(tuple(swapped)) > squares(found) - 0.011
    if found != tuple(order):
        assert squares(found) < squares(tuple(order))
