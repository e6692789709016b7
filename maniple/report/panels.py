"""Figures of quantities over time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from maniple.core.geometry import Floats
from maniple.core.palette import COLOURS
from maniple.report.samples import Band, Track, band
from maniple.report.series import RobotSeries, Series
from maniple.report.style import (
    BLUE,
    GREEN,
    INK,
    MANY,
    ORANGE,
    PURPLE,
    RED,
    STONE,
    STRIPES,
    band_rows,
    draw_band,
    legend,
    look,
    panels,
    patch,
    row,
    shade,
    shared_limits,
    sheet,
    thinned,
)

VARIABLES = ("x", "y", r"$\psi_F$", "p", "q", r"$\beta$")
PLACE, SIDES, RADIANS = (0, 1), (3, 4), (2, 5)
"""Position and sides (m), and angles (rad): each has a scale of its own."""
MANY_TRIANGLES = 6


def errors(series: Series) -> Figure | None:
    """Shape and pose errors of each triangle: as the controller sees them, and truth behind. None without."""
    triangles = [one for one in series.triangles if len(one.seen.t) or len(one.true.t)]
    if not triangles:
        return None
    if len(triangles) > MANY_TRIANGLES:
        return _errors_together(series, [one.seen for one in triangles], [one.true for one in triangles])
    figure = sheet(0.95 * len(triangles) + 0.85)
    kinds = (PLACE, SIDES, RADIANS)
    grid = panels(figure, len(triangles), len(kinds))
    for triangle, line_of_axes in zip(triangles, grid, strict=True):
        for axes, columns in zip(line_of_axes, kinds, strict=True):
            for column in columns:
                colour, stripe = COLOURS[column], STRIPES[column % len(STRIPES)]
                line(axes, triangle.true, column, color=colour, lw=2.2, alpha=0.28)
                line(axes, triangle.seen, column, color=colour, ls=stripe)
        line_of_axes[0].set_title(" ".join(triangle.robots))
    for side, columns in enumerate(kinds):
        tracks = [part.values[:, list(columns)] for one in triangles for part in one[1:]]
        column_of_axes = [axes[side] for axes in grid]
        shared_limits(column_of_axes, *_range(tracks), 0.02)
        names = ", ".join(VARIABLES[k] for k in columns)
        for axes in column_of_axes:
            axes.set_ylabel(f"{names} [{'rad' if columns is RADIANS else 'm'}]")
    rows: list[Artist] = [
        row(VARIABLES[k], color=COLOURS[k], ls=STRIPES[k % len(STRIPES)]) for k in (*PLACE, *SIDES, *RADIANS)
    ]
    rows.append(row("truth", color=STONE, lw=2.2, alpha=0.5))
    rows += _shade(grid, series)
    legend(figure, rows, columns=4)
    return figure


def _errors_together(series: Series, seen: list[Track], true: list[Track]) -> Figure:
    """The errors of many triangles, a panel for each variable."""
    figure = sheet(3.6)
    grid = panels(figure, 3, 2)
    for axes, column in zip((axes for line in grid for axes in line), (0, 3, 1, 4, 2, 5), strict=True):
        draw_band(axes, _band(seen, column), BLUE)
        extremes = _band(true, column)
        for level in extremes.levels[[0, -1]]:
            axes.plot(extremes.t, level, color=INK, lw=0.6, ls=STRIPES[2])
        axes.set_title(VARIABLES[column])
        axes.set_ylabel("error [rad]" if column in RADIANS else "error [m]")
    rows = band_rows(BLUE, f"of {len(seen)} triangles")
    truth = row("truth, all", color=INK, lw=0.6, ls=STRIPES[2])
    legend(figure, [*rows, truth, *_shade(grid, series)], columns=2)
    return figure


def velocities(series: Series) -> Figure | None:
    """Commanded and real velocities of each robot. None without any."""
    robots = [robot for robot in series.robots if len(robot.commanded.t) or len(robot.real.t)]
    if not robots:
        return None
    kinds = dict.fromkeys("real" if robot.true else "measured" for robot in robots)
    word = ", or ".join(kinds)
    sideways = any(map(_goes_sideways, robots))
    rows: list[Artist] = [
        row("commanded", color=RED, ls=STRIPES[1]),
        row(word, color=BLUE),
    ]
    if len(robots) > MANY:
        return _velocities_together(series, robots, word, sideways)
    figure = sheet(0.72 * len(robots) + 0.75)
    grid = panels(figure, len(robots), 2)
    for robot, (linear, angular) in zip(robots, grid, strict=True):
        for axes, column in ((linear, 0), (angular, 1)):
            line(axes, robot.real, column, color=BLUE)
            line(axes, robot.commanded, column, color=RED, ls=STRIPES[1])
        if _goes_sideways(robot):
            line(linear, robot.real, 2, color=GREEN)
            line(linear, robot.commanded, 2, color=ORANGE, ls=STRIPES[1])
        linear.set_title(robot.id)
        linear.set_ylabel("u, v [m/s]" if _goes_sideways(robot) else "u [m/s]")
        angular.set_ylabel("w [rad/s]")
    for side, columns in ((0, (0, 2) if sideways else (0,)), (1, (1,))):
        tracks = [part.values[:, list(columns)] for one in robots for part in (one.commanded, one.real)]
        shared_limits([axes[side] for axes in grid], *_range(tracks), 0.05)
    if sideways:
        rows += [
            row("sideways, commanded", color=ORANGE, ls=STRIPES[1]),
            row(f"sideways, {word}", color=GREEN),
        ]
    rows += _shade(grid, series)
    legend(figure, rows, columns=2)
    return figure


def _goes_sideways(robot: RobotSeries) -> bool:
    """Whether it was ever told to."""
    return bool(np.nanmax(np.abs(robot.commanded.values[:, 2]), initial=0.0) > 1e-6)


def _velocities_together(series: Series, robots: list[RobotSeries], word: str, sideways: bool) -> Figure:
    """The velocities of many robots, a row for each component."""
    names = (("u [m/s]", 0), ("w [rad/s]", 1), ("v [m/s]", 2))[: 3 if sideways else 2]
    figure = sheet(1.15 * len(names) + 0.8)
    grid = panels(figure, len(names))
    for (axes,), (label, column) in zip(grid, names, strict=True):
        draw_band(axes, _band([robot.real for robot in robots], column), BLUE)
        told = _band([robot.commanded for robot in robots], column)
        for level in told.levels[[0, -1]]:
            axes.plot(told.t, level, color=RED, lw=0.6, ls=STRIPES[2])
        axes.set_ylabel(label)
    rows = band_rows(BLUE, f"{word}, {len(robots)} robots")
    told_row = row("commanded, all", color=RED, lw=0.6, ls=STRIPES[2])
    legend(figure, [*rows, told_row, *_shade(grid, series)], columns=2)
    return figure


def _of_each_robot(axes: Axes, tracks: Mapping[str, Track], column: int) -> list[Artist]:
    """A line for each robot that has a track, or a band over many; returns the rows of the legend."""
    known = [track for track in tracks.values() if len(track.t)]
    if len(known) > MANY:
        draw_band(axes, _band(known, column), BLUE)
        return list(band_rows(BLUE, f"of {len(known)} robots"))
    for index, track in enumerate(tracks.values()):
        line(axes, track, column, **look(index))
    return [row(name, **look(index)) for index, (name, track) in enumerate(tracks.items()) if len(track.t)]


def clearance(series: Series) -> Figure | None:
    """Smallest distance of each robot's outline to anything. None without ground truth."""
    robots = [robot for robot in series.robots if len(robot.clearance.t)]
    if not robots:
        return None
    figure = sheet(2.3)
    ((axes,),) = panels(figure, 1)
    rows = _of_each_robot(axes, {robot.id: robot.clearance for robot in series.robots}, 0)
    axes.axhline(0.0, color=INK, lw=0.6)
    if series.contacts:
        t = [t for t, _ in series.contacts]
        axes.plot(t, [0.0] * len(t), "x", color=RED, ms=5, mew=1.1, zorder=5)
        rows.append(row("contact", color=RED, ls="", marker="x", ms=5))
    axes.set_ylabel("clearance [m]")
    axes.set_ylim(bottom=min(axes.get_ylim()[0], -0.02))
    rows += _shade([[axes]], series)
    legend(figure, rows, columns=4)
    return figure


