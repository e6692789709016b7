import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator

from maniple.core.errors import ScenarioError
from maniple.core.geometry import wrap
from maniple.core.scenario.types import (
    Csv,
    FigureEight,
    Leg,
    Line,
    Orbit,
    Positioning,
    Samples,
    Waypoints,
)
from maniple.core.scenario.ways import REST, rounded, way_of

SLOW = settings(deadline=None, derandomize=True, max_examples=80)
STEP_S = 1e-5

metres = st.floats(-20, 20)
headings = st.floats(-math.pi, math.pi)
facings = st.sampled_from(["along", "fixed"])
points = st.tuples(st.integers(-40, 40), st.integers(-40, 40)).map(lambda p: (p[0] / 2, p[1] / 2))
speeds = st.floats(0.05, 1.5)


def turns_back(way: list[tuple[float, float]]) -> bool:
    """Whether a way repeats a point or comes straight back."""
    if any(a == b for a, b in pairwise(way)):
        return True
    angles = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(way)]
    return any(abs(wrap(b - a)) > 3.0 for a, b in pairwise(angles))


legs = st.one_of(
    st.builds(Line, start=points, end=points, speed_mps=speeds).filter(lambda leg: leg.start != leg.end),
    st.builds(
        Waypoints,
        points=st.lists(points, min_size=2, max_size=6).filter(lambda way: not turns_back(way)).map(tuple),
        radius_m=st.floats(0.3, 8),
        speed_mps=speeds,
        facing=facings,
    ),
    st.builds(
        Orbit,
        centre=points,
        radius_m=st.floats(0.5, 20),
        speed_mps=speeds,
        turns=st.floats(0.1, 3),
        clockwise=st.booleans(),
        start_rad=headings,
        facing=facings,
    ),
    st.builds(
        FigureEight,
        centre=points,
        size_m=st.floats(0.5, 20),
        speed_mps=speeds,
        laps=st.floats(0.1, 3),
        angle_rad=headings,
        facing=facings,
    ),
    st.builds(
        lambda gaps, poses: Samples(
            times_s=tuple(np.concatenate([[0.0], np.cumsum(gaps)])), poses=tuple(poses[: len(gaps) + 1])
        ),
        gaps=st.lists(st.floats(0.2, 5), min_size=1, max_size=5),
        poses=st.lists(st.tuples(metres, metres, headings), min_size=6, max_size=6),
    ),
)


@SLOW
@given(leg=legs, share=st.floats(0.001, 0.998))
def test_the_velocity_is_the_derivative_of_the_pose(leg: Leg, share: float) -> None:
    way = way_of(leg)
    t = share * way.travel_s
    before, here, after = (way.at(t + k * STEP_S) for k in (-1, 0, 1))
    if np.abs(np.subtract(before[1], after[1])).max() > 1e-3 * (1.0 + np.abs(here[1]).max()):
        return  # between two arcs, where the turning rate jumps
    moved = (*np.subtract(after[0][:2], before[0][:2]), wrap(after[0].psi - before[0].psi))
    assert here[1] == pytest.approx(np.array(moved) / (2 * STEP_S), rel=1e-4, abs=1e-6)


@SLOW
@given(leg=legs)
def test_the_way_has_no_jumps(leg: Leg) -> None:
    way = way_of(leg)
    times = np.linspace(0.0, way.travel_s, 400)
    poses = [way.at(float(t))[0] for t in times]
    fastest = np.hypot(*way.twists()[:, :2].T).max()
    for (a, b), gap in zip(pairwise(poses), np.diff(times), strict=True):
        assert math.dist(a[:2], b[:2]) <= 1.01 * fastest * gap + 1e-9


@SLOW
@given(leg=legs, share=st.floats(0, 0.999))
def test_no_moment_is_outside_the_extremes(leg: Leg, share: float) -> None:
    way = way_of(leg)
    _, (vx, vy, turning) = way.at(share * way.travel_s)
    twists = way.twists()
    slack = 1.03 if isinstance(leg, Samples) else 1.0 + 1e-4
    assert math.hypot(vx, vy) <= slack * np.hypot(twists[:, 0], twists[:, 1]).max() + 1e-12
    assert abs(turning) <= slack * np.abs(twists[:, 2]).max() + 1e-9


