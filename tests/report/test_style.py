"""Bands behind lines where faults were on."""

from maniple.report.style import INJECTED, panels, shade, sheet, union
from maniple.report.timeline import Injected

ONES = (
    Injected(0.0, 100.0, "links", "* to *"),
    Injected(10.0, 20.0, "links", "r1 to *"),
    Injected(15.0, 25.0, "links", "r2 to *"),
    Injected(25.0, 30.0, "links", "r3 to *"),
    Injected(50.0, 50.0, "killed", "r4"),
    Injected(60.0, 70.0, "killed", "r5"),
    Injected(80.0, 100.0, "killed", "r6"),
)


def test_the_union_of_what_overlaps() -> None:
    assert union(ONES[1:], "links") == [(10.0, 30.0)]
    assert union(ONES, "links") == [(0.0, 100.0)]
    assert union(ONES, "killed") == [(50.0, 50.0), (60.0, 70.0), (80.0, 100.0)]
    assert union(ONES, "frozen") == []


def test_bands_behind_every_panel_but_not_for_what_is_on_all_the_time() -> None:
    grid = panels(sheet(2.0), 2)
    rows = shade((axes for (axes,) in grid), ONES, 100.0)
    assert [row.get_label() for row in rows] == [INJECTED[kind][0] for kind in ("killed", "links")]
    for (axes,) in grid:
        spans = [patch.get_extents().transformed(axes.transData.inverted()) for patch in axes.patches]
        assert [(round(span.x0, 6), round(span.x1, 6)) for span in spans] == [
            (50, 50.2),
            (60, 70),
            (80, 80.2),
            (10, 30),
        ]
        assert all(patch.get_zorder() < 1 for patch in axes.patches)


def test_no_faults_no_bands() -> None:
    grid = panels(sheet(2.0), 1)
    assert shade([grid[0][0]], (), 10.0) == []
    assert not grid[0][0].patches
