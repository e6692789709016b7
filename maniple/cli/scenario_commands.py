"""`maniple scenario`: is a scenario valid, what would run, how does it look."""

import json
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console

from maniple.cli.loading import load
from maniple.core.scenario.types import Scenario

app = typer.Typer(
    name="scenario",
    help="Check, draw and describe scenario files.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

PIPED_WIDTH = 160
"""Columns of text that does not go to a terminal."""

File = Annotated[Path, typer.Argument(metavar="FILE", help="Scenario file: TOML, or JSON by its suffix.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a value, as in guard.clearance=false."),
]
Seed = Annotated[int | None, typer.Option("--seed", help="Of every random stream.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@app.command()
def check(file: File, overrides: Set = None, seed: Seed = None, as_json: Json = False) -> None:
    """Say whether a scenario is valid, and what would run."""
    from maniple.cli.extensions import require_layers
    from maniple.cli.scenario_report import picture, plan_of

    scenario = _load(file, overrides, seed)
    require_layers(scenario)
    plan = plan_of(scenario)
    if as_json:
        typer.echo(msgspec.json.encode(plan).decode())
    else:
        terminal = Console(highlight=False)
        console = terminal if terminal.is_terminal else Console(highlight=False, width=PIPED_WIDTH)
        console.print(picture(plan))


@app.command()
def draw(
    file: File,
    out: Annotated[
        Path | None, typer.Option("--out", help="Picture to write: .png, .svg or .pdf; by default NAME.png.")
    ] = None,
    overrides: Set = None,
    seed: Seed = None,
    as_json: Json = False,
) -> None:
    """Make a picture of a scenario: what stands where and who goes where."""
    from maniple.cli.draw import save

    scenario = _load(file, overrides, seed)
    path = out or Path(f"{scenario.name}.png")
    save(scenario, path)
    typer.echo(json.dumps({"scenario": scenario.name, "picture": str(path)}) if as_json else f"drawn: {path}")


@app.command()
def schema() -> None:
    """Print the JSON Schema of scenario files, for editors."""
    from maniple.cli.scenario_docs import schema as document

    typer.echo(json.dumps(document(), indent=2))


@app.command(hidden=True)
def docs() -> None:
    """Print docs/scenario.md as the parameter types have it."""
    from maniple.cli.scenario_docs import markdown

    typer.echo(markdown(), nl=False)


def _load(file: Path, overrides: list[str] | None, seed: int | None) -> Scenario:
    return load(file, overrides or (), seed)
