"""A picture of a scenario: what stands where, who goes where, and how the triangles are chained."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from central_controller.reference import Course
from maniple.core.errors import ManipleError, MissingExtraError
from maniple.core.geometry import Pose
from maniple.core.palette import RED
from maniple.core.scenario import outline
from maniple.core.scenario.places import end_pose, fastest_mps, legs_of, start_pose
from maniple.core.scenario.types import (
    Circle,
    Leg,
    Obstacle,
    Point,
    Positioning,
    Robot,
    Scenario,
    Wall,
)
from maniple.core.scenario.types import Sequence as Legs
from maniple.core.scenario.ways import way_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
"""What a picture can be saved as."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette, told apart by the colour-blind; without black and yellow."""

INK, STONE, FAINT = "#222222", "#8C8C8C", "#D9D9D9"
BOUND: Any = {"color": RED, "lw": 1.1, "ls": (0, (6, 2, 1, 2))}
"""How a fence looks."""

MARGIN_M = 0.35
WIDTH_IN = 9.0
TALLEST_IN = 9.0
SHORTEST_IN = 1.6
FURNITURE_IN = 1.45
"""Height of title, axis labels and legend."""

ROOM_IN = 0.95
"""Width of the labels beside the plot."""

LETTER_IN = 0.085
"""Width of a letter of a robot's name."""

APART_M = 0.05
"""A robot that starts nearer to its place than this has no line to it."""

SAMPLES = 200
"""Points on a path."""


def save(scenario: Scenario, path: Path) -> None:
    """Draw a resolved scenario into a file; the suffix chooses the format.

    Raises:
        ManipleError: another suffix than `FORMATS`, or the file can't be written.
        MissingExtraError: matplotlib is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise ManipleError(f"{path}: a picture's name must end in one of {', '.join(FORMATS)}")
    figure = draw(scenario)
    undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix.lower())
    from matplotlib import rc_context

    try:
        with rc_context({"svg.hashsalt": "maniple"}):
            figure.savefig(path, dpi=200, metadata=undated)
    except OSError as error:
        raise ManipleError(f"{path}: can't be written: {error.strerror or error}") from None


def draw(scenario: Scenario) -> "Figure":
    """The picture of a resolved scenario.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.patches import Polygon
    except ImportError:
        raise MissingExtraError("scenario draw", "report") from None
    with rc_context({"font.size": 9, "axes.linewidth": 0.6}):
        left, right, bottom, top = _extent(scenario)
        wide, high = right - left, top - bottom
        scale = min((WIDTH_IN - ROOM_IN) / wide, (TALLEST_IN - FURNITURE_IN) / high)
        size = (max(scale * wide, 4.5) + ROOM_IN, max(scale * high, SHORTEST_IN) + FURNITURE_IN)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot()
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axes.set_title(_title(scenario), fontsize=10, loc="left")
        axes.tick_params(length=3, width=0.6)
        axes.grid(color=FAINT, linewidth=0.4, zorder=0)
        axes.set_axisbelow(True)
        _draw_world(axes, scenario.world.obstacles)
        if corners := scenario.guard.fence:
            axes.add_patch(Polygon(corners, fill=False, zorder=1.5, **BOUND))
        _draw_paths(axes, scenario)
        _draw_formation(axes, scenario, _final(scenario), faint=True)
        _draw_formation(axes, scenario, [Pose(*_pose(robot)) for robot in scenario.robots], faint=False)
        _draw_legend(figure, scenario)
    return figure


def _title(scenario: Scenario) -> str:
    triangles = len(scenario.robots) - 2
    course, fastest = Course(scenario.task, scenario.controller), fastest_mps(scenario.task)
    estimated = any(isinstance(leg, Positioning) for leg in legs_of(scenario.task))
    return (
        f"{scenario.name}: {len(scenario.robots)} robots, {triangles} triangle{'s' * (triangles > 1)}, "
        + (f"{fastest:.2g} m/s, " if fastest else "positioning, ")
        + ("about " if estimated else "")
        + f"{course.total_s:.0f} s"
    )


