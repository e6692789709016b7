"""Pictures of two runs side by side."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maniple.core.errors import ArgumentError, ManipleError
from maniple.core.geometry import Floats
from maniple.report import figures, style
from maniple.report.comparison import Pair, difference
from maniple.report.panels import line
from maniple.report.samples import Track, band
from maniple.report.style import (
    BLUE,
    INK,
    MANY,
    RED,
    STRIPES,
    legend,
    look,
    panels,
    row,
    shared_limits,
    sheet,
)

A_LOOK = {"color": BLUE, "ls": "-", "lw": 1.3, "alpha": 0.85}
B_LOOK = {"color": RED, "ls": STRIPES[1], "lw": 0.9}

_LEAST = 1e-9
"""Differences smaller than this share of the largest are not shown."""

_DECADE = 12.0
"""What the largest is at least of the least on the axis: less than a decade has no ticks that can be read."""

_LABELS = {
    "position_m": "position [m]",
    "orientation_rad": "orientation [rad]",
    "distance_m": "p, q [m]",
    "angle_rad": r"$\beta$ [rad]",
    "u_mps": "u [m/s]",
    "w_radps": "w [rad/s]",
    "vx_mps": r"$v_x$ [m/s]",
    "vy_mps": r"$v_y$ [m/s]",
}


def write(pairs: Sequence[Pair], names: tuple[str, str], folder: Path) -> tuple[Path, ...]:
    """Draw what there is to see and save each picture as PNG and SVG; `names` are those of A and B.

    Raises:
        ArgumentError: the folder is not one.
        ManipleError: they can't be written.
    """
    drawn: list[Path] = []
    try:
        if folder.exists() and not folder.is_dir():
            raise ArgumentError(f"{folder} is not a folder; --plot must name one, or nothing that exists")
        folder.mkdir(parents=True, exist_ok=True)
        for stem, draw in _KINDS.items():
            with rc_context(style.LOOK):
                figure = draw(pairs, names)
            if figure is None:
                for suffix in (".png", ".svg"):
                    (folder / f"{stem}{suffix}").unlink(missing_ok=True)
            else:
                drawn += figures.write(figure, folder / stem)
    except OSError as error:
        raise ManipleError(f"{folder}: can't write the pictures: {error.strerror or error}") from None
    return tuple(drawn)


def formation(pairs: Sequence[Pair], names: tuple[str, str]) -> Figure | None:
    """Formation errors of both runs, how near anything came, and how old what was acted on was. None without
    any of them."""
    known = {pair.name: pair for pair in pairs}
    errors = next((known[name] for name in ("formation/error", "formation/estimate") if name in known), None)
    seen = "" if errors is None or errors.name == "formation/error" else " (as the controller sees it)"
    drawings: list[tuple[str, Track, Track, int]] = []
    if errors is not None:
        drawings = [(_LABELS[f], errors.a, errors.b, column) for column, f in enumerate(errors.fields)]
    for label, part, column, worst in (
        ("clearance [m]", "clearance", 0, np.fmin),
        ("command age [s]", "command_age", 1, np.fmax),
    ):
        found = [pair for pair in pairs if pair.name.endswith(f"/{part}")]
        if found:
            sides = ([pair.a for pair in found], [pair.b for pair in found])
            a, b = (_worst(side, column, worst) for side in sides)
            drawings.append((label, a, b, 0))
    if not drawings:
        return None
    figure = sheet(0.95 * -(-len(drawings) // 2) + 0.75)
    grid = list(chain.from_iterable(panels(figure, -(-len(drawings) // 2), 2)))
    for axes, (label, a, b, column) in zip(grid, drawings, strict=False):
        line(axes, a, column, **A_LOOK)
        line(axes, b, column, **B_LOOK)
        axes.set_ylabel(label)
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), 1.04 * high)
    for axes in grid[len(drawings) :]:
        axes.remove()
    if seen:
        figure.suptitle(f"errors{seen}", fontsize=style.LOOK["axes.titlesize"])
    legend(figure, _rows(names), 2)
    return figure


def commands(pairs: Sequence[Pair], names: tuple[str, str]) -> Figure | None:
    """What the controller told the robots: a row for each, or all together. None where that is not known."""
    return _robots(_told(pairs, "command"), names)


def drives(pairs: Sequence[Pair], names: tuple[str, str]) -> Figure | None:
    """What the drives were told after the guard, likewise."""
    return _robots(_told(pairs, "drive"), names)


def _robots(told: Sequence[Pair], names: tuple[str, str]) -> Figure | None:
    if not told:
        return None
    if len(told) > MANY:
        return _robots_together(told, names)
    figure = sheet(0.78 * len(told) + 0.75)
    grid = panels(figure, len(told), 2)
    for pair, both in zip(told, grid, strict=True):
        for column, axes in enumerate(both):
            line(axes, pair.a, column, **A_LOOK)
            line(axes, pair.b, column, **B_LOOK)
            axes.set_ylabel(_LABELS[pair.fields[column]])
        both[0].set_title(_robot(pair))
    for column in range(2):
        shared_limits([both[column] for both in grid], *_range(told, column), 0.02)
    legend(figure, _rows(names), 2)
    return figure


def _robots_together(told: Sequence[Pair], names: tuple[str, str]) -> Figure:
    figure = sheet(3.3)
    for column, (axes,) in enumerate(panels(figure, 2)):
        style.draw_band(axes, band([(pair.a.t, pair.a.values[:, column]) for pair in told]), BLUE)
        other = band([(pair.b.t, pair.b.values[:, column]) for pair in told])
        for level in other.levels[[0, 2, 4]]:
            axes.plot(other.t, level, color=RED, lw=0.7, ls=STRIPES[1])
        axes.set_ylabel(_LABELS[told[0].fields[column]])
        shared_limits([axes], *_range(told, column), 0.02)
    rows = style.band_rows(BLUE, f"of {len(told)} robots, A: {names[0]}")
    legend(figure, [*rows, row(f"B: {names[1]}: least, median, largest", **B_LOOK)], 2)
    return figure


def differences(pairs: Sequence[Pair], _: tuple[str, str]) -> Figure | None:
    """How far the robots' places and commands are apart over time, on a logarithmic scale. None where they
    never are."""
    drawings: list[tuple[str, list[tuple[str, Floats, Floats]]]] = []
    places = [pair for pair in pairs if pair.name.endswith("/pose")]
    if places:
        drawings.append(("place [m]", [(_robot(pair), *_hypot(pair)) for pair in places]))
    for what in ("command", "drive"):
        told = _told(pairs, what)
        for column, field in enumerate(told[0].fields[:2] if told else ()):
            rows = [(_robot(pair), *_size(pair, column)) for pair in told]
            drawings.append((f"{what} {_LABELS[field]}", rows))
    drawings = [(label, rows) for label, rows in drawings if any((off > 0).any() for _, _, off in rows)]
    if not drawings:
        return None
    figure = sheet(1.2 * len(drawings) + 0.8)
    few = max(len(rows) for _, rows in drawings) <= MANY
    for (axes,), (label, rows) in zip(panels(figure, len(drawings)), drawings, strict=True):
        _draw_sizes(axes, rows, few)
        axes.set_title(f"|A - B|: {label}")
    known = {name: look(index) for _, rows in drawings for index, (name, t, _) in enumerate(rows) if len(t)}
    handles: list[Artist] = [row(name, **known[name]) for name in known]
    legend(figure, handles if few else style.band_rows(INK, f"of {len(known)} robots"), 6)
    return figure


_KINDS: Mapping[str, Callable[[Sequence[Pair], tuple[str, str]], Figure | None]] = {
    "formation": formation,
    "commands": commands,
    "drives": drives,
    "differences": differences,
}
"""What draws each picture, by the name of its files."""


def _told(pairs: Sequence[Pair], what: str) -> list[Pair]:
    return [pair for pair in pairs if pair.name.endswith(f"/{what}")]


def _range(pairs: Sequence[Pair], column: int) -> tuple[float, float]:
    """Least and largest value of a column on both sides, 0 among them."""
    values = np.concatenate([side.values[:, column] for pair in pairs for side in (pair.a, pair.b)])
    return float(np.nanmin(values, initial=0.0)), float(np.nanmax(values, initial=0.0))


def _robot(pair: Pair) -> str:
    return pair.name.split("/")[1]


def _rows(names: tuple[str, str]) -> list[Artist]:
    return [row(f"A: {names[0]}", **A_LOOK), row(f"B: {names[1]}", **B_LOOK)]


def _worst(tracks: Sequence[Track], column: int, worst: np.ufunc) -> Track:
    """The least, or largest, of one column of several tracks, each as it was told last."""
    known = [track for track in tracks if len(track.t)]
    if not known:
        return Track(np.empty(0), np.empty((0, 1)))
    times = np.unique(np.concatenate([track.t for track in known]))
    values = np.full(len(times), np.nan)
    for track in known:
        last = np.searchsorted(track.t, times, side="right") - 1
        worst(values, np.where(last < 0, np.nan, track.values[last, column]), out=values)
    return Track(times, values[:, None])


def _hypot(pair: Pair) -> tuple[Floats, Floats]:
    t, _, _, x = difference(pair, 0)
    _, _, _, y = difference(pair, 1)
    return t, np.hypot(x, y)


def _size(pair: Pair, column: int) -> tuple[Floats, Floats]:
    t, _, _, off = difference(pair, column)
    return t, np.abs(off)


def _draw_sizes(axes: Axes, rows: Sequence[tuple[str, Floats, Floats]], few: bool) -> None:
    """Sizes over time; where there is no difference there is no line."""
    parts = [(t, np.where(off > 0, off, np.nan)) for _, t, off in rows]
    if few:
        for index, (t, off) in enumerate(parts):
            axes.plot(*style.thinned(t, off), **look(index))
    else:
        style.draw_band(axes, band(parts), INK)
    axes.set_yscale("log")
    top = max(float(np.nanmax(off, initial=0.0)) for _, off in parts)
    axes.set_ylim(bottom=min(max(axes.get_ylim()[0], top * _LEAST), top / _DECADE))
