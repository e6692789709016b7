"""`maniple plan`: who would take which place, by each method, and what that means for the ways there."""

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
import typer
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from central_controller.planning import Straight, overlaps, plan, relabel
from maniple.cli.extensions import implementation, installed
from maniple.cli.loading import load
from maniple.cli.scenario_commands import PIPED_WIDTH, File, Json, Seed, Set
from maniple.control import unicycle
from maniple.control.parts import Planner
from maniple.core.errors import ManipleError, MissingExtraError
from maniple.core.geometry import Floats, Pose, rotation
from maniple.core.scenario.places import start_pose
from maniple.core.scenario.types import Scenario

METHOD = "planning.method"


class Assignment(msgspec.Struct, frozen=True):
    """What one method makes of the platoon."""

    method: str
    used: bool
    """Whether it is the scenario's own."""
    robots: tuple[str, ...]
    """Who takes each place, in the order of the chain."""
    total_m: float
    """The sum of all straight ways from where the control points are to their places."""
    longest_m: float
    """The longest of them."""
    crossings: int
    """Pairs of ways that meet."""
    separation_m: float
    """The smallest distance between two control points if all go in step."""
    build_s: float
    """How long that takes at `planning.speed_mps`."""


class Plans(msgspec.Struct, frozen=True):
    """The places of a scenario and who might take them; what `maniple plan --json` prints."""

    scenario: str
    seed: int
    relabel: bool
    """Whether the places are numbered anew."""
    places: tuple[tuple[float, float], ...]
    """In the world, m, in the order of the chain."""
    overlaps: int
    """Pairs of triangles of the chain that overlap."""
    overlaps_as_given: int
    """The same with the places as the scenario numbers them."""
    assignments: tuple[Assignment, ...]
    unavailable: dict[str, str]
    """Methods that need what is not installed, and what that is."""


def show(
    file: File,
    method: Annotated[str | None, typer.Option("--method", help="Only this one; by default all.")] = None,
    overrides: Set = None,
    seed: Seed = None,
    as_json: Json = False,
) -> None:
    """Show who takes which place by each method, and how far the robots have to go."""
    plans = plans_of(load(file, overrides or (), seed), method)
    if as_json:
        typer.echo(msgspec.json.encode(plans).decode())
        return
    terminal = Console(highlight=False)
    console = terminal if terminal.is_terminal else Console(highlight=False, width=PIPED_WIDTH)
    console.print(picture(plans))


def plans_of(scenario: Scenario, method: str | None = None) -> Plans:
    """What every method, or one, makes of a resolved scenario: from where the robots start to the formation
    where its task starts.

    Raises:
        ScenarioError: a method is not installed or can't be imported.
        MissingExtraError: the one asked for, or the scenario's own, needs what is not installed.
        ManipleError: a method failed, or gave no assignment.
    """
    own = scenario.planning.method
    names = [one.name for one in installed() if one.kind == "planner"] if method is None else [method]
    given = np.asarray(scenario.formation.points)
    own_places = given[list(relabel(given))] if scenario.planning.relabel else given
    pose = start_pose(scenario.task)
    places = own_places @ rotation(pose.psi).T + (pose.x, pose.y)
    positions = control_points(scenario)
    assignments, unavailable = [], {}
    for name in names:
        try:
            planner = implementation("planner", name, METHOD)
            assignments.append(_assignment(scenario, name, planner, positions, places))
        except MissingExtraError as error:
            if name in (method, own):
                raise
            unavailable[name] = str(error)
    return Plans(
        scenario=scenario.name,
        seed=scenario.seed,
        relabel=scenario.planning.relabel,
        places=tuple((x, y) for x, y in places.tolist()),
        overlaps=overlaps(own_places),
        overlaps_as_given=overlaps(given),
        assignments=tuple(assignments),
        unavailable=unavailable,
    )


def control_points(scenario: Scenario) -> Floats:
    """Where the control points of a resolved scenario's robots start, (n, 2) in m in the world."""
    points = []
    for robot in scenario.robots:
        assert robot.pose is not None, "the scenario is resolved"
        points.append(unicycle.control_point(Pose(*robot.pose), robot.control_point_m))
    return np.array(points)


def _assignment(
    scenario: Scenario, name: str, planner: Planner, positions: Floats, places: Floats
) -> Assignment:
    try:
        found = plan(planner, positions, places)
    except ManipleError:
        raise
    except Exception as error:
        raise ManipleError(f"{METHOD} = {name!r}: the planner failed: {error}") from error
    starts = positions[list(found.order)]
    return Assignment(
        method=name,
        used=name == scenario.planning.method,
        robots=tuple(scenario.robots[index].id for index in found.order),
        total_m=found.total_m,
        longest_m=found.longest_m,
        crossings=found.crossings,
        separation_m=found.separation_m,
        build_s=Straight(starts, places, scenario.planning.speed_mps).duration_s,
    )


def picture(plans: Plans) -> Group:
    """The plans as text and a table."""
    chain = f"{_counted(plans.overlaps)} in the chain of triangles"
    if plans.relabel:
        chain += f", {plans.overlaps_as_given} with the places as the scenario numbers them"
    head = f"{plans.scenario}: {len(plans.places)} places, {chain}, seed {plans.seed}\n"
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("method")
    for heading in ("total", "longest", "crossings", "nearest", "straight"):
        table.add_column(heading, justify="right")
    table.add_column("who takes places 1 to " + str(len(plans.places)))
    for one in plans.assignments:
        table.add_row(*_cells(one))
    foot = (
        "\ntotal, longest: straight ways of the control points; crossings: pairs of ways that meet; nearest: "
        "the least distance\nbetween two control points, and straight: how long it takes, if all go in step; "
        "*: the scenario's method"
    )
    lacking = "".join(f"\n{name}: {why}" for name, why in plans.unavailable.items())
    return Group(Text(head), table, Text(foot + lacking))


def _cells(one: Assignment) -> Sequence[str]:
    return (
        f"{one.method}{' *' if one.used else ''}",
        f"{one.total_m:.2f} m",
        f"{one.longest_m:.2f} m",
        str(one.crossings),
        f"{one.separation_m:.2f} m",
        f"{one.build_s:.0f} s",
        " ".join(one.robots),
    )


def _counted(overlapping: int) -> str:
    if overlapping == 0:
        return "no overlaps"
    return f"{overlapping} overlap{'s' if overlapping > 1 else ''}"
