"""The figure of phases: what the controller and each robot were doing when."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maniple.report.series import Series
from maniple.report.style import (
    BLUE,
    FAINT,
    GREEN,
    INJECTED,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    STONE,
    lasts,
    legend,
    panels,
    patch,
    row,
    sheet,
    union,
)
from maniple.report.timeline import FaultKind, Span

MANY_ROWS = 12
"""More robots than this are counted instead of shown one by one."""

BANDS = {
    "waiting": (FAINT, ""),
    "forming": (SKY, "//"),
    "running": (GREEN, ""),
    "tracking": (GREEN, ""),
    "holding": (ORANGE, "\\\\"),
    "done": (BLUE, ""),
    "emergency": (RED, ""),
    "stopped": (RED, "xx"),
    "fault": (PURPLE, "++"),
    "lost": (INK, ""),
}
"""Colour and hatching of phases and modes."""

SLOW = 10
"""The rate of the reference is shown where more samples than this are below 1, as it is at every start."""

LETTER = 0.02
"""Width of a letter of a small text, as a share of the time shown."""

COUNTED = 300
"""Moments at which many robots are counted."""


def phases(series: Series) -> Figure | None:
    """Phases, modes, who was waited for, supervisor and contacts. None where nobody said anything."""
    robots = [robot for robot in series.robots if robot.modes or robot.lost]
    if not series.phases and not robots:
        return None
    few = len(robots) <= MANY_ROWS
    slows = bool((series.rate.values < 0.999).sum() > max(SLOW, 0.01 * len(series.rate.t)))
    kinds = [kind for kind in INJECTED if any(one.kind == kind for one in series.injected)]
    rows = 1 + (len(robots) if few else 0) + bool(series.notes) + len(kinds)
    heights = [0.15 * rows + 0.1, *([] if few else [0.9]), *([0.55] if slows else [])]
    figure = sheet(sum(heights) + 0.95)
    grid = panels(figure, len(heights), height_ratios=heights)
    axes, rest = grid[0][0], [line[0] for line in grid[1:]]
    names = ["platoon"]
    _bars(axes, 0, series.phases)
    if few:
        for robot in robots:
            names.append(robot.id)
            _bars(axes, len(names) - 1, robot.modes)
            _bars(axes, len(names) - 1, robot.lost)
            _marks(axes, len(names) - 1, robot.waited_for, RED)
    else:
        _count(rest.pop(0), series, len(robots))
    if series.notes:
        names.append("supervisor")
        _marks(axes, len(names) - 1, series.notes, INK, 0.5)
    for kind in kinds:
        names.append(INJECTED[kind][0])
        _injected(axes, len(names) - 1, series, kind)
    if slows:
        rest[0].plot(series.rate.t, series.rate.values[:, 0], color=BLUE)
        rest[0].set(ylim=(-0.05, 1.05), ylabel="rate of the\nreference")
    axes.set_yticks(range(len(names)), names)
    axes.set(ylim=(len(names) - 0.45, -0.55), xlim=(0, max(series.end_s, 1e-3)))
    axes.grid(axis="y", visible=False)
    legend(figure, _rows(series), columns=4)
    return figure


def _bars(axes: Axes, place: int, spans: Sequence[Span]) -> None:
    for what in dict.fromkeys(span.what for span in spans):
        colour, hatch = BANDS.get(what, (STONE, ""))
        where = [(s.begin, max(s.end - s.begin, 1e-3)) for s in spans if s.what == what]
        axes.broken_barh(
            where, (place - 0.36, 0.72), facecolor=colour, hatch=hatch, edgecolor="white", lw=0, zorder=2
        )


def _marks(axes: Axes, place: int, spans: Sequence[Span], colour: str, thick: float = 0.2) -> None:
    where = [(s.begin, max(s.end - s.begin, 1e-3)) for s in spans]
    axes.broken_barh(
        where, (place + 0.36 - thick, thick), facecolor=colour, edgecolor=colour, lw=0.6, zorder=3
    )


def _injected(axes: Axes, place: int, series: Series, kind: FaultKind) -> None:
    """When something of a kind was injected, thin what was on all the time; of nodes, which, where there is
    room."""
    those = [one for one in series.injected if one.kind == kind]
    passing = [one for one in those if not lasts(one, series.end_s)]
    for spans, thick in ((union(those, kind), 0.24), (union(passing, kind), 0.72)):
        where = [(begin, max(end - begin, 0.003 * series.end_s)) for begin, end in spans]
        axes.broken_barh(where, (place - 0.5 * thick, thick), zorder=2, **INJECTED[kind][1])
    free = 0.0
    for begin, _, _, who in those if kind in ("frozen", "killed") else ():
        if begin >= free:
            axes.annotate(
                who, (begin, place), (1.5, 0), textcoords="offset points", va="center", fontsize=6, zorder=4
            )
            free = begin + LETTER * len(who) * series.end_s


def _count(axes: Axes, series: Series, robots: int) -> None:
    """How many robots are in each mode."""
    t = np.linspace(0.0, max(series.end_s, 1e-3), COUNTED)
    counts = {what: np.zeros(COUNTED) for what in BANDS}
    for robot in series.robots:
        lost = _within(t, robot.lost)
        counts["lost"] += lost
        for what in dict.fromkeys(span.what for span in robot.modes):
            spans = [span for span in robot.modes if span.what == what]
            counts.setdefault(what, np.zeros(COUNTED))
            counts[what] += _within(t, spans) & ~lost
    shown = {what: count for what, count in counts.items() if count.any()}
    if shown:
        colours = [BANDS.get(what, (STONE, ""))[0] for what in shown]
        axes.stackplot(t, list(shown.values()), colors=colours, lw=0, step="mid")
    waited = sum(_within(t, robot.waited_for).astype(float) for robot in series.robots)
    axes.plot(t, waited, color=RED, lw=0.9)
    axes.set(ylim=(0, robots), ylabel="robots")


def _within(t: np.ndarray, spans: Sequence[Span]) -> np.ndarray:
    inside = np.zeros(len(t), dtype=bool)
    for span in spans:
        inside |= (t >= span.begin) & (t < span.end)
    return inside


def _rows(series: Series) -> list[Artist]:
    said = {span.what for span in series.phases}
    said |= {span.what for robot in series.robots for span in (*robot.modes, *robot.lost)}
    shown: dict[tuple[str, str], list[str]] = {}
    for what, how in BANDS.items():
        if what in said:
            shown.setdefault(how, []).append(what)
    rows: list[Artist] = [
        patch(", ".join(words), facecolor=colour, hatch=hatch, edgecolor="white", lw=0)
        for (colour, hatch), words in shown.items()
    ]
    if any(robot.waited_for for robot in series.robots):
        rows.append(row("waited for", color=RED, lw=2))
    if series.notes:
        rows.append(row("supervisor acts", color=INK, lw=3))
    return rows