@SLOW
@given(leg=legs, share=st.floats(0, 0.999))
def test_paths_are_travelled_at_their_speed(leg: Leg, share: float) -> None:
    if isinstance(leg, Samples | Csv | Positioning):
        return
    pose, (vx, vy, turning) = way_of(leg).at(share * way_of(leg).travel_s)
    assert math.hypot(vx, vy) == pytest.approx(leg.speed_mps)
    if getattr(leg, "facing", "along") == "along":
        assert math.atan2(vy, vx) == pytest.approx(pose.psi, abs=1e-9) or abs(pose.psi) > 3.14
    else:
        assert turning == 0.0
        assert pose.psi == way_of(leg).at(0.0)[0].psi


# -- waypoints


def test_a_corner_is_an_arc_tangent_to_both_lines() -> None:
    first, arc, last = rounded([(0, 0), (4, 0), (4, 4)], 1.0)
    assert first.length_m == pytest.approx(3.0)
    assert arc.start == pytest.approx((3, 0, 0))
    assert (arc.length_m, arc.curvature) == pytest.approx((math.pi / 2, 1.0))
    assert last.start == pytest.approx((4, 1, math.pi / 2))
    assert last.length_m == pytest.approx(3.0)


def test_an_arc_shrinks_where_there_is_no_room() -> None:
    """Two corners share a line of 1 m: each may use half of it."""
    arcs = rounded([(0, 0), (4, 0), (4, 1), (8, 1)], 2.0)
    assert [arc.curvature for arc in arcs] == pytest.approx([0, 2, -2, 0])
    assert sum(arc.length_m for arc in arcs) == pytest.approx(3.5 + math.pi / 2 + 3.5)


@SLOW
@given(way=st.lists(points, min_size=3, max_size=6).filter(lambda way: not turns_back(way)))
def test_every_arc_starts_where_and_as_the_one_before_ends(way: list[tuple[float, float]]) -> None:
    arcs = rounded(way, 3.0)
    for one, after in pairwise(arcs):
        end = one.start.advance(one.length_m, one.length_m * one.curvature)
        assert end[:2] == pytest.approx(after.start[:2], abs=1e-9)
        assert wrap(end.psi - after.start.psi) == pytest.approx(0, abs=1e-9)
    end = arcs[-1].start.advance(arcs[-1].length_m, arcs[-1].length_m * arcs[-1].curvature)
    assert end[:2] == pytest.approx(way[-1], abs=1e-9)


def test_points_in_a_line_need_no_arc() -> None:
    way = way_of(Waypoints(points=((0, 0), (1, 1), (3, 3)), speed_mps=0.5))
    assert way.travel_s == pytest.approx(math.hypot(3, 3) / 0.5)
    assert way.at(way.travel_s)[0] == pytest.approx((3, 3, math.pi / 4))
    assert not way.twists()[:, 2].any()


# -- circle and figure eight


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_circle_is_what_sines_and_cosines_say(clockwise: bool) -> None:
    leg = Orbit(centre=(1, 2), radius_m=3, speed_mps=0.6, turns=2.25, clockwise=clockwise, start_rad=0.3)
    way, rate = way_of(leg), (-0.2 if clockwise else 0.2)
    assert way.travel_s == pytest.approx(2.25 * 2 * math.pi * 3 / 0.6)
    for t in np.linspace(0, way.travel_s, 50):
        pose, velocity = way.at(float(t))
        angle = 0.3 + rate * t
        assert pose[:2] == pytest.approx((1 + 3 * math.cos(angle), 2 + 3 * math.sin(angle)))
        assert velocity == pytest.approx((-3 * rate * math.sin(angle), 3 * rate * math.cos(angle), rate))


def test_a_figure_eight_is_as_long_as_its_integral() -> None:
    length, _ = quad(lambda a: math.hypot(math.cos(a), math.cos(2 * a)), 0, 2 * math.pi, epsabs=1e-12)
    way = way_of(FigureEight(centre=(0, 0), size_m=4, speed_mps=1, laps=3))
    assert way.travel_s == pytest.approx(3 * 4 * length, rel=1e-9)


