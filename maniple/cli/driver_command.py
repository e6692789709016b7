"""`maniple driver`: which drivers there are, and what one makes of its vehicle. `driver run` is of
`node_commands`."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.cli import node_commands
from maniple.cli.extensions import NEEDS, Installed, drivers_of, implementation, installed, version_of
from maniple.cli.interrupt import on_interrupt
from maniple.cli.loading import load, range_finders, robot_models
from maniple.control.limits import limits_of
from maniple.core import edges
from maniple.core.errors import ArgumentError, ManipleError
from maniple.core.scenario.parse import scenario_of, toml_data
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.types import Robot, Scenario
from robot_agent.drivers import capabilities_of
from robot_agent.drivers.interface import Capabilities, DriverFactory

if TYPE_CHECKING:
    from robot_agent.drivers.conformance import Finding, Look

app = typer.Typer(
    name="driver",
    help="List the drivers of robots, check one and its vehicle, or run one.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_PLAIN = """
name = "plain"
formation.points = [[0, 0]]
task = {{ kind = "line", start = [0, 0], end = [1, 0], speed_mps = 0.1 }}
robots = [{{ id = "r1", driver = "{name}", mavlink.connection = "tcp:127.0.0.1:5760" }}]
"""
"""A robot of the default type, to ask a driver what it can do with one."""

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


class Listed(msgspec.Struct, frozen=True):
    """One driver that scenarios can name."""

    name: str
    package: str
    """What brings it, with its version."""
    value: str
    """Where it is: "module:attribute"; empty for a built-in one."""
    dependencies: dict[str, str | None]
    """The distributions it needs, with the version that is there; null where it is not."""
    usable: bool
    """Whether all are there, and it can be imported."""
    capabilities: dict[str, Any] | None
    """With a robot of the default type; null where that does not suit it."""
    note: str
    """Why not."""


class Checked(msgspec.Struct, frozen=True):
    """What became of `maniple driver check`; what `--json` prints."""

    name: str
    robot: str
    """Empty without a scenario."""
    ok: bool
    live: bool
    """Whether the vehicle was driven."""
    dependencies: dict[str, str | None]
    capabilities: dict[str, Any] | None
    look: dict[str, Any] | None
    """What the vehicle answered; null where it was not asked."""
    missing: list[str]
    """What the pre-flight check would miss."""
    findings: list[dict[str, Any]]


@app.command("list")
def list_drivers(as_json: Json = False) -> None:
    """List the drivers that scenarios can name, what they need, and what they can do.

    The capabilities are those with a robot of the default type: limits come from the robot's model.
    """
    found = [_listed(one) for one in _all()]
    if as_json:
        typer.echo(msgspec.json.encode({"drivers": found}).decode())
        return
    table = Table("name", "package", "needs", "can", box=None, pad_edge=False)
    for one in found:
        can = one.note if one.capabilities is None else _short(Capabilities(**one.capabilities))
        table.add_row(*map(Text, (one.name, one.package, _needs_text(one.dependencies), can)))
    Console(width=None if Console().is_terminal else 160).print(table)


@app.command()
def check(
    name: Annotated[str, typer.Argument(metavar="NAME", help="As in robots.driver or robots.scans.")],
    scenario: Annotated[
        Path | None,
        typer.Option("--scenario", help="With the robot and its vehicle; without, only what it needs."),
    ] = None,
    robot: Annotated[
        str, typer.Option("--robot", metavar="ID", help="By default the first with this driver.")
    ] = "",
    hardware: Annotated[
        str,
        typer.Option(
            envvar="MANIPLE_HARDWARE", help="Router of the hardware network, for drivers that use one."
        ),
    ] = "",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a parameter of the scenario."),
    ] = None,
    patience: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Seconds to wait for the vehicle.")
    ] = 30.0,
    live: Annotated[bool, typer.Option("--live", help="Drive the vehicle, too.")] = False,
    sure: Annotated[
        bool, typer.Option("--yes-it-may-move", help="It stands free, or on blocks, and may drive.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Try a driver with its vehicle: does it keep what every driver has to?

    Connects, shows what the vehicle answers and what the pre-flight check would miss, and goes through the
    suite of docs/drivers.md. The vehicle is never armed nor told to move, unless with --live: then it drives
    up to 2 m at a time, at no more than 0.3 m/s, but for a moment at its full speed.

    Exit status: 0 it keeps all that was tried, 1 it does not, or its vehicle is not fit, 2 bad input, 130
    interrupted.
    """
    if name == edges.SIMULATOR:
        raise ArgumentError(
            "NAME 'simulator': is no driver of its own but a node; maniple run SCENARIO runs it"
        )
    if live and not sure:
        raise ArgumentError(
            "--live drives the vehicle, up to 2 m at a time and for a moment at its full speed: put it on "
            "blocks or where it has room, somebody at its emergency stop, and say --yes-it-may-move"
        )
    if live and scenario is None:
        raise ArgumentError("--live: needs --scenario, with the robot")
    factory = implementation("driver", name, "NAME")
    needs = _dependencies(next(one for one in _all() if one.name == name))
    if scenario is None:
        if robot or overrides:
            raise ArgumentError(f"{'--robot' if robot else '--set'}: needs --scenario")
        found = Checked(name, "", all(needs.values()), False, needs, None, None, [], [])
    else:
        resolved = load(scenario, overrides or [])
        chosen = _robot(resolved, name, robot)
        found = _tried(name, factory, resolved, chosen, needs, hardware, patience, live, as_json)
    if as_json:
        typer.echo(msgspec.json.encode(found).decode())
    elif scenario is None:
        advice = "with --scenario its vehicle is tried, too"
        if name in NEEDS and not found.ok:
            advice = f"pip install 'maniple[{name}]'"
        typer.echo(f"{name}: needs {_needs_text(needs)}; {advice}")
    raise typer.Exit(0 if found.ok else 1)