def ages(series: Series) -> Figure | None:
    """How old what the robots act on is, and when their guards step in. None without any status."""
    robots = [robot for robot in series.robots if len(robot.age.t)]
    if not robots:
        return None
    figure = sheet(2.3)
    ((axes,),) = panels(figure, 1)
    rows = _of_each_robot(axes, {robot.id: robot.age for robot in series.robots}, 1)
    for limits, colour, stripe, word in (
        ({robot.hold_s for robot in robots}, ORANGE, STRIPES[1], "slows from"),
        ({robot.stop_s for robot in robots}, RED, STRIPES[3], "stands at"),
    ):
        for limit in (min(limits), *([max(limits)] if len(limits) > 1 else ())):
            axes.axhline(limit, color=colour, lw=1.1, ls=stripe)
        rows.append(row(word, color=colour, lw=1.1, ls=stripe))
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("command age [s]")
    rows += _shade([[axes]], series)
    legend(figure, rows, columns=4)
    return figure


def compensation(series: Series) -> Figure | None:
    """The adapted parameters of each robot's dynamics. None where nothing is compensated."""
    robots = [(i, robot) for i, robot in enumerate(series.robots) if len(robot.compensation.t)]
    if not robots:
        return None
    figure = sheet(3.4)
    grid = panels(figure, 3, 2)
    models = [series.scenario.model_of(series.scenario.robots[index]).theta for index, _ in robots]
    for column, axes in enumerate(axes for pair in grid for axes in pair):
        if len(robots) > MANY:
            draw_band(axes, _band([robot.compensation for _, robot in robots], column), BLUE)
        else:
            for index, robot in robots:
                line(axes, robot.compensation, column, **look(index))
        for value in sorted({theta[column] for theta in models}):
            axes.axhline(value, color=INK, lw=0.7, ls=STRIPES[2])
        axes.set_title(rf"$\theta_{column + 1}$ [{('s', 's', 's m/rad²', '1', 's/m', '1')[column]}]")
        axes.ticklabel_format(axis="y", useOffset=False)
    few = len(robots) <= MANY
    rows = [row(r.id, **look(i)) for i, r in robots] if few else band_rows(BLUE, f"of {len(robots)} robots")
    model = row("model", color=INK, lw=0.7, ls=STRIPES[2])
    legend(figure, [*rows, model, *_shade(grid, series)], columns=4)
    return figure