def _draw_world(axes: "Axes", obstacles: Sequence[Obstacle]) -> None:
    from matplotlib import patches

    for index, obstacle in enumerate(obstacles):
        match obstacle:
            case Circle(centre=centre, radius_m=radius):
                axes.add_patch(
                    patches.Circle(centre, radius, facecolor=STONE, edgecolor=INK, lw=0.6, zorder=4)
                )
            case Wall(start=(x0, y0), end=(x1, y1)):
                axes.plot((x0, x1), (y0, y1), color=INK, lw=1.6, solid_capstyle="butt", zorder=4)
            case _:
                corners = outline.corners_of(obstacle)
                axes.add_patch(patches.Polygon(corners, facecolor=STONE, edgecolor=INK, lw=0.6, zorder=4))
        (x0, y0), (x1, y1) = outline.box_around(obstacle)
        _label(axes, (0.5 * (x0 + x1), 0.5 * (y0 + y1)), str(index), INK, zorder=5, size=6)


def _draw_paths(axes: "Axes", scenario: Scenario) -> None:
    """The way of the formation's origin and of each robot's place, with where the parts of a task begin."""
    for frames in _ways(scenario):
        axes.plot([p.x for p in frames], [p.y for p in frames], color=INK, lw=0.9, ls=(0, (5, 3)), zorder=2.5)
        _draw_direction(axes, frames)
        for index, point in enumerate(scenario.formation.points):
            places = [frame.compose(Pose(*point, 0.0)) for frame in frames]
            stripe = 3.0 - 0.45 * (index % len(COLOURS))  # ways that coincide show as stripes
            axes.plot([p.x for p in places], [p.y for p in places], color=_colour(index), lw=stripe, zorder=2)
    _draw_travel(axes, scenario)
    if isinstance(scenario.task, Legs):
        _draw_stations(axes, scenario.task)


def _ways(scenario: Scenario) -> Iterator[list[Pose]]:
    """Where the formation's frame is along each part of the task that moves it."""
    for way in map(way_of, legs_of(scenario.task)):
        if way.travel_s > 0.0:
            yield [way.at(way.travel_s * k / SAMPLES)[0] for k in range(SAMPLES + 1)]


def _draw_direction(axes: "Axes", frames: Sequence[Pose]) -> None:
    """An arrowhead a quarter along a way."""
    here = len(frames) // 4
    tail, head = frames[here], frames[here + 1]
    look = {"arrowstyle": "-|>", "color": INK, "lw": 0.9, "mutation_scale": 11, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (head.x, head.y), (tail.x, tail.y), arrowprops=look, zorder=2.6)


def _draw_travel(axes: "Axes", scenario: Scenario) -> None:
    """Thin lines to where a part of the task begins, if that is elsewhere: of each robot, and then of the
    formation's origin."""
    legs = legs_of(scenario.task)
    dots: dict[str, Any] = {"ls": (0, (1, 2)), "zorder": 2.2}
    for before, after in pairwise(legs):
        a, b = end_pose(before), _station(after)
        if math.dist(a[:2], b[:2]) > APART_M:
            axes.plot((a.x, b.x), (a.y, b.y), color=INK, lw=0.9, **dots)
    if scenario.planning.method != "given" or scenario.planning.relabel:
        return  # who goes where is decided when the run begins
    for index, (robot, point) in enumerate(zip(scenario.robots, scenario.formation.points, strict=True)):
        at = Pose(*_pose(robot)).compose(Pose(robot.control_point_m, 0.0, 0.0))
        place = _station(legs[0]).compose(Pose(*point, 0.0))
        if math.dist(at[:2], place[:2]) > APART_M:
            axes.plot((at.x, place.x), (at.y, place.y), color=_colour(index), lw=0.8, **dots)
            axes.plot(place.x, place.y, "x", ms=4, color=_colour(index), mew=1.0, zorder=5.5)


