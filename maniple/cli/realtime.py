"""A run as processes of their own over Zenoh on this machine, supervised."""

import contextlib
import socket
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

from maniple.cli.interrupt import on_interrupt
from maniple.cli.nodes import RUNDOWN_S, time_limit_s
from maniple.cli.processes import LIFE, Child, Process, finish_all, stop_order, table
from maniple.cli.progress import Progress, ProgressWatch
from maniple.core import codec
from maniple.core.errors import MessageError, RunError, TransportError
from maniple.core.faults import dies_with
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.host.clock import Anchor
from maniple.recording.reader import read
from maniple.report.summary import RunFigures, Summary
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession

START_WITHIN_S = 60.0
"""Wall time for all processes to come up,"""
START_EACH_S = 2.0
"""and how much more for each robot."""
STOP_WITHIN_S = (0.8, 1.6, 3.2, 4.4, 4.8)
"""Wall time from the begin of stopping until what `stop_order` lists is ended by force, one by one: a hurry,
so that Ctrl-C ends everything in 5 s, and the recorder has its time even where all before it hang."""
PATIENCE = 5.0
"""How much longer at the end of a run that came to its end by itself."""
LAST_S = 0.4
"""What the simulator is left of its time when the robots have stood long enough."""
PORTS = 3
"""How many ports are tried where another program takes the one just found free."""
LEAST = 3
"""Robots that make a formation."""
_POLL_S = 0.05


def run_realtime(
    scenario: Scenario,
    log: Path,
    speed: float,
    duration_s: float | None,
    on_progress: Callable[[Progress], None],
    on_notice: Callable[[str], None],
) -> tuple[RunFigures, bool]:
    """Run to the end of the task, or of `duration_s`; returns the figures, and whether it was interrupted.

    Raises:
        RunError: a process could not be started, or one died that the platoon can't do without.
        RecordingError: the recording can't be written or read.
    """
    platoon = Platoon(scenario, log, speed, on_notice)
    with on_interrupt(platoon.interrupt):
        failure = platoon.run(duration_s, on_progress)
    if failure:
        raise RunError(f"{failure}\nrecorded up to then: {log}" if log.exists() else failure)
    if platoon.interrupted and not log.exists():
        return Summary(scenario).figures(), True
    return figures_of(log, scenario), platoon.interrupted


def figures_of(log: Path, scenario: Scenario) -> RunFigures:
    """The figures of a run from its recording.

    Raises:
        RecordingError: it can't be read.
    """
    summary = Summary(scenario)
    for entry in read(log).messages(summary.wants):
        if entry.message is not None:
            summary.add(entry.message)
    return summary.figures()


