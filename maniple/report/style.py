"""How figures look: made for one column of a paper, told apart without colours, the same bytes every time."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from maniple.core.palette import COLOURS
from maniple.report.samples import Band
from maniple.report.timeline import FaultKind, Injected

BLUE, RED, GREEN, PURPLE, ORANGE, SKY = COLOURS
INK, STONE, FAINT = "#222222", "#8C8C8C", "#D9D9D9"

STRIPES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.5, 1.2, 1.5)))
"""Line styles."""

WIDTH_IN = 3.5
"""One column."""

MANY = 8
"""More robots or triangles than this are shown together, by their extremes, quartiles and median."""

LOOK: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 2.5,
    "axes.labelpad": 2.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.35,
    "lines.linewidth": 0.9,
    "xtick.major.size": 2,
    "ytick.major.size": 2,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.pad": 2,
    "ytick.major.pad": 2,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.2,
    "legend.borderaxespad": 0.2,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "svg.hashsalt": "maniple",
    "svg.fonttype": "path",
}
"""Settings of matplotlib that hold while a figure is drawn and saved."""

INJECTED: Mapping[FaultKind, tuple[str, dict[str, Any]]] = {
    "killed": ("killed", {"facecolor": "#DADADA", "edgecolor": "#8C8C8C", "lw": 0.4}),
    "links": ("link faults", {"facecolor": "#FBEFD5", "edgecolor": "#E6CF9C", "lw": 0.4}),
    "partition": ("partition", {"facecolor": "#E3EEF7", "edgecolor": "#A9C6DD", "lw": 0.4, "hatch": "//"}),
    "frozen": ("frozen", {"facecolor": "#E8E0EC", "edgecolor": "#B9A3C4", "lw": 0.4, "hatch": "\\\\"}),
}
"""How what is injected is drawn, the lowest first."""

HANDLE_EM = 2.2 + 0.8 + 1.2
"""Width of what is beside a text in a legend: handle, gap, gap between columns."""

PNG_DPI = 300

_BARE: Mapping[str, dict[str, Any]] = {
    ".svg": {"Date": None, "Creator": "maniple"},
    ".png": {"Software": None},
}


def sheet(height_in: float) -> Figure:
    """An empty figure of one column's width."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.02, wspace=0.02)  # type: ignore[union-attr,call-arg]
    return figure


def panels(figure: Figure, rows: int, columns: int = 1, **options: Any) -> list[list[Axes]]:
    """Axes in rows and columns that share their time axis; only the lowest say what it is."""
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, **options)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    return [list(row) for row in grid]


def save(figure: Figure, path: Path) -> None:
    """Write a figure; the suffix chooses PNG or SVG. The same figure gives the same bytes."""
    with rc_context(LOOK):
        figure.draw_without_rendering()  # the layout settles, as axes that became smaller have other labels
        figure.savefig(path, dpi=PNG_DPI, metadata=_BARE[path.suffix])


def shade(axes: Iterable[Axes], injected: Sequence[Injected], end_s: float) -> list[Artist]:
    """Bands behind lines over time where faults were on, and the rows of their legend. What was on all the
    time would be behind everything, and is left out; of who was killed for good there is the moment."""
    axes = list(axes)
    rows: list[Artist] = []
    passing = [
        one._replace(end=one.begin) if one.kind == "killed" and one.end >= end_s else one
        for one in injected
        if not lasts(one, end_s)
    ]
    for kind, (label, how) in INJECTED.items():
        spans = union(passing, kind)
        for one in axes:
            for begin, end in spans:
                one.axvspan(begin, max(end, begin + 0.002 * end_s), alpha=0.6, zorder=0.3, **how)
        if spans:
            rows.append(patch(label, **how))
    return rows


def lasts(one: Injected, end_s: float) -> bool:
    """Whether something is on all the time."""
    return one.end - one.begin > 0.98 * end_s


def union(injected: Iterable[Injected], kind: str) -> list[tuple[float, float]]:
    """When anything of a kind was on."""
    spans: list[tuple[float, float]] = []
    for begin, end, _, _ in sorted(one for one in injected if one.kind == kind):
        if spans and begin <= spans[-1][1]:
            spans[-1] = spans[-1][0], max(end, spans[-1][1])
        else:
            spans.append((begin, end))
    return spans


def look(index: int) -> dict[str, Any]:
    """Colour and line style of the robot or triangle `index`."""
    return {"color": COLOURS[index % len(COLOURS)], "ls": STRIPES[index % len(STRIPES)]}


def row(label: str, **how: Any) -> Line2D:
    """A line of a legend."""
    return Line2D([], [], label=label, **how)


def patch(label: str, **how: Any) -> Patch:
    """A filled box of a legend."""
    return Patch(label=label, **how)


def legend(figure: Figure, rows: Sequence[Artist], columns: int) -> None:
    """A legend below everything, in as many columns as fit, at most `columns`."""
    if rows:
        wanted = next((k for k in range(min(columns, len(rows)), 1, -1) if _fits(rows, k)), 1)
        figure.legend(handles=list(rows), loc="outside lower center", ncols=wanted)


def _fits(rows: Sequence[Artist], columns: int) -> bool:
    """Whether a legend of so many columns is no wider than the figure, by its letters."""
    em_in = LOOK["legend.fontsize"] / 72
    texts = [str(one.get_label()) for one in rows]
    parts = np.array_split([3 if "$" in text else len(text) for text in texts], columns)
    letters = sum(max(part, default=0) for part in map(list, parts))
    return bool(em_in * (0.58 * letters + columns * HANDLE_EM - 1.2) < WIDTH_IN)


def draw_band(axes: Axes, band: Band, colour: str, stripe: Any = "-") -> None:
    """Extremes and quartiles as areas, the median as a line."""
    if not len(band.t):
        return
    low, first, middle, third, high = band.levels
    axes.fill_between(band.t, low, high, color=colour, alpha=0.18, lw=0)
    axes.fill_between(band.t, first, third, color=colour, alpha=0.30, lw=0)
    axes.plot(band.t, middle, color=colour, ls=stripe)


def band_rows(colour: str, of: str) -> list[Artist]:
    """The legend of a band."""
    return [
        row(f"median {of}", color=colour),
        patch("middle half", color=colour, alpha=0.45, lw=0),
        patch("all", color=colour, alpha=0.18, lw=0),
    ]


def thinned(t: Any, values: Any, most: int = 4000) -> tuple[Any, Any]:
    """At most about `most` points of a line, its extremes among them."""
    if len(t) <= most:
        return t, values
    groups = np.array_split(np.arange(len(t)), most // 2)
    keep: list[int] = []
    for group in groups:
        part = values[group]
        if np.isnan(part).all():
            keep.append(int(group[0]))
            continue
        keep += sorted({int(group[np.nanargmin(part)]), int(group[np.nanargmax(part)])})
        keep += group[np.isnan(part)].tolist()
    order = np.unique(keep)
    return t[order], values[order]


def shared_limits(axes: Iterable[Axes], low: float, high: float, least: float) -> None:
    """The same y limits around [low, high] for all, at least `least` apart."""
    if not np.isfinite([low, high]).all():
        low = high = 0.0
    middle, half = 0.5 * (low + high), max(0.5 * (high - low) * 1.06, 0.5 * least)
    for one in axes:
        one.set_ylim(middle - half, middle + half)
