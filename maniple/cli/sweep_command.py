"""`maniple sweep`."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console


def sweep(
    file: Annotated[Path, typer.Argument(help="Sweep file (TOML).")],
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at a time; by default one for each core.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; by default logs/sweep-NAME.")
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Forget the runs that are there and begin anew.")
    ] = False,
    keep_logs: Annotated[bool, typer.Option("--keep-logs", help="Keep the recording of every run.")] = False,
    check: Annotated[bool, typer.Option("--check", help="Only check every combination.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run a grid of scenarios over seeds in virtual time, on all cores; results as Parquet and pictures.

    A sweep that was interrupted or killed goes on where it was: the same command again.

    Exit status: 0 all runs made, 1 some runs failed, 2 bad input, 130 interrupted.
    """
    from maniple.cli.sweep import study
    from maniple.cli.sweep.plan import plan_of

    console = Console(stderr=True)
    if check:
        plan = plan_of(file)
        said = {"sweep": plan.sweep.name, "runs": len(plan.jobs)}
        typer.echo(
            msgspec.json.encode(said) if as_json else f"{plan.sweep.name}: {len(plan.jobs)} runs, all valid"
        )
        return
    outcome = study.sweep(file, jobs, out, fresh, keep_logs, console)
    if as_json:
        typer.echo(msgspec.json.encode(outcome))
    else:
        study.tell(outcome, Console())
    raise typer.Exit(130 if outcome.interrupted else 1 if outcome.failed else 0)