def free_endpoint() -> str:
    """Where this run's router listens: the usual port for the first on a machine, a free one for others."""
    for port in (DEFAULT_PORT, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    raise RunError("no free TCP port on 127.0.0.1")


class Platoon:
    """All processes of one run, from start to end.

    Robots may be lost as long as enough are left for a formation, and come back as processes of somebody
    else. `on_notice` is told.
    """

    def __init__(
        self, scenario: Scenario, log: Path, speed: float, on_notice: Callable[[str], None] = lambda _: None
    ) -> None:
        self._scenario = scenario
        self._robots = frozenset(robot.id for robot in scenario.robots)
        self._notice = on_notice
        self._log = log
        self._speed = speed
        self._json = to_json(scenario)
        self._processes: dict[str, Process] = {}
        self._children: dict[str, Child] = {}
        self._expected: dict[str, int] = {}
        self._buried: set[str] = set()
        self._guests: dict[str, int] = {}
        self._crashes = sorted(scenario.crashes, key=lambda crash: crash.at_s)
        self._restarts: list[tuple[float, str]] = []
        self._lives: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
        self._inbox: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
        self._watch = ProgressWatch(scenario)
        self._patience = 1.0
        self.interrupted = False

    def interrupt(self) -> None:
        """Make `run` stop everything; safe from a signal handler."""
        self.interrupted = True

    def run(self, duration_s: float | None, on_progress: Callable[[Progress], None]) -> str | None:
        """Start, wait for the end, stop in order. Returns what went wrong, or None."""
        try:
            with contextlib.ExitStack() as stack:
                stack.callback(self._stop)
                endpoint = self._start(stack)
                limit_s = time_limit_s(self._scenario, duration_s) / self._speed
                begin = time.monotonic()
                until = begin + limit_s
                while not (self.interrupted or self._watch.done or time.monotonic() >= until):
                    self._listen()
                    self._play_fate((time.monotonic() - begin) * self._speed)
                    on_progress(self._watch.progress()._replace(connect=endpoint))
                    self._bury()
                if not self.interrupted:
                    self._patience = PATIENCE
        except (RunError, TransportError) as error:
            return str(error)
        return None

    def _start(self, stack: contextlib.ExitStack) -> str:
        """Start all stages; returns where the router listens.

        Raises:
            RunError: a process died or did not come up.
            TransportError: the router can't be reached.
        """
        until = time.monotonic() + START_WITHIN_S + START_EACH_S * len(self._scenario.robots)
        anchor = str(Anchor.here(self._speed))
        endpoint = self._start_router(anchor, until)
        if not self.interrupted:
            session = stack.enter_context(ZenohSession.client(endpoint, self._scenario.network.prefix))
            session.watch(lambda node, life, alive: self._lives.put((node, life, alive)))
            for expression in ("formation/state", "robot/*/status"):
                session.subscribe(expression, lambda topic, data: self._inbox.put((topic, data)))
        for stage in table(self._scenario, endpoint, anchor, str(self._log)):
            if self.interrupted:
                break
            for process in stage:
                if process.name not in self._children:
                    self._spawn(process, LIFE)
            self._await({process.name for process in stage}, until)
        return endpoint

    def _start_router(self, anchor: str, until: float) -> str:
        """Start a router on a port that nobody takes in between; returns its endpoint."""
        for attempt in range(1, PORTS + 1):
            endpoint = free_endpoint()
            ((process,), *_) = table(self._scenario, endpoint, anchor, str(self._log))
            router = self._spawn(process, LIFE)
            while not (self.interrupted or router.spoke(_POLL_S)):
                if not router.alive and attempt < PORTS:
                    router.finish(until)
                    break
                self._require_alive()
                _require_time(until, [process.name])
            else:
                break
        return endpoint

    def _await(self, names: set[str], until: float) -> None:
        """Wait until all these nodes live."""
        missing = set(names)
        while missing and not self.interrupted:
            with contextlib.suppress(Empty):
                missing.discard(self._next_life(_POLL_S))
            self._require_alive()
            _require_time(until, missing)

    def _spawn(self, process: Process, life: int) -> Child:
        """Start a process."""
        self._processes[process.name] = process
        self._expected[process.name] = life
        self._buried.discard(process.name)
        child = self._children[process.name] = Child(process, self._json)
        return child

    def _next_life(self, timeout_s: float) -> str:
        """The next node that comes to life, or whose life has ended.

        Raises:
            Empty: none does within the time.
            RunError: a node that takes the place of a living one of this run, or too few robots are left.
        """
        node, life, alive = self._lives.get(timeout=timeout_s)
        if node not in self._children or life == self._expected[node]:
            return node
        if not alive:
            if self._guests.get(node) == life:
                del self._guests[node]
                self._go_on(f"{node} is gone again (incarnation {life})")
        elif node in self._robots and not self._children[node].alive:
            self._guests[node] = life
            self._notice(f"{node} is back (incarnation {life})")
        else:
            raise RunError(
                f"another {node} (incarnation {life}) joined the network of this run: "
                "nodes of the same name would take turns"
            )
        return node

    def _listen(self) -> None:
        """Take in what arrived, waiting a moment for the first."""
        with contextlib.suppress(Empty):
            for topic, data in _drain(self._inbox):
                with contextlib.suppress(MessageError):
                    self._watch.add(codec.decode(topic, data))
        self._listen_to_lives()

    def _listen_to_lives(self) -> None:
        while not self._lives.empty():
            self._next_life(_POLL_S)

    def _require_alive(self) -> None:
        dead = [child.epitaph() for child in self._children.values() if not child.alive]
        if dead:
            raise RunError("\n".join(dead))

    def _bury(self) -> None:
        """Go on without robots that have died, while enough are left.

        Raises:
            RunError: too few are left, or another process has died.
        """
        dead = {name for name, child in self._children.items() if not child.alive}
        for name in sorted(dead - self._buried):
            self._buried.add(name)
            epitaph = self._children[name].epitaph()
            if name in self._robots:
                self._go_on(epitaph)
            elif any(name == node for _, node in self._restarts):
                self._notice(f"{epitaph}; it will be back")
            else:
                raise RunError(epitaph)

    def _go_on(self, without: str) -> None:
        """Say who is gone and how many are left; robots that the scenario brings back are waited for.

        Raises:
            RunError: too few are left.
        """
        here = {name for name in self._robots if self._children[name].alive} | self._guests.keys()
        back = {name for _, name in self._restarts if name in self._robots} - here
        if len(here) + len(back) < LEAST:
            raise RunError(without)
        later = f", {len(back)} will be back" if back else ""
        self._notice(f"{without}; {len(here)} robots go on{later}")

    def _play_fate(self, now_s: float) -> None:
        """Kill and restart what the scenario says, `now_s` of scenario time after the start."""
        while self._crashes and self._crashes[0].at_s <= now_s:
            crash = self._crashes.pop(0)
            for name in dies_with(crash.node, self._scenario):
                self._children[name].kill()
                if crash.restart_after_s is not None:
                    self._restarts.append((crash.at_s + crash.restart_after_s, name))
        for due in [entry for entry in self._restarts if entry[0] <= now_s]:
            self._restarts.remove(due)
            if due[1] in self._guests:
                continue  # somebody was faster
            self._children[due[1]].finish(0.0)
            life = self._expected[due[1]] + 1
            self._spawn(self._processes[due[1]].again(life), life)
            self._notice(f"{due[1]} is started again (incarnation {life})")

    def _stop(self) -> None:
        """Stop all processes in order; by force what does not follow in its time."""
        begin = time.monotonic()
        order = zip(stop_order(self._scenario), STOP_WITHIN_S, strict=True)
        for names, within_s in order:
            until = begin + self._patience * within_s
            if names == ("simulator",) and "simulator" in self._children:
                left = until - LAST_S - time.monotonic()
                time.sleep(max(min(RUNDOWN_S / self._speed, RUNDOWN_S, left), 0.0))
            finish_all([self._children[name] for name in names if name in self._children], until)


def _require_time(until: float, missing: Collection[str]) -> None:
    if missing and time.monotonic() > until:
        raise RunError(f"{', '.join(sorted(missing))} did not come up in time")


def _drain(inbox: SimpleQueue[tuple[str, bytes]]) -> Iterator[tuple[str, bytes]]:
    yield inbox.get(timeout=_POLL_S)
    for _ in range(inbox.qsize()):
        yield inbox.get_nowait()
