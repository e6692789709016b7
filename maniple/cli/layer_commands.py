"""`maniple layer`: which implementations of the layers there are, and whether one keeps what it has to."""

from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli.extensions import KINDS, Kind, implementation, installed
from maniple.cli.loading import load, robot_models
from maniple.control import conformance
from maniple.control.conformance import Finding
from maniple.core.errors import ArgumentError
from maniple.core.scenario.parse import toml_data
from maniple.core.scenario.types import Avoidance, Compensation, Controller, RobotModel, Scenario

app = typer.Typer(
    name="layer",
    help="List the layers that can be replaced, and check implementations of them.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

CONTROL_POINT_M = 0.2
"""Where the control point is without a scenario."""

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


class Subject(msgspec.Struct, frozen=True):
    """What an implementation is checked with."""

    controller: Controller
    avoidance: Avoidance
    compensation: Compensation
    model: RobotModel
    control_point_m: float


@app.command("list")
def list_layers(as_json: Json = False) -> None:
    """List what is installed, of each kind."""
    found = installed()
    if as_json:
        typer.echo(msgspec.json.encode({"layers": [one._asdict() for one in found]}).decode())
        return
    table = Table("kind", "name", "package", "where", box=None, pad_edge=False)
    for one in found:
        table.add_row(*map(Text, (one.kind, one.name, one.package, one.value or "built in")))
    table.add_row(
        "kinematics", "(none)", "maniple", "built in: the inverse kinematics of the robot's own drive"
    )
    console = Console(width=None if Console().is_terminal else 160)
    console.print(table)


@app.command()
def check(
    kind: Annotated[str, typer.Argument(metavar="KIND", help=f"One of {', '.join(KINDS)}.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="As in a scenario.")],
    scenario: Annotated[
        Path | None,
        typer.Option("--scenario", help="Take the parameters, and the first robot, from this file."),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="KEY=VALUE", help="One of the layer's own, the value as in TOML."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Try an implementation on inputs of all kinds: what does it keep of what every one has to?"""
    chosen = _kind(kind)
    made = implementation(chosen, name, "NAME")
    subject = _subject(None if scenario is None else load(scenario), chosen, _options(options or []))
    _accepted(chosen, name, made, subject)
    findings = findings_of(chosen, made, subject)
    good = all(finding.holds for finding in findings)
    if as_json:
        listed = [{**finding._asdict(), "holds": finding.holds} for finding in findings]
        text = msgspec.json.encode({"kind": kind, "name": name, "holds": good, "findings": listed})
        typer.echo(text.decode())
    else:
        console = Console(highlight=False, soft_wrap=True)
        for finding in findings:
            console.print(Text(f"{'ok  ' if finding.holds else 'FAIL'}  {finding.name}"))
            if not finding.holds:
                console.print(Text(f"      {finding.counterexample}"))
        kept = sum(finding.holds for finding in findings)
        console.print(f"{kind} {name}: {kept} of {len(findings)} properties hold")
    if not good:
        raise typer.Exit(1)


def findings_of(kind: Kind, made: Any, subject: Subject) -> list[Finding]:
    """What the suite of a kind says of an implementation."""
    match kind:
        case "formation-law":
            return conformance.formation_law(made, subject.controller)
        case "planner":
            return conformance.planner(made)
        case "kinematics":
            return conformance.kinematics(made, subject.model, subject.control_point_m)
        case "avoidance":
            return conformance.avoidance(made, subject.avoidance, subject.model)
        case "compensation":
            return conformance.compensation(made, subject.compensation, subject.model)


def _accepted(kind: Kind, name: str, made: Any, subject: Subject) -> None:
    """Say once, not for every property, that a layer refuses its parameters."""
    arguments: dict[Kind, tuple[Any, ...]] = {
        "formation-law": (subject.controller,),
        "kinematics": (subject.model, subject.control_point_m),
        "avoidance": (subject.avoidance, subject.model),
        "compensation": (subject.compensation, subject.model),
    }
    if kind not in arguments:
        return
    try:
        made(*arguments[kind])
    except ValueError as error:
        raise ArgumentError(f"{kind} {name} refuses its parameters: {error}") from None
    except Exception:  # noqa: BLE001 - a fault of the layer, which its suite shows
        return


def _kind(text: str) -> Kind:
    for kind in KINDS:
        if kind == text:
            return kind
    if text == "driver":
        raise ArgumentError("KIND 'driver': drivers are no layers; they are checked by maniple driver check")
    raise ArgumentError(f"KIND {text!r}: must be one of {', '.join(KINDS)}")


def _options(given: list[str]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for option in given:
        key, equals, _ = option.partition("=")
        if not (key.strip() and equals):
            raise ArgumentError(f"--option {option!r}: must be KEY=VALUE, as in share=0.5")
        table |= toml_data(option.encode())
    return table


def _subject(scenario: Scenario | None, kind: Kind, options: dict[str, Any]) -> Subject:
    """The parameters of a scenario, or the defaults, with `options` added to those of the layer."""
    replace = msgspec.structs.replace
    if scenario is None:
        model, control_point_m = robot_models()["pioneer-3dx"], CONTROL_POINT_M
        law, avoid, compensate = Controller(), Avoidance(), Compensation()
    else:
        robot = scenario.robots[0]
        model, control_point_m = scenario.model_of(robot), robot.control_point_m
        law, avoid, compensate = scenario.controller, scenario.avoidance, scenario.compensation
    match kind:
        case "formation-law":
            law = replace(law, options={**law.options, **options})
        case "avoidance":
            avoid = replace(avoid, options={**avoid.options, **options})
        case "compensation":
            compensate = replace(compensate, options={**compensate.options, **options})
        case _ if options:
            raise ArgumentError(f"--option: a {kind} has none")
    return Subject(law, avoid, compensate, model, control_point_m)
