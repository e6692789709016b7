"""`maniple preflight`: what a platoon lacks before it moves, and the test of its emergency stop."""

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import Connect, Json, Prefix, Timeout, latched, operator_session
from maniple.cli.stop_trial import Step, Trial, Watch, step_of, try_stop
from maniple.core import topics
from maniple.core.errors import RunError
from maniple.core.messages import Check, FormationState, Mission

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

SETTLE_S = 5.0
"""After the test every robot has told within this that it was tested."""

_STATES = {True: ("ok", "green"), False: ("missing", "red"), None: ("unknown", "yellow")}

Estop = Annotated[
    bool,
    typer.Option("--estop/--no-estop", help="Test the emergency stop once everything else holds, or do not."),
]
Wait = Annotated[
    float, typer.Option(min=0.0, max=86400.0, help="Seconds to wait for what is missing.", metavar="S")
]


class Line(msgspec.Struct, frozen=True):
    """One thing that has to hold of one robot."""

    robot: str
    item: str
    state: str
    """ok, missing, or unknown: that can't be known before another line holds."""
    why: str


class Found(msgspec.Struct, frozen=True):
    """What `--json` prints."""

    connect: str
    ok: bool
    """Whether nothing is missing."""
    asked: bool
    """Whether the scenario asks for a pre-flight check."""
    begun: bool
    """Whether the platoon has begun: then only robots that have to be taken in again are looked at."""
    phase: str
    lines: tuple[Line, ...]
    estop: Trial | None
    """The test of the emergency stop; null where none was made."""
    notice: str
    """What else there is to say."""


def preflight(
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    estop: Estop = True,
    wait: Wait = 10.0,
    json: Json = False,
    timeout: Timeout = 5.0,
) -> None:
    """Show what the platoon lacks before it may move, and test its emergency stop.

    Once everything else holds, every robot is made to stand by the emergency stop and armed again. The
    platoon begins by itself as soon as nothing is missing. Of one that has begun the stop is not tested.

    Exit status 0 if nothing is missing, 1 if something is.
    """
    with operator_session(connect, prefix, timeout) as session:
        found = look(session, connect, estop=estop, wait_s=wait, timeout_s=timeout)
    if json:
        typer.echo(msgspec.json.encode(found).decode())
    else:
        show(found)
    raise typer.Exit(0 if found.ok else 1)


def look(session: "ZenohSession", connect: str, *, estop: bool, wait_s: float, timeout_s: float) -> Found:
    """What is missing, after the test of the emergency stop if it is due within the time.

    Raises:
        RunError: there is no controller.
    """
    watch = Watch(session)
    until = time.monotonic() + wait_s
    first = state = _heard(watch, timeout_s)
    trial: Trial | None = None
    while (step := step_of(state)) in ("wait", "test"):
        if step == "test" and estop and trial is None:
            trial = _tried(session)
            until = max(until, time.monotonic() + SETTLE_S) if trial.ok else 0.0
        elif time.monotonic() >= until:
            break
        state = _heard(watch, timeout_s)
    if step == "begun" and step_of(first) != "begun":
        checks: Sequence[Check] = [
            msgspec.structs.replace(one, holds=True, why="") for one in first.preflight
        ]
    else:
        checks = state.preflight
    return _found(connect, state, step, checks, trial, bool(checks) or _was_asked(session), estop)


def _heard(watch: Watch, timeout_s: float) -> FormationState:
    if (state := watch.newest(timeout_s)) is None:
        raise RunError(
            f"no controller has said anything within {timeout_s:g} s: it is the one that looks at the robots"
        )
    return state


def _tried(session: "ZenohSession") -> Trial:
    try:
        return try_stop(session)
    except KeyboardInterrupt:
        typer.echo("interrupted: the emergency stop may stand; maniple arm releases it", err=True)
        raise


def _was_asked(session: "ZenohSession") -> bool:
    """Whether anybody has ever passed."""
    mission = latched(session, topics.FORMATION_MISSION)
    return isinstance(mission, Mission) and any(seat.passed for seat in mission.seats)


def _found(
    connect: str,
    state: FormationState,
    step: Step,
    checks: Sequence[Check],
    trial: Trial | None,
    asked: bool,
    estop: bool,
) -> Found:
    lines = tuple(Line(one.robot, one.item, _STATES[one.holds][0], one.why) for one in checks)
    missing = any(one.holds is not True for one in checks)
    if not asked:
        notice = "nothing is asked of this platoon before it moves: see preflight.enabled of its scenario"
    elif step == "begun":
        notice = f"the platoon has begun: {state.phase}"
        if estop and trial is None:
            notice += "; its emergency stop is not tested now"
    elif step == "wait" and estop:
        notice = "the emergency stop is tested once everything else holds"
    else:
        notice = ""
    return Found(connect, not missing, asked, step == "begun", state.phase, lines, trial, notice)


def show(found: Found) -> None:
    """For people: a table of all lines, and what came of the test."""
    console = Console()
    for part in _parts(found):
        console.print(part, highlight=False, soft_wrap=not isinstance(part, Table))


def _parts(found: Found) -> Iterator[Table | Text]:
    if found.lines:
        table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
        for title in ("robot", "item", "state", "why"):
            table.add_column(title, no_wrap=title != "why", overflow="fold")
        colours = dict(_STATES.values())
        for line in found.lines:
            table.add_row(line.robot, line.item, Text(line.state, style=colours[line.state]), Text(line.why))
        yield table
    if found.estop is not None:
        yield Text(f"emergency stop {found.estop.why}", style="green" if found.estop.ok else "red")
    if found.notice:
        yield Text(found.notice)
    missing = sum(line.state != "ok" for line in found.lines)
    verdict = f"{missing} of {len(found.lines)} do not hold" if missing else "nothing is missing"
    yield Text.assemble((verdict, "red" if missing else "green"), (f" ({found.connect})", "dim"))
