"""How a run is going, for people: gathered from messages, drawn with rich."""

import time
from collections.abc import Mapping
from types import MappingProxyType, TracebackType
from typing import NamedTuple, Self

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from maniple.core.messages import FormationState, Message, Status, unpack_floats
from maniple.core.scenario.types import Scenario


class RobotProgress(NamedTuple):
    """One robot, as its last status says."""

    mode: str
    guard: str
    command_age_s: float
    reason: str


class Progress(NamedTuple):
    """The platoon, as the last messages say."""

    phase: str
    task_time_s: float
    task_duration_s: float
    position_error_m: float
    """The largest over the triangles."""
    angle_error_rad: float
    robots: Mapping[str, RobotProgress]
    waits_for: tuple[str, ...] = ()
    """The robots that do not follow."""
    reason: str = ""
    """Why the platoon waits or holds, in the controller's words."""
    connect: str = ""
    """Where the router listens; empty in virtual time."""
    processes: Mapping[str, str] = MappingProxyType({})
    """The processes that are "dead" or "frozen" now; none in virtual time."""


class ProgressWatch:
    """Gathers progress from formation states and robot statuses."""

    def __init__(self, scenario: Scenario) -> None:
        self._state: FormationState | None = None
        self._robots: dict[str, RobotProgress] = {
            robot.id: RobotProgress("absent", "", -1.0, "") for robot in scenario.robots
        }

    @property
    def done(self) -> bool:
        """Whether the controller said that the task is done."""
        return self._state is not None and self._state.phase == "done"

    @property
    def begun(self) -> bool:
        """Whether the controller has said that the platoon does more than wait."""
        return self._state is not None and self._state.phase != "waiting"

    @property
    def state(self) -> FormationState | None:
        """The last formation state."""
        return self._state

    def add(self, message: Message) -> None:
        """Take a message into account."""
        match message:
            case FormationState():
                self._state = message
            case Status() if message.source in self._robots:
                self._robots[message.source] = RobotProgress(
                    message.mode, message.guard, message.command_age_s, message.reason
                )

    def progress(self) -> Progress:
        """How it is going."""
        state, robots = self._state, dict(self._robots)
        if state is None:
            return Progress("starting", 0.0, 0.0, 0.0, 0.0, robots)
        errors = unpack_floats(state.errors, 6)
        position = float(np.hypot(errors[:, 0], errors[:, 1]).max(initial=0.0))
        angle = float(np.abs(errors[:, [2, 5]]).max(initial=0.0))
        waits_for = state.waits_for if state.phase == "running" else ()
        return Progress(
            state.phase,
            state.task_time_s,
            state.task_duration_s,
            position,
            angle,
            robots,
            waits_for,
            state.reason,
        )


class LiveProgress:
    """Shows progress on a terminal as a live table, elsewhere as a line now and then."""

    def __init__(
        self, console: Console, name: str, refresh_s: float = 0.25, line_every_s: float = 10.0
    ) -> None:
        self._console = console
        self._name = name
        self._every_s = refresh_s if console.is_terminal else line_every_s
        self._live = (
            Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        )
        self._next = 0.0 if console.is_terminal else time.monotonic() + line_every_s

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def __call__(self, progress: Progress) -> None:
        """Show this, unless something was shown a moment ago."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + self._every_s
        if self._live:
            self._live.update(picture(self._name, progress), refresh=True)
        else:
            self._console.print(line(progress), highlight=False, markup=False, soft_wrap=True)

    def notice(self, text: str) -> None:
        """Show a line that stays."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)


def line(progress: Progress) -> str:
    """Progress in one line."""
    modes = " ".join(f"{name}:{robot.mode}" for name, robot in progress.robots.items())
    out = "".join(f", {name} is {how}" for name, how in progress.processes.items())
    at = f", router at {progress.connect}" if progress.connect else ""
    return (
        f"{phase(progress)} {progress.task_time_s:.1f}/{progress.task_duration_s:.1f} s, "
        f"error {progress.position_error_m:.3f} m {progress.angle_error_rad:.3f} rad, {modes}{out}{at}"
    )


def phase(progress: Progress) -> str:
    """What the platoon is at, and why it is no further."""
    if not progress.waits_for:
        return f"{progress.phase} ({progress.reason})" if progress.reason else progress.phase
    waits = f"waits for {', '.join(progress.waits_for)}"
    return progress.reason if progress.reason.startswith("waits for") else waits


MODE_COLOURS = {
    "tracking": "green",
    "waiting": "yellow",
    "holding": "yellow",
    "emergency": "red",
    "stopped": "red",
    "fault": "red",
}


def picture(name: str, progress: Progress) -> Group:
    """Progress as a table with a bar."""
    head = Table.grid(padding=(0, 2))
    head.add_row(
        Text(phase(progress)),
        ProgressBar(total=max(progress.task_duration_s, 1e-9), completed=progress.task_time_s, width=30),
        Text(f"{progress.task_time_s:.1f} / {progress.task_duration_s:.1f} s"),
        Text(f"error {progress.position_error_m:.3f} m  {progress.angle_error_rad:.3f} rad"),
    )
    robots = Table(box=None, padding=(0, 2), header_style="dim")
    for title in ("robot", "mode", "command age", "guard", "why"):
        robots.add_column(title, justify="right" if title == "command age" else "left")
    for robot, state in progress.robots.items():
        age = f"{1000 * state.command_age_s:.0f} ms" if state.command_age_s >= 0 else "-"
        mode = Text(state.mode, style=MODE_COLOURS.get(state.mode, "dim"))
        robots.add_row(robot, mode, age, state.guard, Text(state.reason))
    about = Text.assemble((name, "bold"), "  ", (progress.connect, "dim"))
    out = [Text(f"{name} is {how}", style="red") for name, how in progress.processes.items()]
    return Group(about, head, robots, *out)
