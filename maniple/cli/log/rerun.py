"""`maniple log rerun`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli.log.diff import show, show_changes, show_messages, show_series, shown

if TYPE_CHECKING:
    from maniple.core.scenario.types import Scenario
    from maniple.recording.reader import Recording
    from maniple.report.comparison_open_loop import OpenLoop


def rerun(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a field of the recorded scenario, as maniple run does; may be repeated.",
            show_default=False,
        ),
    ] = None,
    node: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE",
            help="Only this node (r3, controller, simulator); may be repeated. "
            "By default the controller and all robots.",
            show_default=False,
        ),
    ] = None,
    closed_loop: Annotated[
        bool,
        typer.Option(
            "--closed-loop",
            help="Run the scenario anew in virtual time, with the same seed, faults, and words of operators.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="With --closed-loop: the new recording; by default FILE-rerun beside FILE.",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw both into this folder, as PNG and SVG.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run a recording again under other parameters, and compare with what was.

    By default the nodes are called as they were and receive what they received (open loop): what they would
    have sent is compared with what they sent. Without --set that has to be the same.

    Exit status: 0 it was run again, and without --set all is the same; 1 it could not be to its end, or is
    not the same without --set; 2 bad input; 130 interrupted (then no recording is left behind). A realtime
    recording that is run again with --closed-loop is never the same to the byte, and none is asked of it.
    """
    from maniple.cli.extensions import require_layers
    from maniple.cli.loading import loads
    from maniple.cli.wall_clock import require_simulated
    from maniple.core.errors import ArgumentError
    from maniple.recording.reader import read

    if closed_loop and node:
        raise ArgumentError("--node: in a closed loop all nodes run")
    if out is not None and not closed_loop:
        raise ArgumentError("--out is for the recording that --closed-loop makes; pictures go to --plot DIR")
    recording = read(file)
    scenario = loads(
        recording.scenario_json,
        overrides or (),
        form="json",
        source=f"the scenario of {file}",
        folder=file.parent,
    )
    if closed_loop:
        require_simulated(scenario, "--closed-loop runs in virtual time")
    require_layers(scenario)
    if closed_loop:
        log = out or file.with_name(f"{file.stem}-rerun{file.suffix}")
        raise typer.Exit(_closed_loop(recording, scenario, log, bool(overrides), plot, as_json))
    raise typer.Exit(_open_loop(recording, scenario, node or (), bool(overrides), plot, as_json))


def _open_loop(
    recording: "Recording",
    scenario: "Scenario",
    nodes: Sequence[str],
    changed: bool,
    plot: Path | None,
    as_json: bool,
) -> int:
    """Run nodes again on what they received; returns the exit status."""
    from maniple.cli.nodes import factories
    from maniple.core.errors import ArgumentError
    from maniple.report.comparison_diff import draw
    from maniple.report.comparison_open_loop import rerun as run_again

    known = ("controller", *(robot.id for robot in recording.scenario.robots), "simulator")
    if unknown := sorted(set(nodes) - set(known)):
        raise ArgumentError(f"--node {unknown[0]}: must be one of {', '.join(known)}")
    chosen = nodes or known[:-1]
    with Console(stderr=True).status("") as status:
        again = run_again(
            recording, scenario, factories, chosen, lambda who: status.update(f"{who} is run again")
        )
    found = again.found
    if plot is not None:
        names = ("recorded", "run again")
        found = msgspec.structs.replace(found, pictures=draw(again.pairs, names, plot))
    if as_json:
        typer.echo(msgspec.json.encode(found))
    else:
        _show(found, changed)
    return 0 if found.complete and (changed or found.identical) else 1


def _closed_loop(
    recording: "Recording", scenario: "Scenario", log: Path, changed: bool, plot: Path | None, as_json: bool
) -> int:
    """Run the scenario anew in virtual time; returns the exit status."""
    from maniple.cli.machine import describe_machine
    from maniple.cli.progress import LiveProgress
    from maniple.cli.virtual import run_virtual
    from maniple.core.errors import RecordingError
    from maniple.core.time import to_seconds
    from maniple.host.operators import course_of
    from maniple.recording.reader import read
    from maniple.report.comparison_diff import compare, draw
    from maniple.report.comparison_tolerances import Tolerances

    if log.exists():
        raise RecordingError(f"{log} exists already; a recording is never overwritten: another --out")
    course = course_of(recording)
    lasted_s = None if course.done else to_seconds(course.lasted)
    with LiveProgress(Console(stderr=True), scenario.name) as progress:
        outcome = run_virtual(
            scenario,
            log,
            describe_machine(scenario, "virtual"),
            lasted_s,
            progress,
            progress.notice,
            course.inputs,
        )
    if outcome.interrupted:
        log.unlink()
        return 130
    exact = recording.metadata.get("mode") == "virtual" and not changed
    compared = compare(recording, read(log), Tolerances(), "message" if exact else "time")
    diff = compared.diff
    if plot is not None:
        diff = msgspec.structs.replace(
            diff, pictures=draw(compared.pairs, (recording.path.name, log.name), plot)
        )
    if as_json:
        typer.echo(msgspec.json.encode(diff))
    else:
        show(diff, Console(width=None if Console().is_terminal else 120), verdict=exact)
    return 0 if diff.same or not exact else 1


def _show(found: "OpenLoop", changed: bool) -> None:
    """What came of an open loop, for people."""
    console = Console(width=None if Console().is_terminal else 120)
    console.print(f"A  recorded in {found.recording}", highlight=False, markup=False, soft_wrap=True)
    console.print("B  run again on the same inputs", highlight=False)
    show_changes(console, "changed", found.changes)
    calls = sum(run.calls for run in found.nodes)
    console.print(f"{len(found.nodes)} lives of nodes, {calls} calls", highlight=False)
    for run in found.nodes:
        who = f"{run.node} (life {run.incarnation})"
        if run.problem:
            console.print(Text(f"{who}: {run.problem}", "red"), soft_wrap=True)
        if run.unproved:
            console.print(Text(f"{who}: {run.unproved} messages after the last journal"), soft_wrap=True)
    show_series(console, found.series, judged=False)
    _show_effort(console, found)
    if found.identical:
        count = sum(topic.identical for topic in found.messages)
        console.print(f"identical: {count} messages", style="green", highlight=False)
    else:
        show_messages(console, found.messages, judged=not changed)
        differ = sum(not topic.same for topic in found.messages)
        console.print(
            f"they differ on {differ} of {len(found.messages)} topics",
            style="" if changed else "red",
            highlight=False,
        )
    for picture in found.pictures:
        console.print(f"picture: {picture}", highlight=False, markup=False, soft_wrap=True)


def _show_effort(console: Console, found: "OpenLoop") -> None:
    """How often the robots were at their limits, where that differs."""
    table = Table("share of the time", "", box=None, padding=(0, 2, 0, 0))
    for heading in ("A", "B"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in found.effort:
        for what, a, b in (
            ("at its largest speed", row.saturated_a, row.saturated_b),
            ("the guard acts", row.guarded_a, row.guarded_b),
        ):
            if a != b:
                table.add_row(row.robot, what, shown(a), shown(b))
    if table.rows:
        console.print(table)
