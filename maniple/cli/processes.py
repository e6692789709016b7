"""The table of processes of a run, and one process of it as a child."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from maniple.core import edges
from maniple.core.errors import RunError
from maniple.core.scenario.types import Robot, Scenario

LIFE = 1
"""The first incarnation of every node of a run."""

LAST_WORDS = 20
"""Lines of a child's standard error that are kept."""


class Process(NamedTuple):
    """One row of the table."""

    name: str
    arguments: tuple[str, ...]
    """Of `maniple`."""

    def having(self, option: str, value: str) -> "Process":
        """The same with another value of an option; without that option, itself."""
        if option not in self.arguments:
            return self
        place = self.arguments.index(option) + 1
        return self._replace(arguments=(*self.arguments[:place], value, *self.arguments[place + 1 :]))

    def also(self, flag: str) -> "Process":
        """The same with a flag that it may have already."""
        return self if flag in self.arguments else self._replace(arguments=(*self.arguments, flag))


def table(
    scenario: Scenario, connect: str, anchor: str, log: str, recording: Sequence[str] = ()
) -> tuple[tuple[Process, ...], ...]:
    """The processes of a run, in stages: each stage starts when the one before is there. `recording` are more
    arguments of the recorder.

    They are stopped in the order `stop_order` gives.
    """
    common = ("--scenario", "-", "--connect", connect, "--anchor", anchor)
    life = ("--incarnation", str(LIFE))

    def each(name: Callable[[str], str], has: Callable[[Robot], bool], *words: str) -> Iterator[Process]:
        """Such a process of every robot that has one."""
        for robot in filter(has, scenario.robots):
            command, *flags = words
            yield Process(name(robot.id), (*command.split(), robot.id, *flags, *common, *life))

    world = [Process("simulator", ("simulator", *common, *life))] if edges.simulated(scenario) else []
    vehicles = each(edges.vehicle_of, edges.has_vehicle, "vehicle")
    drivers = each(edges.driver_of, edges.has_driver, "driver run")
    scanners = each(edges.scanner_of, edges.has_scanner, "driver run", "--scans")
    agents = each(str, lambda _: True, "agent")
    nodes = (*agents, Process("controller", ("controller", *common, *life)))
    begin = (
        (Process("router", ("router", "--scenario", "-", "--listen", connect, "--anchor", anchor)),),
        (Process("recorder", ("recorder", *common, "--log", log, *recording)),),
    )
    if not edges.is_wired(scenario):
        return (*begin, (*world, *nodes))
    stages = ((*world, *vehicles), (*drivers, *scanners), nodes)
    return (*begin, *(stage for stage in stages if stage))


def stop_order(scenario: Scenario) -> Mapping[str, tuple[str, ...]]:
    """Who is stopped together, first to last: commands end, robots stand, drivers let go of them, and the
    recorder sees it."""
    robots = scenario.robots
    drivers = [edges.driver_of(robot.id) for robot in robots if edges.has_driver(robot)]
    scanners = [edges.scanner_of(robot.id) for robot in robots if edges.has_scanner(robot)]
    order = {
        "controller": ("controller",),
        "agents": tuple(robot.id for robot in robots),
        "drivers": (*drivers, *scanners),
        "vehicles": tuple(edges.vehicle_of(robot.id) for robot in robots if edges.has_vehicle(robot)),
        "simulator": ("simulator",) if edges.simulated(scenario) else (),
        "recorder": ("recorder",),
        "router": ("router",),
    }
    return {part: names for part, names in order.items() if names}


MANIPLE = (sys.executable, "-m", "maniple")
"""The program, as this process runs it."""


class Child:
    """A running process of the table. It ends when this process does: its standard input closes.

    Raises:
        RunError: it can't be started.
    """

    def __init__(self, process: Process, scenario_json: bytes, program: Sequence[str] = MANIPLE) -> None:
        self.name = process.name
        self._last_words: deque[str] = deque(maxlen=LAST_WORDS)
        self._news: deque[str] = deque(maxlen=LAST_WORDS)
        self._spoke = threading.Event()
        try:
            self._popen = subprocess.Popen(  # noqa: S603 - our own interpreter and arguments
                [*program, *process.arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # a terminal's Ctrl-C goes to the supervisor alone
            )
        except OSError as error:
            raise RunError(f"{self.name} could not be started: {error.strerror}") from None
        self._threads = [
            threading.Thread(target=work, args=arguments, daemon=True)
            for work, *arguments in ((self._feed, scenario_json), (self._hear,), (self._listen,))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._popen.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._popen.poll() is None

    @property
    def frozen(self) -> bool:
        """Whether it is stopped, as by SIGSTOP; never where there is no /proc."""
        try:
            stat = Path(f"/proc/{self.pid}/stat").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            return False
        return stat.rpartition(b")")[2].split()[0] == b"T"

    def spoke(self, timeout_s: float) -> bool:
        """Whether it has said something on its standard output; waits for that."""
        return self._spoke.wait(timeout_s)

    def news(self) -> Iterator[str]:
        """What it has said on its standard error since this was asked for last, while it lives or where it
        ended well; else those are its last words."""
        while self._news and self._popen.poll() in (None, 0):
            yield self._news.popleft()

    def interrupt(self) -> None:
        """Ask it to finish."""
        if self.alive:
            self._popen.send_signal(signal.SIGINT)
            self._popen.send_signal(signal.SIGCONT)  # one that is frozen would not hear it

    def finish(self, until: float) -> None:
        """Wait for its end, and end it by force at `until` (monotonic seconds)."""
        try:
            self._popen.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        for thread in self._threads:
            thread.join(1.0)
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._popen.stdin.close()

    def epitaph(self, consequence: str = "") -> str:
        """How it ended and what comes of it, with its last words."""
        code = self._popen.poll()
        if code is None:
            how = "still runs"
        elif code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        else:
            how = f"ended with status {code}"
        self._threads[-1].join(0.2)
        words = "\n  ".join(self._last_words)
        ended = f"{self.name} (process {self.pid}) {how}{consequence}"
        return f"{ended}; its last words:\n  {words}" if words else ended

    def _feed(self, scenario_json: bytes) -> None:
        """Write the scenario, which may be more than a pipe holds, and keep the pipe open."""
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._popen.stdin.write(scenario_json + b"\n")
            self._popen.stdin.flush()

    def _hear(self) -> None:
        assert self._popen.stdout is not None
        with self._popen.stdout as stream:
            for _ in stream:
                self._spoke.set()

    def _listen(self) -> None:
        assert self._popen.stderr is not None
        with self._popen.stderr as stream:
            for line in stream:
                words = line.decode(errors="replace").rstrip()
                self._last_words.append(words)
                self._news.append(words)


def finish_all(children: Sequence[Child], until: float) -> None:
    """Ask several children to finish, and wait for all."""
    for child in children:
        child.interrupt()
    for child in children:
        child.finish(until)


def environment() -> None:
    """Settings every process of the platoon has: linear algebra with one thread. Before NumPy is imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
