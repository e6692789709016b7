"""`maniple run`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from maniple.cli.progress import LiveProgress

if TYPE_CHECKING:
    from maniple.cli.api import Result
    from maniple.report.summary import Errors

_RECORDING = "Recording"

SplitSize = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Begin LOG-2.mcap, ... when a part has so many bytes: 500MB, 2GiB.",
        rich_help_panel=_RECORDING,
    ),
]
SplitTime = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS", help="The same after so much time of the run.", rich_help_panel=_RECORDING
    ),
]
CompressionOf = Annotated[
    str, typer.Option(metavar="zstd|none", help="Of the file.", rich_help_panel=_RECORDING)
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PATTERN",
        help="Record these topics only; * is one level, ** any number.",
        rich_help_panel=_RECORDING,
    ),
]
Without = Annotated[
    list[str] | None,
    typer.Option(metavar="PATTERN", help="Do not record these topics.", rich_help_panel=_RECORDING),
]
MinFree = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="End in order before less than this is free on the disk; by default 200MB.",
        rich_help_panel=_RECORDING,
    ),
]
Viz = Annotated[
    bool | None,
    typer.Option(
        "--viz/--no-viz",
        help="With channels for viewers, or without; by default with, and in virtual time without.",
        rich_help_panel=_RECORDING,
    ),
]


def run(
    scenario: Annotated[Path, typer.Argument(help="Scenario file (TOML).")],
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In one process and virtual time instead of real processes.")
    ] = False,
    speed: Annotated[
        float, typer.Option(help="Times real time, without --virtual and where all robots are simulated.")
    ] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="End after this many simulated seconds, done or not.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Instead of the scenario's.")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a field of the scenario.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Recording; by default a new file in logs/.")] = None,
    keep_alive: Annotated[
        bool,
        typer.Option("--keep-alive", help="Start again whatever dies, but for the simulator and vehicles."),
    ] = False,
    split_size: SplitSize = None,
    split_time: SplitTime = None,
    compression: CompressionOf = "zstd",
    topic: Topics = None,
    without: Without = None,
    min_free: MinFree = None,
    viz: Viz = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Run a scenario to the end of its task and record everything.

    Exit status: 0 if the task was completed without a collision, 1 if not, 2 bad input, 130 interrupted.
    """
    from maniple.cli import api
    from maniple.cli.recording_options import options_of

    recording = options_of(split_size, split_time, compression, topic or (), without or (), min_free, viz)
    with LiveProgress(Console(stderr=True), scenario.stem) as show:
        result = api.run(
            scenario,
            virtual=virtual,
            speed=speed,
            duration_s=duration,
            seed=seed,
            overrides=overrides or (),
            log=log,
            keep_alive=keep_alive,
            recording=recording,
            on_progress=show,
            on_notice=show.notice,
        )
    if json:
        typer.echo(msgspec.json.encode(result))
    else:
        console = Console()
        console.print(_summary(result))
        for part in result.logs or [result.log]:
            console.print("  recording", part, highlight=False, markup=False, soft_wrap=True)
        if result.unrecorded:
            console.print(f"  {result.unrecorded} messages are missing in it: maniple log info", style="red")
    raise typer.Exit(130 if result.interrupted else 0 if result.ok else 1)


def _summary(result: Result) -> Table:
    nearest = result.min_clearance_m
    clearance = "no ground truth" if nearest is None else f"{nearest:.3f} m"
    if nearest is not None and result.without_truth:
        clearance += f" (no ground truth of {', '.join(result.without_truth)})"
    outcome = "completed" if result.completed else "interrupted" if result.interrupted else "not completed"
    if result.collisions:
        outcome += f", {result.collisions} collisions"
    seen = result.estimated_final_error
    end = seen if result.final_error.position_m is None else result.final_error
    if result.completed and (off := end.out_of_formation_m):
        outcome += f", {off:.1f} m off its formation"
    counts = result.messages
    table = Table(box=None, show_header=False, padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("outcome", outcome, style="green" if result.ok else "red")
    table.add_row(
        "time", f"{result.duration_s:.1f} s in {result.wall_s:.1f} s ({result.real_time_factor:.1f} x)"
    )
    table.add_row("closest to anything", clearance)
    for name, errors in (("peak error", result.peak_error), ("final error", result.final_error)):
        table.add_row(name, _errors(errors))
    if end is seen:
        table.add_row("as the controller sees it", _errors(seen))
    if result.odometry_drift_m is not None and result.odometry_drift_m >= 0.001:
        table.add_row("odometry", f"off by {result.odometry_drift_m:.3f} m at the end")
    if result.lost_robots:
        table.add_row("lost on the way", ", ".join(result.lost_robots))
    if result.restarts:
        restarts = (f"{name} {times} x" if times > 1 else name for name, times in result.restarts.items())
        table.add_row("started again", ", ".join(restarts))
    age = result.command_age_ms
    if age.p50 is not None and age.p99 is not None:
        table.add_row("command age", f"{age.p50:.0f} ms median, {age.p99:.0f} ms p99")
    table.add_row(
        "messages",
        f"{counts.delivered} of {counts.sent} delivered; lost: {counts.lost_injected} injected, "
        f"{counts.lost_other} other; {counts.refused} refused",
    )
    return table


def _errors(errors: Errors) -> str:
    if errors.position_m is None:
        return "not known"
    return (
        f"{errors.position_m:.3f} m, {errors.orientation_rad:.3f} rad (pose), "
        f"{errors.distance_m:.3f} m, {errors.angle_rad:.3f} rad (shape)"
    )
