"""A sweep from its file to its results."""

import os
import shlex
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from maniple.cli.interrupt import on_interrupt
from maniple.cli.sweep.folder import TABLE, Folder, table, write_table
from maniple.cli.sweep.plan import Job, Plan, plan_of
from maniple.cli.sweep.workers import Task, rows
from maniple.core.errors import ManipleError, MissingExtraError
from maniple.core.version import __version__

LINE_EVERY_S = 10.0
"""Between lines of progress where there is no terminal."""


class Outcome(msgspec.Struct, frozen=True):
    """What became of a sweep; what `maniple sweep --json` prints. Runs that are equal are made once."""

    sweep: str
    runs: int
    """In the grid."""
    made: int
    """Now."""
    kept: int
    """From before."""
    failed: int
    """That raised something."""
    completed: int
    """Whose task came to its end."""
    collisions: int
    """Runs with one."""
    wall_s: float
    folder: str
    table: str | None
    """Path of the Parquet file; None if there are runs left to make."""
    pictures: list[str]
    first_failure: str = ""
    """Of the runs that failed: what was raised, and the command that does it again."""
    interrupted: bool = False


def sweep(
    file: Path,
    jobs: int | None = None,
    out: Path | None = None,
    fresh: bool = False,
    keep_logs: bool = False,
    console: Console | None = None,
) -> Outcome:
    """Make every run of a sweep file that is not in its folder yet, and once all are there the table and the
    pictures. Progress goes to `console`.

    Raises:
        ScenarioError: the file or a combination is not valid; nothing has run then.
        ArgumentError: the folder is not one of this sweep.
        MissingExtraError: pyarrow or matplotlib is not installed.
        ManipleError: the folder can't be written.
    """
    _require_extra()
    begin = time.perf_counter()
    plan = plan_of(file)
    console = console or Console(stderr=True, quiet=True)
    asked_to_stop: list[bool] = []
    with Folder(out or Path("logs") / f"sweep-{plan.sweep.name}", plan.sweep.name, fresh) as folder:
        tasks = tasks_of(plan, folder, keep_logs)
        kept = len({job.id for job in plan.jobs}) - len(tasks)
        if kept and folder.other_code:
            console.print("note: some runs were made by other sources of maniple; --fresh makes all again")
        count = jobs or len(os.sched_getaffinity(0))
        made = 0
        with (
            on_interrupt(lambda: asked_to_stop.append(True)),
            _Display(console, plan.sweep.name, kept, kept + len(tasks)) as display,
        ):
            for row in rows(tasks, count, lambda: bool(asked_to_stop)):
                folder.add(row)
                made += 1
                display.advance()
        whole = made == len(tasks)
        pictures = _write(plan, folder, file) if whole else []
        return _outcome(plan, folder, Tally(made, kept, not whole), pictures, time.perf_counter() - begin)


def tasks_of(plan: Plan, folder: Folder, keep_logs: bool) -> list[Task]:
    """The runs that are left to make, those that failed among them; equal ones once."""
    found: dict[str, Task] = {}
    for job in plan.jobs:
        row, log = folder.rows.get(job.id), folder.log(job) if keep_logs else None
        if row is None or row.error is not None or (log is not None and not log.exists()):
            found[job.id] = Task(job.id, job.scenario_json, plan.sweep.duration_s, log)
    return list(found.values())


class Tally(NamedTuple):
    """What this call has done."""

    made: int
    kept: int
    interrupted: bool


class _Display:
    """A bar with an estimate of the time left on a terminal, elsewhere a line now and then."""

    def __init__(self, console: Console, name: str, done: int, of: int) -> None:
        self._console = console
        self._done, self._of, self._first = done, of, done
        self._begin = time.monotonic()
        self._next = self._begin + LINE_EVERY_S
        columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=console, transient=True) if console.is_terminal else None
        self._task = self._bar.add_task(name, total=of, completed=done) if self._bar else None

    def __enter__(self) -> Self:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()

    def advance(self) -> None:
        """One more run is made."""
        self._done += 1
        now = time.monotonic()
        if self._bar and self._task is not None:
            self._bar.advance(self._task)
        elif now >= self._next:
            self._next = now + LINE_EVERY_S
            left_s = (now - self._begin) * (self._of - self._done) / (self._done - self._first)
            self._console.print(
                f"{self._done} of {self._of} runs, about {left_s:.0f} s left", highlight=False
            )


def _require_extra() -> None:
    """Refuse to begin what could not be finished.

    Raises:
        MissingExtraError: pyarrow or matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError:
        raise MissingExtraError("sweep", "sweep") from None


def _write(plan: Plan, folder: Folder, file: Path) -> list[Path]:
    from maniple.report import sweep_plot

    results = table(plan, folder.rows)
    columns = {name: values for name, (_, values) in results.items()}
    paths = []
    try:
        notes = {"maniple": __version__, "sweep": file.read_text(encoding="utf-8")}
        write_table(folder.path / TABLE, results, notes)
        for plot in plan.sweep.plots:
            paths.append(path := folder.path / f"{plot.name}.png")
            sweep_plot.write(plot, columns, path)
    except OSError as error:
        raise ManipleError(f"{folder.path}: can't write the results: {error.strerror or error}") from None
    return paths


def _outcome(plan: Plan, folder: Folder, tally: Tally, pictures: list[Path], wall_s: float) -> Outcome:
    rows = [(job, folder.rows[job.id]) for job in plan.jobs if job.id in folder.rows]
    failed = [(job, row.error) for job, row in rows if row.error is not None]
    return Outcome(
        sweep=plan.sweep.name,
        runs=len(plan.jobs),
        made=tally.made,
        kept=tally.kept,
        failed=len(failed),
        completed=sum(bool(row.figures.get("completed")) for _, row in rows),
        collisions=sum(bool(row.figures.get("collisions")) for _, row in rows),
        wall_s=round(wall_s, 3),
        folder=str(folder.path),
        table=None if tally.interrupted else str(folder.path / TABLE),
        pictures=[str(path) for path in pictures],
        first_failure=f"{failed[0][1]}\n{command(plan, failed[0][0])}" if failed else "",
        interrupted=tally.interrupted,
    )


def command(plan: Plan, job: Job) -> str:
    """The command that makes one run of a sweep."""
    parts = ["maniple", "run", str(plan.scenario), "--virtual", "--seed", str(job.seed)]
    if plan.sweep.duration_s is not None:
        parts += ["--duration", f"{plan.sweep.duration_s:g}"]
    for override in job.overrides:
        parts += ["--set", override]
    return shlex.join(parts)


def tell(outcome: Outcome, console: Console) -> None:
    """Show what became of a sweep."""

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    made = f"{outcome.made} made in {outcome.wall_s:.0f} s, {outcome.kept} there before"
    say(f"{outcome.sweep}: {outcome.runs} runs, {made}")
    say(f"{outcome.completed} completed, {outcome.collisions} with collisions, {outcome.failed} failed")
    if outcome.first_failure:
        say(f"the first that failed: {outcome.first_failure}", "red")
    if outcome.interrupted:
        say("interrupted; the same command goes on from here", "yellow")
    for path in filter(None, (outcome.table, *outcome.pictures)):
        say(path)
