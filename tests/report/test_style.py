"""Bands behind lines where faults were on."""

from pathlib import Path

from matplotlib import rc_context

from maniple.report.style import BLUE, INJECTED, LOOK, PNG_DPI, legend, panels, row, save, shade, sheet, union
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


def test_labels_are_inside_the_picture(tmp_path: Path) -> None:
    """Axes that became smaller in the layout have other ticks, with longer labels."""
    with rc_context(LOOK):
        figure = sheet(3.6)
        grid = [axes for row in panels(figure, 3, 2) for axes in row]
        for axes, top in zip(grid, (0.13, 0.0087, 0.0216, 0.0057, 1.09, 0.32), strict=True):
            axes.plot([0, 22.5], [0, top])
            axes.set_ylim(axes.get_ylim()[0], 1.04 * axes.get_ylim()[1])
            axes.set_ylabel("p, q [m]")
        legend(figure, [row("A", color=BLUE), row("B", color=BLUE)], 2)
        save(figure, tmp_path / "a.png")
    for axes in grid:
        assert axes.yaxis.label.get_window_extent(dpi=PNG_DPI).x0 >= 0
