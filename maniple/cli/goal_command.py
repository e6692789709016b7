"""`maniple goal`: tell a running platoon what to do from now on."""

import time
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from maniple.cli.loading import table_of
from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import (
    AGAIN_S,
    OPERATOR,
    Connect,
    Json,
    Order,
    Prefix,
    Timeout,
    operator_session,
)
from maniple.cli.way_file import with_files
from maniple.core import codec, topics
from maniple.core.errors import MessageError, RunError, ScenarioError
from maniple.core.messages import FormationState, Goal
from maniple.core.scenario.check_task import way_problems
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Formation, Parameters, Task

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

app = typer.Typer(
    name="goal",
    help="Tell a running platoon to hold, to go on, or what to do from now on.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Settle = Annotated[float, typer.Option("--settle", help="Seconds of rest at the end.")]

NUMBERS = {"ignore_unknown_options": True}
"""So that -1.5 is a number, not an option."""


class GoalTables(Parameters, frozen=True, kw_only=True):
    """What may be in a file for `goal task`."""

    task: Task | None = None
    formation: Formation | None = None


class Answer(msgspec.Struct, frozen=True):
    """What the controller says of a goal; what `--json` prints."""

    goal: str
    accepted: bool
    refused: str
    """Why not; empty if accepted."""
    phase: str
    task_time_s: float
    task_duration_s: float
    connect: str = ""
    """Where it was given."""


@app.command()
def hold(
    connect: Connect = LOCAL, prefix: Prefix = "maniple", json: Json = False, timeout: Timeout = 5.0
) -> None:
    """Stand still until told to resume."""
    _order(True, GoalTables(), connect, prefix, json, timeout)


@app.command()
def resume(
    connect: Connect = LOCAL, prefix: Prefix = "maniple", json: Json = False, timeout: Timeout = 5.0
) -> None:
    """Go on after a hold."""
    _order(False, GoalTables(), connect, prefix, json, timeout)


@app.command(context_settings=NUMBERS)
def target(
    x: Annotated[float, typer.Argument(help="Metres east.")],
    y: Annotated[float, typer.Argument(help="Metres north.")],
    heading: Annotated[float, typer.Argument(help="Radians from east, counter-clockwise.")],
    tolerance_m: Annotated[float, typer.Option("--tolerance-m", help="Metres a triangle may be off.")] = 0.02,
    tolerance_rad: Annotated[float, typer.Option("--tolerance-rad", help="Radians it may be off.")] = 0.02,
    settle: Settle = 0.0,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Stand at a pose with the formation's frame."""
    task = {"kind": "positioning", "target": [x, y, heading], "settle_s": settle}
    tolerances = {"tolerance_m": tolerance_m, "tolerance_rad": tolerance_rad}
    _order(None, tables_of({"task": task | tolerances}), connect, prefix, json, timeout)


@app.command(context_settings=NUMBERS)
def line(
    x0: Annotated[float, typer.Argument(help="Metres east, of the start.")],
    y0: Annotated[float, typer.Argument(help="Metres north, of the start.")],
    x1: Annotated[float, typer.Argument(help="Metres east, of the end.")],
    y1: Annotated[float, typer.Argument(help="Metres north, of the end.")],
    speed: Annotated[float, typer.Option(help="Metres a second.")],
    settle: Settle = 0.0,
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Follow a line with the formation's origin, facing along it."""
    task = {"kind": "line", "start": [x0, y0], "end": [x1, y1], "speed_mps": speed, "settle_s": settle}
    _order(None, tables_of({"task": task}), connect, prefix, json, timeout)


@app.command()
def shape(
    kind: Annotated[str, typer.Argument(help="line-abreast, vee, wedge, polygon or column.")],
    spacing: Annotated[float, typer.Option(help="Metres between neighbours.")],
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Take up another shape on the way."""
    formation = {"shape": {"kind": kind, "spacing_m": spacing}}
    _order(None, tables_of({"formation": formation}), connect, prefix, json, timeout)


@app.command()
def task(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML with a table task, formation, or both.")],
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Do the task, in the formation, that a file says as a scenario would."""
    _order(None, load(file), connect, prefix, json, timeout)


def load(file: Path) -> GoalTables:
    """The task and the formation in a file, with the way of a CSV file it names.

    Raises:
        ScenarioError: names the file and what is wrong with it.
    """
    data = table_of(file)
    try:
        return tables_of(data, file.parent)
    except ScenarioError as error:
        lines = str(error).splitlines()
        raise ScenarioError("\n".join(f"{file}: {line}" for line in lines)) from None


def tables_of(data: dict[str, Any], folder: Path = Path()) -> GoalTables:
    """The task and the formation that `data` describes.

    Raises:
        ScenarioError: a line for each thing that is wrong, as far as that can be told without the robots.
    """
    tables = parameters_of(GoalTables, data)
    if tables.task is None:
        if tables.formation is None:
            raise ScenarioError("has neither [task] nor [formation]; must have one of them, or both")
        return tables
    loaded = with_files(tables.task, folder)
    if found := list(way_problems(loaded)):
        raise ScenarioError("\n".join(found))
    return GoalTables(task=loaded, formation=tables.formation)


def send(goal: Goal, session: "ZenohSession", timeout_s: float) -> Answer:
    """Give a goal to the controller, stamped by the clock of its run, and return its answer.

    Raises:
        RunError: no controller is there, or none answers within the time.
    """
    if not session.lives("controller", min(timeout_s, 2.0)):
        raise RunError("no controller is running there")
    states: SimpleQueue[bytes] = SimpleQueue()
    session.subscribe(topics.FORMATION_STATE, lambda _, data: states.put(data))
    session.settle()
    order = Order(session, topics.FORMATION_GOAL, goal)
    until, due = time.monotonic() + timeout_s, 0.0
    while (now := time.monotonic()) < until:
        if now >= due:
            order.send()
            due = now + AGAIN_S
        if (state := _next(states, min(due, until) - now)) is not None and state.goal == goal.id:
            return Answer(
                goal=goal.id,
                accepted=not state.goal_refused,
                refused=state.goal_refused,
                phase=state.phase,
                task_time_s=state.task_time_s,
                task_duration_s=state.task_duration_s,
            )
    raise RunError(f"the controller did not answer within {timeout_s:g} s")


def _next(states: SimpleQueue[bytes], wait_s: float) -> FormationState | None:
    try:
        message = codec.decode(topics.FORMATION_STATE, states.get(timeout=max(wait_s, 0.0)))
    except (Empty, MessageError):
        return None
    assert isinstance(message, FormationState)
    return message


def _order(
    holds: bool | None, tables: GoalTables, connect: str, prefix: str, as_json: bool, timeout_s: float
) -> None:
    """Send a goal, say what became of it, and end with status 0 if it is accepted, else 1."""
    goal = Goal(id=f"{OPERATOR}-{time.time_ns()}", task=tables.task, formation=tables.formation, hold=holds)
    with operator_session(connect, prefix, timeout_s) as session:
        answer = msgspec.structs.replace(send(goal, session, timeout_s), connect=connect)
    if as_json:
        typer.echo(msgspec.json.encode(answer).decode())
    elif answer.accepted:
        done, total = answer.task_time_s, answer.task_duration_s
        typer.echo(f"accepted: {answer.phase}, at {done:.1f} of {total:.1f} s ({connect})")
    else:
        typer.echo(f"refused: {answer.refused} ({connect})")
    raise typer.Exit(0 if answer.accepted else 1)
