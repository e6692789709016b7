"""The figures of a report: arrays in, PNG and SVG out."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from matplotlib import rc_context
from matplotlib.figure import Figure

from maniple.report import panels, phases, scene, style
from maniple.report.series import Series


class Kind(NamedTuple):
    """One figure of a report."""

    name: str
    """Of its files, without suffix."""
    title: str
    draw: Callable[[Series], Figure | None]
    """None where the recording does not hold what it shows."""
    caption: str
    missing: str
    """What is said where it can't be drawn."""


KINDS: tuple[Kind, ...] = (
    Kind(
        "trajectories",
        "Trajectories",
        scene.trajectories,
        "Ways of the middles of the axles, obstacles (grey) and the way of the reference; triangles and "
        "bodies at the start, when the shape is farthest from the desired one, and at the end; below from "
        "near.",
        "The recording holds no poses: neither ground truth nor odometry.",
    ),
    Kind(
        "errors",
        "Formation errors",
        panels.errors,
        "Pose and shape errors of each triangle, desired minus actual: lines as the controller sees them, "
        "broad and faint behind them the truth.",
        "The controller told no formation errors.",
    ),
    Kind(
        "velocities",
        "Velocities",
        panels.velocities,
        "What each drive was told, after the guard, and what the robot did.",
        "The recording holds neither commands to drives nor velocities.",
    ),
    Kind(
        "clearance",
        "Clearance",
        panels.clearance,
        "Smallest distance from each robot's outline to any other thing, ground truth; 0 is contact.",
        "Without ground truth nobody knows how near the robots came to things.",
    ),
    Kind(
        "command-age",
        "Command age",
        panels.ages,
        "Largest age of what each robot acted on, by its own clock, between one status and the next; the "
        "guard slows the robot from the first limit on and stops it at the second.",
        "No robot said how old its commands were.",
    ),
    Kind(
        "network",
        "Network",
        panels.network,
        "What became of the messages sent, by link, and the share delivered over the links of each kind "
        "(median; thin: the worst), by the time of sending.",
        "The recording holds no journals: what was delivered is not known.",
    ),
    Kind(
        "phases",
        "Phases",
        phases.phases,
        "What the controller and each robot were doing, blank where nothing was heard; and what was "
        "injected, thin where it was on all the time.",
        "Neither the controller nor any robot said what it was doing.",
    ),
    Kind(
        "compensation",
        "Dynamic compensation",
        panels.compensation,
        "Adapted parameters of each robot's dynamics, and those of its model.",
        "No robot's dynamics were compensated.",
    ),
)


def draw(series: Series) -> Iterator[tuple[Kind, Figure | None]]:
    """All figures, one after the other."""
    for kind in KINDS:
        with rc_context(style.LOOK):
            yield kind, kind.draw(series)


def write(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Save a figure as `stem`.png and `stem`.svg."""
    paths = stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.svg")
    for path in paths:
        style.save(figure, path)
        figure.set_layout_engine("none")  # laid out once is enough
    return paths
