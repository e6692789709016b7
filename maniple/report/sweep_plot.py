"""Pictures of a sweep: a figure of the runs against a field of the scenario."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from maniple.core.geometry import Floats
from maniple.report import style
from maniple.report.sweep_types import Plot

Table: TypeAlias = Mapping[str, Sequence[Any]]
"""Values of each run, by column."""

Runs: TypeAlias = np.ndarray[tuple[int], np.dtype[np.bool_]]
"""Which runs, shape (k,)."""

MARKERS = "osD^vP"


class Edge(NamedTuple):
    """A predicted edge of stability."""

    label: str
    look: Mapping[str, Any]


EDGES = {
    "tolerated_delay_s": Edge("rule of thumb", {"ls": (0, (4, 2)), "lw": 0.8}),
    "delay_margin_s": Edge("linearised loop", {"ls": (0, (1, 1.2)), "lw": 1.0}),
}
"""By the column that has the delay of the whole loop."""


class Curve(NamedTuple):
    """The runs of one line, by their x."""

    x: Floats
    """Rising, shape (k,)."""
    low: Floats
    """Least value over the runs at each x; nan where none has one."""
    middle: Floats
    """The median, or the share of the runs that is true."""
    high: Floats


def write(plot: Plot, table: Table, path: Path) -> None:
    """Draw a picture of the results of a sweep and save it; the suffix chooses PNG or SVG."""
    with rc_context(style.LOOK):
        figure = draw(plot, table)
    style.save(figure, path)


def draw(plot: Plot, table: Table) -> Figure:
    """A panel for each value of `plot.facets`, a line for each value of `plot.series`."""
    panels, lines = levels(table, plot.facets), levels(table, plot.series)
    columns = 1 if len(panels) == 1 else 2
    rows = -(-len(panels) // columns)
    figure = style.sheet(0.6 + 1.4 * rows)
    if plot.title:
        figure.suptitle(plot.title, fontsize=style.LOOK["axes.titlesize"])
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    edges: set[str] = set()
    for panel, axes in zip(panels, grid.flat, strict=False):
        chosen = where(table, {plot.facets: panel})
        alike = all(len(edge_of(table, plot, chosen, column)) <= 1 for column in EDGES)
        for index, line in enumerate(lines):
            runs = chosen & where(table, {plot.series: line})
            _draw_curve(axes, curve(table, plot, runs), index)
            edges |= _draw_edges(axes, plot, table, runs, style.INK if alike else style.look(index)["color"])
        if plot.facets:
            axes.set_title(panel if isinstance(panel, str) else f"{plot.facets} {shown(panel)}")
    _label(plot, grid, len(panels))
    _scale(plot, grid[0][0], table)
    style.legend(figure, list(_rows(plot, lines, edges)), len(lines) + 2)
    return figure


def levels(table: Table, name: str) -> list[Any]:
    """The values of a column, each once, in the order of the runs; [None] without a name."""
    return list(dict.fromkeys(table[name])) if name else [None]


def where(table: Table, values: Mapping[str, Any]) -> Runs:
    """Which runs have these values; a column without a name says nothing."""
    count = len(next(iter(table.values())))
    chosen = np.ones(count, dtype=np.bool_)
    for name, value in values.items():
        if name:
            chosen &= np.array([cell == value for cell in table[name]], dtype=np.bool_)
    return chosen


def curve(table: Table, plot: Plot, runs: Runs) -> Curve:
    """What some runs have for `plot.y`, by their `plot.x`: least, median and largest, or the share that is
    true. Runs without a value (None) are left out."""
    xs = np.array(table[plot.x], dtype=np.float64)[runs]
    cells = [table[plot.y][index] for index in np.flatnonzero(runs).tolist()]
    values = np.array([np.nan if cell is None else float(cell) for cell in cells])
    values = np.clip(values, plot.y_min, plot.y_max) if plot.y_min or plot.y_max else values
    share = any(isinstance(cell, bool) for cell in cells)
    places = np.unique(xs)
    found = np.full((3, len(places)), np.nan)
    for index, place in enumerate(places):
        here = values[(xs == place) & ~np.isnan(values)]
        if here.size:
            middle = here.mean() if share else np.median(here)
            found[:, index] = (middle, middle, middle) if share else (here.min(), middle, here.max())
    return Curve(places, *found)


def edge_of(table: Table, plot: Plot, runs: Runs, column: str) -> list[float]:
    """Where on the x axis the loop of these runs is predicted to lose its stability, each place once."""
    if plot.edge is None:
        return []
    delays = {table[column][index] for index in np.flatnonzero(runs).tolist()} - {None}
    return sorted({round(delay / plot.edge, 9) for delay in delays})


def shown(value: Any) -> str:
    """A value of an axis in a title or a legend."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _draw_curve(axes: Axes, found: Curve, index: int) -> None:
    look = style.look(index)
    axes.fill_between(found.x, found.low, found.high, color=look["color"], alpha=0.18, lw=0)
    axes.plot(found.x, found.middle, marker=MARKERS[index % len(MARKERS)], ms=2.2, **look)


def _draw_edges(axes: Axes, plot: Plot, table: Table, runs: Runs, colour: str) -> set[str]:
    """Draw the predicted edges of these runs that are on the x axis; returns which there are."""
    xs, drawn = table[plot.x], set()
    for column, edge in EDGES.items():
        for place in edge_of(table, plot, runs, column):
            if min(xs) <= place <= max(xs):
                axes.axvline(place, color=colour, **edge.look)
                drawn.add(column)
    return drawn


def _label(plot: Plot, grid: Any, panels: int) -> None:
    columns = grid.shape[1]
    for index, axes in enumerate(grid.flat):
        if index >= panels:
            axes.remove()
            continue
        if index % columns == 0:
            axes.set_ylabel(plot.y_label or plot.y)
        if index + columns >= panels:
            axes.set_xlabel(plot.x_label or plot.x)
            axes.tick_params(labelbottom=True)


def _scale(plot: Plot, axes: Axes, table: Table) -> None:
    """The axes that all panels share."""
    xs = table[plot.x]
    low, high = min(xs), max(xs)
    if plot.log_x:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlim(low / 1.25, high * 1.25)
    else:
        margin = 0.04 * (high - low) or 0.5
        axes.set_xlim(low - margin, high + margin)
    if plot.log and any(cell is not None and cell > 0 for cell in table[plot.y]):
        axes.set_yscale("log")
    elif any(isinstance(cell, bool) for cell in table[plot.y]):
        axes.set_ylim(-0.05, 1.05)


def _rows(plot: Plot, lines: Sequence[Any], edges: Collection[str]) -> Iterator[Artist]:
    for index, line in enumerate(lines):
        if plot.series:
            label = f"{plot.series_label or plot.series} {shown(line)}"
            yield style.row(label, marker=MARKERS[index % len(MARKERS)], ms=2.2, **style.look(index))
    for column, edge in EDGES.items():
        if column in edges:
            yield style.row(edge.label, color=style.INK, **edge.look)
