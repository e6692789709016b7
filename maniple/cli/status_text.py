"""What `maniple status` shows to people."""

from collections.abc import Iterator
from typing import NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from maniple.cli.platoon_state import LinkState, PlatoonState, RobotState
from maniple.cli.progress import MODE_COLOURS
from maniple.core.edges import SUFFIXES

_COLUMNS = ("robot", "mode", "guard", "command age", "worst", "odometry age", "round trip")
_LEFT = 3

_RECORDERS = {
    "paused": "is paused",
    "rolling": "only remembers the last seconds",
    "keeping": "only remembers the last seconds, and writes them",
}
"""What recorders do that do not record."""


class Pair(NamedTuple):
    """All topics from one node to another."""

    source: str
    destination: str
    received: int
    missing: int
    injected: int
    refused: int


def picture(state: PlatoonState) -> RenderableType:
    """The state of a platoon as lines and tables."""
    return Group(*_heads(state), _robots(state), *_reasons(state), *_links(state))


def pairs(links: tuple[LinkState, ...]) -> list[Pair]:
    """The links by pair of nodes, those that lost most first."""
    found: dict[tuple[str, str], Pair] = {}
    for link in links:
        before = found.get((link.source, link.destination), Pair("", "", 0, 0, 0, 0))
        found[link.source, link.destination] = Pair(
            link.source,
            link.destination,
            before.received + link.received,
            before.missing + link.missing,
            before.injected + link.injected,
            before.refused + link.refused,
        )
    return sorted(found.values(), key=lambda pair: (-_share(pair.missing, pair), pair))


def _heads(state: PlatoonState) -> Iterator[RenderableType]:
    if state.stopped:
        why = f": {state.stop_reason}" if state.stop_reason else ""
        yield Text(f"EMERGENCY STOP{why}", style="bold red")
    yield _phase(state).append(f" ({state.connect})", style="dim")
    there = sum(bool(robot.lives) for robot in state.robots)
    nodes = ("controller", "simulator", "recorder", "router")
    others = [*(name for name in nodes if name in state.nodes), *_beside(state)]
    missing = [robot.id for robot in state.robots if not robot.lives]
    line = Text(f"{there} of {len(state.robots)} robots there, {', '.join(others) or 'nobody else'}")
    if missing:
        line.append(f"; not there: {', '.join(missing)}", style="red")
    if "controller" not in state.nodes:
        line.append("; no controller", style="red")
    yield line
    for recorder in state.recorders:
        if recorder.state != "recording":
            why = f": {recorder.reason}" if recorder.reason else ""
            does = _RECORDERS.get(recorder.state, recorder.state)
            yield Text(f"recorder {recorder.name} {does}{why}", style="yellow")
    yield Text("faults: ").append(_faults(state))


def _beside(state: PlatoonState) -> Iterator[str]:
    """The processes that are there beside the agents of robots, by kind."""
    for end in SUFFIXES:
        if of := [robot.id for robot in state.robots if robot.id + end in state.nodes]:
            yield f"{end[1:]}{'s' * (len(of) > 1)} of {' '.join(of)}"


def _phase(state: PlatoonState) -> Text:
    if not state.phase:
        return Text("no controller has said anything yet", style="yellow")
    line = Text(f"{state.phase}, {state.task_time_s:.1f} of {state.task_duration_s:.1f} s")
    if state.waits_for and not state.reason.startswith("waits for"):
        line.append(f", waits for {', '.join(state.waits_for)}", style="yellow")
    if state.reason:
        line.append(f": {state.reason}", style="yellow")
    if not state.controlled:
        line.append(" (as last heard)", style="red")
    return line


def _faults(state: PlatoonState) -> Text:
    """The plan in one line."""
    names = {"rules": "rule", "partitions": "partition", "crashes": "crash", "freezes": "freeze"}
    said = []
    for key, name in names.items():
        if entries := state.faults[key]:
            now = sum(entry["state"] == "running" for entry in entries)
            plural = name + ("" if len(entries) == 1 else "es" if name == "crash" else "s")
            said.append(f"{len(entries)} {plural} ({now} now)")
    return Text(", ".join(said), style="yellow") if said else Text("none")


def _robots(state: PlatoonState) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for index, title in enumerate(_COLUMNS):
        table.add_column(title, justify="left" if index < _LEFT else "right", no_wrap=True)
    for robot in state.robots:
        lives = f" ({', '.join(map(str, robot.lives))})" if robot.lives not in ((), (1,)) else ""
        table.add_row(
            robot.id + lives,
            _mode(robot),
            robot.guard,
            _seconds(robot.command_age_s),
            _seconds(robot.command_age_max_s),
            _seconds(robot.odometry_age_s),
            _seconds(robot.round_trip_s),
        )
    return table


def _mode(robot: RobotState) -> Text:
    if not robot.lives:
        return Text("not there", style="red")
    if not robot.mode:
        return Text("silent", style="red")
    return Text(robot.mode, style=MODE_COLOURS.get(robot.mode, ""))


def _reasons(state: PlatoonState) -> Iterator[Text]:
    for robot in state.robots:
        if why := _why(robot):
            yield Text.assemble((robot.id, "bold"), ": ", why)


def _why(robot: RobotState) -> str:
    """Everything about a robot that is not as it should be. An emergency stop is told once for all."""
    said = [robot.reason] if robot.reason and robot.mode != "emergency" else []
    if robot.driver not in ("", "active"):
        said.append(f"drive {robot.driver}")
    if not robot.localised:
        said.append("does not know where it is")
    if robot.state not in ("", "present"):
        said.append(f"{robot.state} to the controller")
    if robot.state == "lost" and robot.lacks:
        said.append(f"lacks for the pre-flight check: {robot.lacks}")
    return "; ".join(said)


def _links(state: PlatoonState) -> Iterator[RenderableType]:
    found = pairs(state.links)
    bad = [pair for pair in found if pair.missing or pair.refused]
    if not found:
        return
    if not bad:
        yield Text(f"{len(found)} link{'s' * (len(found) > 1)}, nothing missing", style="dim")
        return
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for title in ("link", "received", "missing", "injected", "refused"):
        table.add_column(title, justify="left" if title == "link" else "right", no_wrap=True)
    for pair in bad:
        table.add_row(
            f"{pair.source} to {pair.destination}",
            f"{pair.received}",
            f"{100 * _share(pair.missing, pair):.1f} %",
            f"{100 * _share(pair.injected, pair):.1f} %",
            f"{pair.refused}" if pair.refused else "",
        )
    yield table
    if good := len(found) - len(bad):
        yield Text(f"{good} other link{'s' * (good > 1)}, nothing missing", style="dim")


def _share(count: int, pair: Pair) -> float:
    return count / max(pair.received + pair.missing, 1)


def _seconds(value: float) -> str:
    return "-" if value < 0 else f"{value:.2f} s"