def test_a_figure_eight_lies_on_its_curve_at_the_right_arc_length() -> None:
    way = way_of(FigureEight(centre=(0, 0), size_m=4, speed_mps=1))
    for a in np.linspace(0.05, 6.2, 25):
        s, _ = quad(lambda b: 4 * math.hypot(math.cos(b), math.cos(2 * b)), 0, a, epsabs=1e-12, limit=200)
        pose, _ = way.at(s)
        assert pose[:2] == pytest.approx((4 * math.sin(a), 4 * math.sin(a) * math.cos(a)), abs=1e-8)


def test_a_figure_eight_starts_at_its_centre_and_goes_to_the_first_loop_first() -> None:
    leg = FigureEight(centre=(1, 2), size_m=3, speed_mps=1, angle_rad=math.pi / 2)
    way = way_of(leg)
    lap = way.travel_s
    assert way.at(0)[0][:2] == pytest.approx((1, 2))
    assert way.at(lap / 4)[0][:2] == pytest.approx((1, 5))
    assert way.at(lap / 2)[0][:2] == pytest.approx((1, 2), abs=1e-9)
    assert way.at(3 * lap / 4)[0][:2] == pytest.approx((1, -1))
    assert way.at(lap)[0][:2] == pytest.approx((1, 2), abs=1e-9)


# -- samples


@SLOW
@given(
    gaps=st.lists(st.floats(0.1, 5), min_size=1, max_size=8),
    xs=st.lists(metres, min_size=9, max_size=9),
    share=st.floats(0, 1),
)
def test_samples_are_joined_as_scipy_does(gaps: list[float], xs: list[float], share: float) -> None:
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    values = np.round(xs[: len(times)], 9)  # SciPy divides by slopes
    way = way_of(Samples(times_s=tuple(times), poses=tuple((x, -2 * x, 0.0) for x in values)))
    t = share * way.travel_s
    oracle = PchipInterpolator(times, values)
    pose, velocity = way.at(t)
    assert pose[:2] == pytest.approx((float(oracle(t)), -2 * float(oracle(t))), abs=1e-8)
    slope = float(oracle.derivative()(t))
    assert velocity == pytest.approx((slope, -2 * slope, 0), abs=1e-6, rel=1e-6)


def test_a_slope_that_is_almost_nothing_is_nothing() -> None:
    way = way_of(Samples(times_s=(0, 1, 2), poses=((0, 0, 1.0), (0, 0, 1e-309), (0, 0, 0))))
    assert way.at(1.0)[1] == (0, 0, 0)


def test_ways_are_as_long_as_their_chords() -> None:
    way = way_of(Samples(times_s=(0, 1, 3), poses=((0, 0, 0), (3, 4, 1), (3, 9, 1))))
    poses = [way.at(t)[0] for t in np.linspace(0, 3, 3001)]
    assert way.length_m == pytest.approx(sum(math.dist(a[:2], b[:2]) for a, b in pairwise(poses)), rel=1e-3)
    circle = way_of(Orbit(centre=(0, 0), radius_m=2, speed_mps=0.5, turns=1.5))
    assert circle.length_m == pytest.approx(6 * math.pi)
    assert way_of(Positioning(target=(1, 2, 3))).length_m == 0.0


def test_headings_take_the_shorter_way() -> None:
    way = way_of(Samples(times_s=(0, 1, 2), poses=((0, 0, 3.0), (1, 0, -3.0), (2, 0, -2.9))))
    turns = [way.at(t)[1][2] for t in (0.1, 0.5, 0.9)]
    assert all(0 < turn < 1 for turn in turns)
    assert abs(way.at(0.5)[0].psi) > 3.0


# -- others


def test_who_is_to_stand_stands() -> None:
    way = way_of(Positioning(target=(1, 2, 3)))
    assert way.at(0.0) == ((1, 2, 3), REST)
    assert way.travel_s == 0.0


def test_a_file_must_be_loaded_first() -> None:
    with pytest.raises(ScenarioError, match=r"the way in 'a\.csv' has not been loaded"):
        way_of(Csv(file="a.csv"))
