"""What people see of a run while it goes on."""

import math
from io import StringIO
from typing import Any

from rich.console import Console

from maniple.cli.loading import completed
from maniple.cli.progress import LiveProgress, Progress, ProgressWatch, RobotProgress, line, picture
from maniple.core.messages import Command, FormationState, Phase, Stamp, Status, pack_floats
from tests.cli.scenes import platoon


def state(phase: Phase = "running", errors: Any = ((0.3, -0.4, 0.1, 9, 9, -0.2),)) -> FormationState:
    return FormationState(
        phase=phase,
        task_time_s=12.34,
        task_duration_s=60.0,
        reference=(0.0, 0.0, 0.0),
        reference_velocity=(0.0, 0.0, 0.0),
        chain=("r1", "r2", "r3"),
        errors=pack_floats(errors) if len(errors) else b"",
        roster=(),
    )


def status(robot: str, **changes: Any) -> Status:
    values: dict[str, Any] = {
        "source": robot,
        "mode": "tracking",
        "guard": "speed",
        "command_age_s": 0.05,
        "command_age_max_s": 0.1,
        "driver": "active",
        "reason": "",
        "counters": {},
    }
    return Status(**values | changes)


def watch(*messages: Any) -> ProgressWatch:
    made = ProgressWatch(completed(platoon(3)))
    for message in messages:
        made.add(message)
    return made


def test_before_anything_is_heard() -> None:
    made = watch()
    assert not made.done
    progress = made.progress()
    assert progress.phase == "starting"
    assert list(progress.robots) == ["r1", "r2", "r3"]
    assert {robot.mode for robot in progress.robots.values()} == {"absent"}


def test_errors_are_the_largest_over_the_triangles() -> None:
    errors = ((0.3, -0.4, 0.1, 9, 9, -0.2), (0.0, 0.1, 0.0, 0, 0, 0.15))
    progress = watch(state(errors=errors)).progress()
    assert math.isclose(progress.position_error_m, 0.5, rel_tol=1e-6)
    assert math.isclose(progress.angle_error_rad, 0.2, rel_tol=1e-6)
    assert (progress.task_time_s, progress.task_duration_s) == (12.34, 60.0)


def test_a_controller_that_waits_has_no_errors_yet() -> None:
    progress = watch(state("waiting", errors=())).progress()
    assert (progress.phase, progress.position_error_m, progress.angle_error_rad) == ("waiting", 0.0, 0.0)


def test_the_controller_says_when_it_is_done() -> None:
    made = watch(state())
    assert not made.done
    made.add(state("done"))
    assert made.done


def test_robots_are_as_their_last_status_says_strangers_and_others_are_passed_over() -> None:
    command = Command(layer="drive", values=(0.0, 0.0), answers=Stamp(1, 0, 0), inputs_age_ns=0)
    made = watch(status("r2"), status("r9"), command)
    before = made.progress()
    made.add(status("r2", mode="holding", reason="old command"))
    assert before.robots["r2"] == RobotProgress("tracking", "speed", 0.05, "")
    assert made.progress().robots["r2"] == RobotProgress("holding", "speed", 0.05, "old command")
    assert set(before.robots) == {"r1", "r2", "r3"}


def progress_of(mode: str = "tracking", **changes: Any) -> Progress:
    robots = {
        "r1": RobotProgress(mode, "none", 0.0421, ""),
        "r2": RobotProgress("waiting", "", -1.0, "no [driver] yet"),
    }
    values: dict[str, Any] = {
        "phase": "running",
        "task_time_s": 12.34,
        "task_duration_s": 60.0,
        "position_error_m": 0.0567,
        "angle_error_rad": 0.0089,
        "robots": robots,
        "connect": "tcp/127.0.0.1:7447",
    }
    return Progress(**values | changes)


def test_one_line() -> None:
    assert line(progress_of()) == (
        "running 12.3/60.0 s, error 0.057 m 0.009 rad, r1:tracking r2:waiting, router at tcp/127.0.0.1:7447"
    )
    assert line(progress_of(connect="")).endswith("r2:waiting")


def test_the_table() -> None:
    console = Console(file=StringIO(), width=160)
    console.print(picture("scene", progress_of()))
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    for text in (
        "scene",
        "running",
        "12.3 / 60.0 s",
        "0.057 m",
        "r1",
        "tracking",
        "42 ms",
        "no [driver] yet",
    ):
        assert text in shown
    row = next(text for text in shown.splitlines() if "r2" in text)
    assert row.split()[:3] == ["r2", "waiting", "-"]


def test_a_task_without_a_duration_can_be_drawn() -> None:
    file = StringIO()
    Console(file=file, width=160).print(
        picture("scene", progress_of(task_duration_s=0.0, task_time_s=0.0, robots={}))
    )
    assert "0.0 / 0.0 s" in file.getvalue()


def test_off_a_terminal_a_line_now_and_then() -> None:
    """The first only after a while, whole, and markup in reasons is not obeyed."""
    file = StringIO()
    with LiveProgress(Console(file=file, width=20), "scene", line_every_s=1000.0) as show:
        show(progress_of())
        assert file.getvalue() == ""
        show._next = 0.0
        show(progress_of("[bold]"))
        show(progress_of())
    assert file.getvalue() == line(progress_of("[bold]")) + "\n"


def test_on_a_terminal_a_table_that_goes_away() -> None:
    file = StringIO()
    console = Console(file=file, force_terminal=True, width=160, height=40)
    with LiveProgress(console, "scene", refresh_s=1000.0) as show:
        show(progress_of())
        first = file.getvalue()
        show(progress_of("fault"))
    assert "tracking" in first
    assert "fault" not in file.getvalue()
    assert file.getvalue().endswith("\x1b[2K")


def test_the_terminal_is_given_back_after_an_error() -> None:
    file = StringIO()
    console = Console(file=file, force_terminal=True, width=160)
    try:
        with LiveProgress(console, "scene") as show:
            show(progress_of())
            raise ValueError
    except ValueError:
        pass
    assert "\x1b[?25h" in file.getvalue()


def test_why_the_platoon_waits_is_in_the_controllers_words() -> None:
    waiting = progress_of(waits_for=("r2",), reason="waits for r2: the command is 4.1 s old; limit 0.49 s")
    assert line(waiting).startswith("waits for r2: the command is 4.1 s old; limit 0.49 s 12.3/60.0 s")
    assert line(progress_of(waits_for=("r2",))).startswith("waits for r2 12.3")
    assert line(progress_of(phase="holding", reason="too few robots")).startswith("holding (too few robots)")


def test_what_is_dead_or_frozen_is_told() -> None:
    progress = progress_of(processes={"controller": "dead", "r2": "frozen"})
    assert "r2:waiting, controller is dead, r2 is frozen, router at" in line(progress)
    file = StringIO()
    Console(file=file, width=160).print(picture("scene", progress))
    assert "controller is dead" in file.getvalue()