def _draw_stations(axes: "Axes", task: Legs) -> None:
    """The number of each part of a sequence, where it begins."""
    marks: dict[Point, list[str]] = {}
    for index, leg in enumerate(task.tasks):
        x, y, _ = _station(leg)
        marks.setdefault((round(x, 2), round(y, 2)), []).append(str(index))
    for at, names in marks.items():
        _label(axes, at, ", ".join(names), INK, zorder=9, size=8, box=True)


def _station(leg: Leg) -> Pose:
    """Where the formation's frame is when a part of the task has begun."""
    return end_pose(leg) if isinstance(leg, Positioning) else start_pose(leg)


def _draw_formation(axes: "Axes", scenario: Scenario, poses: Sequence[Pose], *, faint: bool) -> None:
    """Triangles, bodies, headings and control points of robots that stand at `poses`."""
    from matplotlib import patches

    strength = 0.35 if faint else 1.0
    points = [
        pose.compose(Pose(robot.control_point_m, 0.0, 0.0))
        for robot, pose in zip(scenario.robots, poses, strict=True)
    ]
    for first, second in _links(len(points)):
        a, b = points[first], points[second]
        axes.plot((a.x, b.x), (a.y, b.y), color=INK, lw=0.7, alpha=0.6 * strength, zorder=3)
    for index, (robot, pose, point) in enumerate(zip(scenario.robots, poses, points, strict=True)):
        colour, model = _colour(index), scenario.model_of(robot)
        if not faint and scenario.avoidance.enabled:
            ring = patches.Circle(
                (pose.x, pose.y), scenario.avoidance.d_max_m, fill=False, edgecolor=colour, lw=0.6, alpha=0.45
            )
            axes.add_patch(ring)
        body = outline.body(pose, model)
        axes.add_patch(
            patches.Polygon(body, facecolor=colour, edgecolor=INK, lw=0.5, alpha=strength, zorder=6)
        )
        nose = pose.compose(Pose(0.5 * model.length_m, 0.0, 0.0))
        axes.plot((pose.x, nose.x), (pose.y, nose.y), color="white", lw=1.0, alpha=strength, zorder=7)
        axes.plot(point.x, point.y, "o", ms=2.6, mfc="white", mec=INK, mew=0.5, alpha=strength, zorder=8)
        if not faint:
            aside = pose.compose(Pose(0.0, 0.5 * model.width_m, 0.0))
            _label(axes, (aside.x, aside.y), robot.id, INK, zorder=9, size=8, away=aside.psi + math.pi / 2)


def _label(
    axes: "Axes",
    at: Point,
    text: str,
    colour: str,
    *,
    zorder: float,
    size: float,
    away: float | None = None,
    box: bool = False,
) -> None:
    """A name at a point, or beside it in the direction `away` (rad), readable on anything, or in a box."""
    from matplotlib import patheffects

    east, north = (0.0, 0.0) if away is None else (math.cos(away), math.sin(away))
    axes.annotate(
        text,
        at,
        xytext=(4.0 * east, 4.0 * north),
        textcoords="offset points",
        ha="left" if east > 0.4 else "right" if east < -0.4 else "center",
        va="bottom" if north > 0.4 else "top" if north < -0.4 else "center",
        fontsize=size,
        fontweight="bold",
        color=colour,
        zorder=zorder,
        path_effects=[patheffects.withStroke(linewidth=2.0, foreground="white")],
        bbox={"boxstyle": "round", "fc": "white", "ec": colour, "lw": 0.6} if box else None,
    )