NETWORK = (
    ("delivered", GREEN, ""),
    ("lost, injected", RED, "////"),
    ("lost, other", PURPLE, "xxxx"),
    ("refused", ORANGE, "...."),
)
"""What becomes of a message: colour and hatching."""


def network(series: Series) -> Figure | None:
    """What became of what was sent: per link, or per kind of message; and over time. None without any."""
    if not series.links:
        return None
    few = len(series.robots) <= MANY
    rows: dict[str, Floats] = {}
    for link in series.links:
        who, _, kind = link.topic.removeprefix("robot/").partition("/")
        far = link.source if link.destination == "controller" else link.destination
        name = f"{kind} {far if far != who else who}" if few else kind
        counts = np.array(link[3:8], dtype=float)
        rows[name] = rows.get(name, np.zeros(5)) + counts
    names = sorted(rows)
    sent = np.array([max(rows[name][0], 1.0) for name in names])
    high = 0.125 * len(names) + 0.3
    figure = sheet(high + 2.1)
    bars, lines = figure.subplots(2, 1, height_ratios=(high, 1.25))
    left = np.zeros(len(names))
    for place, (_, colour, hatch) in enumerate(NETWORK, 1):
        width = 100 * np.array([rows[name][place] for name in names]) / sent
        bars.barh(names, width, 0.78, left, color=colour, hatch=hatch, edgecolor="white", lw=0)
        left += width
    for place, name in enumerate(names):
        bars.text(101.5, place, f"{int(rows[name][0])}", va="center", fontsize=7)
    bars.set(
        xlim=(0, 118), ylim=(len(names) - 0.5, -0.5), xlabel="share of the messages sent [%], and how many"
    )
    bars.set_xticks(range(0, 101, 25))
    bars.grid(axis="y", visible=False)
    kinds: list[Artist] = []
    for place, share in enumerate(series.shares):
        how = {"color": COLOURS[place % len(COLOURS)], "ls": STRIPES[place % len(STRIPES)]}
        middle, worst = _middle_and_worst(share.shares)
        lines.plot(share.t, 100 * middle, **how)
        lines.plot(share.t, 100 * worst, lw=0.5, alpha=0.6, **how)
        kinds.append(row(share.kind, **how))
    lines.set(xlabel="time [s]", ylabel="delivered [%]", ylim=(-4, 104))
    fates = [patch(name, facecolor=c, hatch=h, edgecolor="white", lw=0) for name, c, h in NETWORK]
    legend(figure, [*fates, *kinds, *_shade([[lines]], series)], columns=4)
    return figure


def _middle_and_worst(shares: Floats) -> tuple[Floats, Floats]:
    """Median and least over the links (links, k) in each span; NaN where none sent anything."""
    ordered = np.sort(shares, axis=0)  # NaN last
    known = np.isfinite(shares).sum(axis=0)
    spans = np.arange(shares.shape[1])
    low, high = np.maximum(known - 1, 0) // 2, np.minimum(known // 2, len(shares) - 1)
    return 0.5 * (ordered[low, spans] + ordered[high, spans]), ordered[0]


def _shade(grid: Sequence[Sequence[Axes]], series: Series) -> list[Artist]:
    """Bands where faults were on, in all panels; returns the rows of the legend."""
    return shade((axes for line_of_axes in grid for axes in line_of_axes), series.injected, series.end_s)


def line(axes: Axes, track: Track, column: int, **how: object) -> None:
    """One column of a track over time."""
    t, values = thinned(track.t, track.values[:, column])
    axes.plot(t, values, **how)  # type: ignore[arg-type]


def _band(tracks: list[Track], column: int) -> Band:
    return band([(track.t, track.values[:, column]) for track in tracks])


def _range(parts: list[Floats]) -> tuple[float, float]:
    """Least and largest of arrays; 0 without any number."""
    flat = np.concatenate([part.ravel() for part in parts])
    flat = flat[np.isfinite(flat)]
    return (float(flat.min()), float(flat.max())) if len(flat) else (0.0, 0.0)
