"""The figure of trajectories: ways of all robots, obstacles, and the platoon at three moments."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Polygon as Area
from matplotlib.patheffects import withStroke

from maniple.core.geometry import Floats
from maniple.core.palette import RED
from maniple.core.scenario import outline
from maniple.core.scenario.types import Circle, Scenario, Wall
from maniple.report.series import Series, Snapshot
from maniple.report.style import (
    BLUE,
    INK,
    MANY,
    ORANGE,
    PURPLE,
    SKY,
    STONE,
    STRIPES,
    WIDTH_IN,
    legend,
    look,
    row,
    sheet,
)

MARGIN_M = 0.6
NEAR_M = 1.5
"""Obstacles no farther than this from where the robots were are in the picture whole."""

EDGE_M = 0.2
"""Between a fence and the edge of the picture."""

ROOM_IN = 0.45
"""Width of the labels beside the plot."""

TALLEST_IN = 4.5
PANEL_IN = 0.95
"""Width of a snapshot."""

SHADES = {"start": (SKY, "-"), "most deformed": (ORANGE, STRIPES[1]), "end": (PURPLE, STRIPES[2])}
"""Colour and line style of the triangles at each moment."""

BOUND: Any = {"color": RED, "lw": 0.8, "ls": STRIPES[3]}
"""How a fence looks."""


def trajectories(series: Series) -> Figure | None:
    """The ways of all robots; below, the platoon at the three moments from near. None without poses."""
    ways = [robot.poses.values for robot in series.robots]
    seen = [way[:, :2][np.isfinite(way[:, 0])] for way in ways]
    if not sum(map(len, seen)):
        return None
    box = _extent([*seen, *(shot.points for shot in series.snapshots)], series.scenario)
    (left, bottom), (right, top) = box
    wide = WIDTH_IN - ROOM_IN
    high = min(wide * (top - bottom) / (right - left), TALLEST_IN)
    window = _window(series)
    near = min(PANEL_IN * window[1] / window[0], 1.7)
    figure = sheet(high + near + 1.25)
    grid = figure.add_gridspec(2, 1, height_ratios=(high, near))
    axes = figure.add_subplot(grid[0])
    _world(axes, series.scenario)
    few = len(ways) <= MANY
    axes.plot(series.path[:, 0], series.path[:, 1], color=INK, lw=0.7, ls=STRIPES[1], zorder=2)
    for index, way in enumerate(ways):
        how = look(index) if few else {"color": BLUE, "ls": "-", "alpha": 0.45}
        thick = 1.9 - 0.2 * index if few else 0.5  # ways that coincide show as stripes
        axes.plot(way[:, 0], way[:, 1], lw=thick, zorder=3, **how)
    for shot in series.snapshots:
        _platoon(axes, shot, series, names=False)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    below = grid[1].subgridspec(1, 3)
    for index, shot in enumerate(series.snapshots):
        panel = figure.add_subplot(below[index])
        middle = np.nanmean(shot.points, axis=0)
        _world(panel, series.scenario)
        for name, way in enumerate(ways):
            how = look(name) if few else {"color": BLUE, "ls": "-"}
            panel.plot(way[:, 0], way[:, 1], lw=0.5, alpha=0.6, zorder=3, **how)
        _platoon(panel, shot, series, names=few)
        panel.set(
            xlim=(middle[0] - window[0] / 2, middle[0] + window[0] / 2),
            ylim=(middle[1] - window[1] / 2, middle[1] + window[1] / 2),
            aspect="equal",
        )
        panel.set_title(f"{shot.name}, {shot.t:.0f} s", fontsize=7)
        panel.tick_params(labelsize=7)
        panel.locator_params(nbins=3)
    legend(figure, _rows(series, few), columns=4)
    return figure


def _rows(series: Series, few: bool) -> list[Artist]:
    words = ["" if robot.true else " (believed)" for robot in series.robots]
    if few:
        rows: list[Artist] = [
            row(f"{robot.id}{word}", **look(place))
            for place, (robot, word) in enumerate(zip(series.robots, words, strict=True))
        ]
    else:
        believed = sum(map(bool, words))
        word = "" if not believed else f" ({believed if believed < len(words) else 'all'} believed)"
        rows = [row(f"{len(words)} robots{word}", color=BLUE, alpha=0.6)]
    rows.append(row("reference", color=INK, lw=0.7, ls=STRIPES[1]))
    if series.scenario.guard.fence:
        rows.append(row("fence", **BOUND))
    for shot in series.snapshots:
        colour, stripe = SHADES[shot.name]
        rows.append(row(shot.name, color=colour, ls=stripe))
    return rows


def _world(axes: Axes, scenario: Scenario) -> None:
    """Obstacles, and the fence."""
    if scenario.guard.fence:
        axes.add_patch(Area(scenario.guard.fence, fill=False, zorder=1.4, **BOUND))
    for obstacle in scenario.world.obstacles:
        match obstacle:
            case Circle(centre=centre, radius_m=radius):
                axes.add_patch(Disc(centre, radius, facecolor=STONE, edgecolor=INK, lw=0.4, zorder=1.5))
            case Wall(start=(x0, y0), end=(x1, y1)):
                axes.plot((x0, x1), (y0, y1), color=INK, lw=1.2, solid_capstyle="butt", zorder=1.5)
            case _:
                corners = outline.corners_of(obstacle)
                axes.add_patch(Area(corners, facecolor=STONE, edgecolor=INK, lw=0.4, zorder=1.5))


def _platoon(axes: Axes, shot: Snapshot, series: Series, *, names: bool) -> None:
    """Bodies with a stroke to the front, and triangles."""
    colour, stripe = SHADES[shot.name]
    for triangle in shot.triangles:
        corners = shot.points[list(triangle)]
        if np.isfinite(corners).all():
            axes.add_patch(Area(corners, fill=True, facecolor=colour, alpha=0.16, lw=0, zorder=2.4))
            axes.add_patch(Area(corners, fill=False, edgecolor=colour, lw=0.7, ls=stripe, zorder=4))
    for robot, pose in zip(series.scenario.robots, shot.poses, strict=True):
        if not np.isfinite(pose).all():
            continue
        model = series.scenario.model_of(robot)
        axes.add_patch(
            Area(outline.body(pose, model), facecolor="white", edgecolor=INK, lw=0.4, alpha=0.9, zorder=5)
        )
        front = pose[:2] + 0.5 * model.length_m * np.array([np.cos(pose[2]), np.sin(pose[2])])
        axes.plot((pose[0], front[0]), (pose[1], front[1]), color=INK, lw=0.5, zorder=5.1)
        if names:
            axes.annotate(
                robot.id,
                pose[:2],
                xytext=(0, 4.5),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7,
                zorder=6,
                annotation_clip=True,
                path_effects=[withStroke(linewidth=1.6, foreground="white")],
            )


def _extent(seen: Sequence[Floats], scenario: Scenario) -> Floats:
    """Lower left and upper right corner (2, 2) of what is to be seen, m."""
    points = np.concatenate(seen)
    low, high = np.nanmin(points, axis=0) - MARGIN_M, np.nanmax(points, axis=0) + MARGIN_M
    box = np.array([low, high])
    fence = np.array(scenario.guard.fence)
    around = [np.array([fence.min(axis=0) - EDGE_M, fence.max(axis=0) + EDGE_M])] if len(fence) else []
    for corners in [*around, *(np.array(outline.box_around(one)) for one in scenario.world.obstacles)]:
        if (corners[0] <= high + NEAR_M).all() and (corners[1] >= low - NEAR_M).all():
            corners = np.clip(corners, low - NEAR_M, high + NEAR_M)
            box = np.array([np.minimum(box[0], corners[0]), np.maximum(box[1], corners[1])])
    return box


def _window(series: Series) -> tuple[float, float]:
    """Width and height (m) in which the platoon fits at each moment, not too tall for its width."""
    sizes = [np.nanmax(s.points, axis=0) - np.nanmin(s.points, axis=0) for s in series.snapshots]
    wide, high = np.max(sizes, axis=0) + 2 * MARGIN_M
    names = len(series.robots) <= MANY  # which stand above their robots
    return float(max(wide, high / 1.6)), float(max(high, wide / (1.3 if names else 2.2)))