def _draw_legend(figure: "Figure", scenario: Scenario) -> None:
    from matplotlib.lines import Line2D

    def row(label: str, **look: Any) -> Line2D:
        return Line2D([], [], label=label, **look)

    rows = [
        row("robot, heading", ls="", marker="s", ms=8, mfc=COLOURS[0], mec=INK, mew=0.5),
        row("control point", ls="", marker="o", ms=3.5, mfc="white", mec=INK, mew=0.6),
        row("triangle", color=INK, lw=0.8, alpha=0.6),
        row("formation at the end", ls="", marker="s", ms=8, mfc=COLOURS[0], mec=INK, mew=0.5, alpha=0.35),
    ]
    if any(way_of(leg).travel_s > 0.0 for leg in legs_of(scenario.task)):
        rows.append(row("path of a place", color=COLOURS[0], lw=0.9))
        rows.append(row("path of the reference", color=INK, lw=0.9, ls=(0, (5, 3))))
    if scenario.avoidance.enabled:
        shell = f"shell, {scenario.avoidance.d_max_m:g} m"
        rows.append(row(shell, ls="", marker="o", ms=9, mfc="none", mec=COLOURS[0], mew=0.7, alpha=0.6))
    if scenario.world.obstacles:
        rows.append(row("obstacle, index", ls="", marker="o", ms=8, mfc=STONE, mec=INK, mew=0.6))
    if scenario.guard.fence:
        rows.append(row("fence", **BOUND))
    columns = 4 if figure.get_figwidth() > 7 else 3
    figure.legend(handles=rows, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def _links(robots: int) -> Iterator[tuple[int, int]]:
    """The sides of the triangles of a chain, each once."""
    for first in range(robots):
        yield from ((first, second) for second in (first + 1, first + 2) if second < robots)


def _final(scenario: Scenario) -> list[Pose]:
    """Where the robots stand when all is as desired at the end of the task, each facing as it came."""
    way = way_of(legs_of(scenario.task)[-1])
    frame, (vx, vy, turning) = way.at(way.travel_s)
    poses = []
    for robot, point in zip(scenario.robots, scenario.formation.points, strict=True):
        x, y, psi = frame.compose(Pose(*point, 0.0))
        east, north = vx - turning * (y - frame.y), vy + turning * (x - frame.x)
        if scenario.model_of(robot).drive != "omnidirectional" and math.hypot(east, north) > 1e-6:
            psi = math.atan2(north, east)
        poses.append(Pose(x, y, psi).compose(Pose(-robot.control_point_m, 0.0, 0.0)))
    return poses


def _extent(scenario: Scenario) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of what is to be seen, m."""
    poses = [Pose(*_pose(robot)) for robot in scenario.robots]
    reach = scenario.avoidance.d_max_m if scenario.avoidance.enabled else 0.5
    seen = [(p.x + sx * reach, p.y + sy * reach) for p in poses for sx in (-1, 1) for sy in (-1, 1)]
    seen += [(p.x + sx * 0.5, p.y + sy * 0.5) for p in _final(scenario) for sx in (-1, 1) for sy in (-1, 1)]
    for frames in _ways(scenario):
        for corner in [(0.0, 0.0), *scenario.formation.points]:
            seen += [frame.compose(Pose(*corner, 0.0))[:2] for frame in frames[::4]]
    seen += [_station(leg)[:2] for leg in legs_of(scenario.task)]
    for obstacle in scenario.world.obstacles:
        seen += outline.box_around(obstacle)
    seen += scenario.guard.fence
    xs, ys = zip(*seen, strict=True)
    metres_per_inch = max((max(xs) - min(xs)) / WIDTH_IN, (max(ys) - min(ys)) / TALLEST_IN)
    for robot, pose in zip(scenario.robots, poses, strict=True):  # room for a name on either side
        aside = 0.5 + LETTER_IN * len(robot.id) * metres_per_inch
        xs += (pose.x - aside, pose.x + aside)
    return min(xs) - MARGIN_M, max(xs) + MARGIN_M, min(ys) - MARGIN_M, max(ys) + MARGIN_M


def _pose(robot: Robot) -> tuple[float, float, float]:
    assert robot.pose is not None, "the scenario is resolved"
    return robot.pose


def _colour(index: int) -> str:
    return COLOURS[index % len(COLOURS)]
