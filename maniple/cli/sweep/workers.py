"""Processes that make the runs of a sweep, one at a time each; one that dies costs its run, not the sweep."""

import os
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import NamedTuple

from maniple.cli import api
from maniple.cli.progress import Progress
from maniple.cli.sweep.rows import Row, figures
from maniple.core.scenario.parse import json_data, scenario_of

POLL_S = 0.2
"""How soon a request to stop is seen."""

PATIENCE_S = 10.0
"""How long a worker may take to end."""


class Task(NamedTuple):
    """A run to be made."""

    id: str
    scenario_json: bytes
    """Of the resolved scenario."""
    duration_s: float | None
    log: Path | None
    """Where its recording is to be; None to keep none."""


def rows(tasks: Sequence[Task], count: int, stopped: Callable[[], bool]) -> Iterator[Row]:
    """Make all runs in `count` processes. Rows come as runs end, until all have or `stopped` says true."""
    todo = deque(tasks)
    workers = [Worker() for _ in range(min(count, len(todo)))]
    try:
        while not stopped():
            for worker in workers:
                if worker.task is None and todo:
                    worker.give(todo.popleft())
            busy = {worker.connection: worker for worker in workers if worker.task is not None}
            if not busy:
                return
            for ready in wait(list(busy), POLL_S):
                worker = next(one for connection, one in busy.items() if connection is ready)
                row = worker.take()
                if row is None:
                    return
                yield row
                if worker.dead:
                    workers[workers.index(worker)] = Worker()
    finally:
        for worker in workers:
            worker.close()


class Worker:
    """A process that makes runs. It ends when this process does."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, os.getpid()), daemon=True)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until it ignores them
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.task: Task | None = None
        self.dead = False

    def give(self, task: Task) -> None:
        """Let it make a run."""
        self.task = task
        with suppress(OSError):  # it is dead: `take` finds out
            self.connection.send(task)

    def take(self) -> Row | None:
        """The row of its run, None if that was interrupted. Waits for it."""
        assert self.task is not None, "it was given something"
        row: Row | None
        try:
            row = self.connection.recv()
        except (EOFError, OSError):
            self.dead = True
            self._process.join(PATIENCE_S)
            row = Row(self.task.id, error=f"its process died ({_fate(self._process.exitcode)})")
        self.task = None
        return row

    def close(self) -> None:
        """End the process, and the run it is at."""
        self.connection.close()
        self._process.terminate()
        self._process.join(PATIENCE_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()


def serve(connection: Connection, parent: int) -> None:
    """What a worker does: runs that come over the connection, until that is closed or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(perform(connection.recv(), parent))


def perform(task: Task, parent: int | None = None) -> Row | None:
    """Make a run; returns its row, whatever it raised, or None if it was interrupted.

    Raises:
        SystemExit: the process `parent` is gone.
    """
    last: Progress | None = None

    def watch(progress: Progress) -> None:
        nonlocal last
        last = progress
        if parent is not None and os.getppid() != parent:
            raise SystemExit

    with tempfile.TemporaryDirectory(prefix="maniple-sweep-") as folder:
        log = Path(folder) / "run.mcap" if task.log is None else task.log.with_suffix(".part")
        try:
            log.unlink(missing_ok=True)
            scenario = scenario_of(json_data(task.scenario_json))
            result = api.run(scenario, virtual=True, duration_s=task.duration_s, log=log, on_progress=watch)
            if result.interrupted:
                log.unlink()
                return None
            if task.log is not None:
                log.rename(task.log)
            return Row(task.id, figures(result, last))
        except Exception as error:  # noqa: BLE001 - a run that fails is a result, not the end of the sweep
            return Row(task.id, error=f"{type(error).__name__}: {error}")


def _fate(status: int | None) -> str:
    if status is not None and status < 0:
        with suppress(ValueError):
            return signal.Signals(-status).name
    return f"status {status}"
