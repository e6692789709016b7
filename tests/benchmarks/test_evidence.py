"""The study behind docs/evidence.md, in a tiny form: the same figures each time, and right in known cases."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.evidence.__main__ import main
from benchmarks.evidence.figures import draw
from benchmarks.evidence.platoons import (
    CONTROL_POINT_M,
    DT_S,
    SEED,
    THETA,
    W_MAX,
    Case,
    Platoons,
    headings,
    places,
    starts,
)
from benchmarks.evidence.study import (
    FULL,
    Circle,
    Extent,
    Study,
    bound,
    converge,
    exact_bound,
    pushed,
    rises_in_fine_steps,
    study,
    trip,
    variants,
)
from benchmarks.evidence.tables import tables
from central_controller.chain import Chain
from maniple.control import unicycle
from maniple.core.geometry import Pose
from tests.pioneer import PIONEER

TINY = Extent((3, 6), 10, 100.0, 60.0)


@pytest.fixture(scope="module")
def tiny() -> Study:
    return study(TINY, workers=1)


@pytest.mark.slow
def test_the_same_starts_give_the_same_tables(tiny: Study) -> None:
    assert tables(study(TINY, workers=1)) == tables(tiny)


@pytest.mark.slow
def test_more_starts_or_other_chunks_change_none(tiny: Study) -> None:
    few, later = converge(Case(6), 0, 4, 100.0), converge(Case(6), 4, 6, 100.0)
    whole = tiny.outcomes[Case(6)]
    assert_array_equal(np.concatenate([few.time_s, later.time_s]), whole.time_s)
    assert_allclose(np.concatenate([few.rise, later.rise]), whole.rise, atol=1e-11)


def test_signed_gets_there_and_printed_does_if_it_starts_on_the_right_side(tiny: Study) -> None:
    for n in TINY.sizes:
        assert np.isfinite(tiny.outcomes[Case(n)].time_s).all()
        first = Chain(places(n)).triangles(starts(Case(n), TINY.starts)).variables()[:, 0, 5]
        right_side = first * Chain(places(n)).desired(Pose(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).q[0, 5] > 0
        assert 0 < right_side.sum() < TINY.starts
        printed = tiny.outcomes[Case(n, signed=False)]
        assert_array_equal(np.isfinite(printed.time_s), right_side)
        assert all(
            (kind is None) == right and (right or str(kind).startswith("mirrored"))
            for kind, right in zip(printed.category, right_side, strict=True)
        )


def test_no_platoon_is_there_before_its_saturated_centroid() -> None:
    """Which moves by L, 0.1 m/s, along x and y at most."""
    outcome = converge(Case(3), 0, 10, 100.0)
    far = np.abs((starts(Case(3), 10) - places(3)).mean(axis=1)).max(axis=-1)
    assert (outcome.time_s > (far - 0.4) / 0.10).all()


def test_v_of_the_first_triangle_never_rises(tiny: Study) -> None:
    for n in TINY.sizes:
        assert (tiny.outcomes[Case(n)].rise[:, 0] <= 1e-9).all()
    assert not rises_in_fine_steps(Case(3), 0)


def test_the_supervisor_leads_round_a_singular_triangle() -> None:
    """Start 191 of three robots passes R1 through the middle between the others within 1 cm."""
    law, supervised = trip(Case(3), 191, False, 20.0), trip(Case(3), 191, True, 20.0)
    assert law.nearest_m < 0.02
    assert law.fastest_mps > 3.0
    assert supervised.nearest_m > 0.1
    assert supervised.fastest_mps < 1.0


def test_errors_keep_within_the_bound(tiny: Study) -> None:
    for each in tiny.bounds.values():
        assert (each.error <= each.exact).all()
        assert (each.error > 0.1 * each.printed).all()
    assert_allclose(
        exact_bound(np.array([0.0, 0.05, -0.05, 0.1])), [0, *[0.4 * math.atanh(0.5)] * 2, math.inf]
    )


def test_a_push_stays_where_it_is_with_the_formation_as_reference() -> None:
    formation, neighbours = pushed(8, 2, 0.3)
    assert_allclose(np.delete(formation, 2), 0.0, atol=0.02)
    assert (neighbours[3:] > 0.01).all()
    assert formation[2] == pytest.approx(0.3) == neighbours[2]


def test_neighbours_of_every_platoon_are_its_own() -> None:
    case = Case(6, neighbours=True)
    positions = starts(case, 3)
    together = Platoons(case, positions, headings(case, 3)).desired()
    for k in range(3):
        alone = Chain(places(6), neighbours=True).desired(Pose(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), positions[k])
        assert_allclose(together.q[k], alone.q, atol=1e-12)
        assert_allclose(together.rates[k], alone.rates, atol=1e-12)


def test_pioneers_are_those_of_the_catalogue() -> None:
    assert PIONEER.theta == THETA
    assert PIONEER.w_max_radps == W_MAX
    case = Case(3, pioneers=True)
    platoons = Platoons(case, starts(case, 1), headings(case, 1))
    velocity, before = np.array([[[0.05, 0.1]] * 3]), platoons.positions.copy()
    assert platoons._robots is not None
    for _ in range(100):
        after = platoons._robots.move(velocity)
        before, platoons.positions = platoons.positions, after
    gained = (platoons.positions - before)[0] / DT_S
    for k, facing in enumerate(platoons._robots._travel[1].tolist()):
        u, w = unicycle.inverse(facing, CONTROL_POINT_M, 0.05, 0.1)
        assert_allclose(
            gained[k], unicycle.forward(facing, CONTROL_POINT_M, u / THETA[3], w / THETA[5]), atol=2e-3
        )


def test_a_circle_at_rest_needs_no_error() -> None:
    each = bound(Circle(4, 1e-9), 0, 2, 120.0)
    assert (each.error < 1e-4).all()


def test_command_and_pictures(tiny: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drawn = draw(tiny, tmp_path)
    assert [path.name for path in drawn][:1] == ["evidence-mirrored-at-rest.png"]
    with pytest.raises(SystemExit):
        main(["--quicker"])
    assert "usage: python -m benchmarks.evidence" in capsys.readouterr().err


def test_the_page_has_the_tables_of_the_command(tiny: Study) -> None:
    page = (Path(__file__).parents[2] / "docs" / "evidence.md").read_text(encoding="utf-8").splitlines()
    lines = tables(tiny).splitlines()
    for heading, after in pairwise(lines):
        if after.startswith("| ---"):
            assert heading in page
    assert f"Seed {SEED}, {FULL.starts} starts a line, horizon {FULL.horizon_s:g} s." in page
    for n in FULL.sizes:
        for case in variants(n):
            assert sum(line.startswith(f"| {n} | {case.variant} | ") for line in page) == 1 + (
                n == FULL.sizes[-1]
            )