@app.command(
    "run",
    help="Run the driver of one robot: what stands between its agent and its hardware.",
    add_help_option=False,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def _run(context: typer.Context) -> None:
    node_commands.main(["driver", "run", *context.args])


def _tried(
    name: str,
    factory: DriverFactory,
    scenario: Scenario,
    robot: Robot,
    needs: dict[str, str | None],
    endpoint: str,
    patience_s: float,
    live: bool,
    quiet: bool,
) -> Checked:
    """The whole check of a driver with a robot's vehicle; told as it goes, unless `quiet`."""
    from robot_agent.drivers import conformance

    say = _Say(quiet)
    say.line(f"driver {name} of {robot.id}: needs {_needs_text(needs)}")
    factory = drivers_of(scenario, (robot,))[name]
    able = factory(scenario, robot, endpoint).capabilities
    say.line(f"can    {_short(able)}")
    rig, scans_only = conformance.WallRig(), name != robot.driver
    findings: list[Finding] = []
    with on_interrupt(_interrupt):
        say.line(f"       waits for its vehicle, at most {patience_s:g} s")
        seen = conformance.look(
            factory,
            scenario,
            robot.id,
            rig,
            endpoint=endpoint,
            patience_s=patience_s,
            scans_only=scans_only,
        )
        say.look(seen)
        missing = list(_missing(scenario, robot, name, seen))
        for line in missing:
            say.line(f"FAIL   pre-flight: {line}")
        if seen.state == "configured":
            findings = conformance.check(
                factory,
                scenario,
                robot.id,
                rig,
                endpoint=endpoint,
                moves=live,
                patience_s=patience_s,
                scans_only=scans_only,
                told=say.finding,
            )
    kept = sum(finding.holds for finding in findings)
    left_out = sum(bool(finding.left_out) for finding in findings)
    ok = bool(findings) and not missing and kept + left_out == len(findings)
    if findings:
        say.line(f"{name}: {kept} of {len(findings) - left_out} properties hold, {left_out} were not tried")
    listed = [{**finding._asdict(), "holds": finding.holds} for finding in findings]
    return Checked(name, robot.id, ok, live, needs, able._asdict(), _plain(seen), missing, listed)


class _Say:
    """Tells people how it goes."""

    def __init__(self, quiet: bool) -> None:
        self._console = Console(highlight=False, soft_wrap=True, quiet=quiet)

    def line(self, text: str) -> None:
        self._console.print(Text(text))

    def look(self, seen: "Look") -> None:
        """What the vehicle answered."""
        answers = dict(seen.answers)
        if seen.state == "configured":
            answers |= {"motion": f"{seen.motion_hz:.1f} Hz", "scans": f"{seen.scan_hz:.1f} Hz"}
            if seen.motion is not None and seen.motion.pose is not None:
                x, y, psi = seen.motion.pose
                answers["pose"] = f"({x:.2f} m, {y:.2f} m, {psi:.2f} rad)"
        table = Table.grid(padding=(0, 2))
        for what, answer in answers.items():
            table.add_row(Text(f"       {what}"), Text(answer))
        if answers:
            self._console.print(table)
        if seen.state == "configured":
            self.line(f"ok     configured after {seen.after_s:.1f} s")

    def finding(self, finding: "Finding") -> None:
        """One property."""
        word = "ok  " if finding.holds else "--  " if finding.left_out else "FAIL"
        why = f" ({finding.left_out})" if finding.left_out else ""
        self.line(f"{word}   {finding.name}{why}")
        if finding.counterexample:
            self.line(f"       {finding.counterexample}")


def _missing(scenario: Scenario, robot: Robot, name: str, seen: "Look") -> Iterator[str]:
    """What the pre-flight check would say of this robot, as far as its driver knows."""
    drives = robot.driver == name
    if seen.state != "configured":
        yield f"controllable: {seen.reason}"
        return
    if drives and seen.motion is not None and not seen.motion.controllable:
        yield f"controllable: {seen.reason}"
    if drives and (seen.motion is None or not (seen.motion.ticks or seen.motion.pose is not None)):
        yield "localised: it does not say how it moves"
    if name == (robot.scans or robot.driver) and limits_of(scenario, robot).needs_ranges and not seen.scan_hz:
        yield "sees: no ranges have come, and its own layers go by them"


def _interrupt() -> NoReturn:
    """Leaves the suite by way of what makes the vehicle stand."""
    raise KeyboardInterrupt


def _plain(seen: "Look") -> dict[str, Any]:
    motion = None if seen.motion is None else msgspec.to_builtins(seen.motion)
    return {**seen._asdict(), "motion": motion, "answers": dict(seen.answers)}


def _robot(scenario: Scenario, name: str, wanted: str) -> Robot:
    """The one that is meant.

    Raises:
        ArgumentError: there is no such robot, or the driver is not its own.
    """
    those = [robot for robot in scenario.robots if name in (robot.driver, robot.scans)]
    if not those:
        raise ArgumentError(
            f"NAME {name!r}: no robot of this scenario has it as robots.driver or robots.scans"
        )
    if not wanted:
        return those[0]
    for robot in those:
        if robot.id == wanted:
            return robot
    ids = ", ".join(robot.id for robot in those)
    raise ArgumentError(f"--robot {wanted!r}: must be one with the driver {name}: {ids}")


def _all() -> list[Installed]:
    """The simulator, which stands for one, and all drivers."""
    simulator = Installed("driver", edges.SIMULATOR, "maniple", "")
    return [simulator, *(one for one in installed(["driver"]) if one.name != edges.SIMULATOR)]


def _listed(one: Installed) -> Listed:
    dependencies = _dependencies(one)
    able, note = _capabilities(one.name)
    usable = all(dependencies.values()) and "can't be imported" not in note
    return Listed(one.name, one.package, one.value, dependencies, usable, able and able._asdict(), note)


def _capabilities(name: str) -> tuple[Capabilities | None, str]:
    """With a robot of the default type, or why that is not known."""
    try:
        plain = scenario_of(toml_data(_PLAIN.format(name=name).encode()))
        scenario = resolve(plain, robot_models(), range_finders())
        return capabilities_of(scenario, scenario.robots[0], drivers_of(scenario)), ""
    except ManipleError as error:
        return None, f"depends on its parameters: {error}"


def _dependencies(one: Installed) -> dict[str, str | None]:
    """The distributions a driver needs, with their versions, or None for those that are not there."""
    from importlib.metadata import PackageNotFoundError, requires

    if not one.value:
        names = NEEDS.get(one.name, ())
    else:
        try:
            lines = requires(one.package.rsplit(" ", 1)[0]) or []
        except PackageNotFoundError:
            lines = []
        parts = [re.match(r"[A-Za-z0-9][A-Za-z0-9._-]*", line) for line in lines if "extra ==" not in line]
        names = tuple(part[0] for part in parts if part and part[0] != "maniple")
    return {name: version_of(name) for name in names}


def _needs_text(dependencies: Mapping[str, str | None]) -> str:
    told = [f"{name} {version or '(missing)'}" for name, version in dependencies.items()]
    return ", ".join(told) or "nothing else"


def _short(able: Capabilities) -> str:
    parts = [f"{able.u_max_mps:g} m/s"]
    if able.v_max_mps:
        parts.append(f"{able.v_max_mps:g} m/s sideways")
    parts.append(f"{able.w_max_radps:g} rad/s" if able.accepts_yaw_rate else "no turning rate")
    parts.append("backwards" if able.reverse else "not backwards")
    parts.append(f"motion {able.motion_hz:g} Hz")
    parts.append(f"scans {able.scan_hz:g} Hz" if able.scan_hz else "no scans")
    parts.append("poses in the world" if able.frame == edges.WORLD else "a frame of its own")
    return ", ".join(parts)
