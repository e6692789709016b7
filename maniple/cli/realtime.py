"""A run as processes of their own over Zenoh on this machine, supervised."""

import contextlib
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from queue import Empty, SimpleQueue

from maniple.cli.crew import Crew
from maniple.cli.interrupt import on_interrupt
from maniple.cli.nodes import RUNDOWN_S, time_limit_s
from maniple.cli.outcome import Outcome, figures_of
from maniple.cli.processes import Process, stop_order, table
from maniple.cli.progress import Progress, ProgressWatch
from maniple.cli.recording_options import EVERYTHING, RecordingOptions
from maniple.cli.stop_trial import trying
from maniple.cli.upkeep import SIMULATOR
from maniple.core import codec, topics
from maniple.core.edges import preflight_asked
from maniple.core.errors import MessageError, RunError, TransportError
from maniple.core.faults import NEVER, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.core.time import from_seconds
from maniple.host.clock import Anchor
from maniple.host.liveness import Life, Liveness
from maniple.report.summary import Summary
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession

START_WITHIN_S = 60.0
"""Wall time for all processes to come up,"""
START_EACH_S = 2.0
"""and how much more for each robot."""
STOP_WITHIN_S: Mapping[str, float] = {
    "controller": 0.8,
    "agents": 0.8,
    "drivers": 5.2,
    "vehicles": 0.8,
    "simulator": 1.6,
    "recorder": 1.2,
    "router": 0.4,
}
"""How much more wall time each part of `stop_order` has until it is ended by force: a hurry, so that Ctrl-C
ends everything in 5 s, and in 11 s where drivers have to bring real robots to a stand; and the recorder has
its time even where all before it hang."""
PATIENCE = 5.0
"""How much longer at the end of a run that came to its end by itself."""
LAST_S = 0.4
"""What the simulator is left of its time when the robots have stood long enough."""
PORTS = 3
"""How many ports are tried where another program takes the one just found free."""
SETTLE_S, GRACE_S = 0.3, 3.0
"""A life is believed to be over after so long; when the router has been away, after the other; wall time."""
_POLL_S = 0.05


def run_realtime(
    scenario: Scenario,
    log: Path,
    speed: float,
    duration_s: float | None,
    on_progress: Callable[[Progress], None],
    on_notice: Callable[[str], None],
    keep_alive: bool = False,
    recording: RecordingOptions = EVERYTHING,
) -> Outcome:
    """Run to the end of the task, or of `duration_s`.

    Raises:
        RunError: a process could not be started, or one died that the platoon can't do without.
        RecordingError: the recording can't be written or read.
    """
    platoon = Platoon(scenario, log, speed, on_notice, keep_alive, recording)
    with on_interrupt(platoon.interrupt):
        failure = platoon.run(duration_s, on_progress)
    crew = platoon.crew
    logs = tuple(path for path in crew.logs if path.exists())
    if failure:
        there = ", ".join(map(str, logs))
        raise RunError(f"{failure}\nrecorded up to then: {there}" if there else failure)
    figures = Summary(scenario).figures() if platoon.interrupted and not logs else figures_of(logs, scenario)
    return Outcome(figures, platoon.interrupted, logs, crew.restarts)


def free_endpoint() -> str:
    """Where this run's router listens: the usual port for the first on a machine, a free one for others."""
    for port in (DEFAULT_PORT, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    raise RunError("no free TCP port on 127.0.0.1")


class Platoon:
    """All processes of one run, from start to end; see `Crew` for those that die. `on_notice` is told."""

    def __init__(
        self,
        scenario: Scenario,
        log: Path,
        speed: float,
        on_notice: Callable[[str], None] = lambda _: None,
        keep_alive: bool = False,
        recording: RecordingOptions = EVERYTHING,
    ) -> None:
        self._scenario = scenario
        self._log = log
        self._recording = recording.arguments()
        self._clock = Anchor.here(speed)
        self._on_notice = on_notice
        self.crew = Crew(scenario, log, self._clock, keep_alive, on_notice)
        self._plan = plan_of(scenario, NEVER)
        self._plan_mark = (-1, -1)
        self._lives: SimpleQueue[Life] = SimpleQueue()
        self._liveness = Liveness("", 0, from_seconds(SETTLE_S * speed), from_seconds(GRACE_S * speed))
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
                limit_s = time_limit_s(self._scenario, duration_s) / self._clock.speed
                until = time.monotonic() + limit_s
                looked_at = preflight_asked(self._scenario)
                if looked_at and self._scenario.preflight.estop:
                    prefix = self._scenario.network.prefix
                    stack.enter_context(trying(endpoint, prefix, self._on_notice))
                while not (self.interrupted or self._watch.done or time.monotonic() >= until):
                    self._listen()
                    if looked_at and duration_s is None and not self._watch.begun:
                        until = time.monotonic() + limit_s  # people may have to do something first
                    self.crew.bury(self._plan)
                    self.crew.revive(self._plan)
                    self.crew.look_for_frozen()
                    self.crew.pass_on()
                    on_progress(self._progress(endpoint))
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
        endpoint = self._start_router(until)
        if not self.interrupted:
            session = stack.enter_context(ZenohSession.client(endpoint, self._scenario.network.prefix))
            session.watch(lambda *life: self._lives.put(Life(*life)))
            for expression in (topics.FORMATION_STATE, topics.status("*"), topics.PLAN):
                session.subscribe(expression, lambda topic, data: self._inbox.put((topic, data)))
        for stage in self._table(endpoint):
            if self.interrupted:
                break
            for process in stage:
                if process.name not in self.crew:
                    self.crew.spawn(process)
            self._await({process.name for process in stage}, until)
        return endpoint

    def _start_router(self, until: float) -> str:
        """Start a router on a port that nobody takes in between; returns its endpoint."""
        for attempt in range(1, PORTS + 1):
            endpoint = free_endpoint()
            ((process,), *_) = self._table(endpoint)
            router = self.crew.spawn(process)
            while not (self.interrupted or router.spoke(_POLL_S)):
                if not router.alive and attempt < PORTS:
                    router.finish(until)
                    break
                self.crew.require_alive({process.name})
                _require_time(until, {process.name})
            else:
                break
        return endpoint

    def _table(self, endpoint: str) -> tuple[tuple[Process, ...], ...]:
        return table(self._scenario, endpoint, str(self._clock), str(self._log), self._recording)

    def _await(self, names: set[str], until: float) -> None:
        """Wait until all these nodes live."""
        missing = set(names)
        while missing and not self.interrupted:
            with contextlib.suppress(Empty):
                life = self._lives.get(timeout=_POLL_S)
                self._liveness.heard(*life, self._clock.now())
                if life.alive:
                    missing.discard(life.node)
            self.crew.require_alive(missing | {"router", "recorder"})
            _require_time(until, missing)

    def _listen(self) -> None:
        """Take in what arrived, waiting a moment for the first."""
        with contextlib.suppress(Empty):
            for topic, data in _drain(self._inbox):
                with contextlib.suppress(MessageError):
                    message = codec.decode(topic, data)
                    if isinstance(message, FaultPlan):
                        self._replan(message)
                    else:
                        self._watch.add(message)
        while not self._lives.empty():
            self._liveness.heard(*self._lives.get_nowait(), self._clock.now())
        for life in self._liveness.visible(_FAIR, self._clock.now()):
            self.crew.meet(life)

    def _replan(self, plan: FaultPlan) -> None:
        """The newest plan counts; the router may say one again."""
        if (mark := (plan.incarnation, plan.seq)) > self._plan_mark:
            self._plan, self._plan_mark = plan, mark

    def _progress(self, endpoint: str) -> Progress:
        return self._watch.progress()._replace(connect=endpoint, processes=self.crew.troubles())

    def _stop(self) -> None:
        """Stop all processes in order; by force what does not follow in its time."""
        until = time.monotonic()
        for part, names in stop_order(self._scenario).items():
            until += self._patience * STOP_WITHIN_S[part]
            if names == (SIMULATOR,) and SIMULATOR in self.crew:
                left = until - LAST_S - time.monotonic()
                speed = self._clock.speed
                time.sleep(max(min(RUNDOWN_S / speed, RUNDOWN_S, left), 0.0))
            self.crew.finish(names, until)
        self.crew.pass_on()


_FAIR = FaultPlan(since_ns=0)
"""Nothing is wrong between the supervisor and its processes."""


def _require_time(until: float, missing: Collection[str]) -> None:
    if missing and time.monotonic() > until:
        raise RunError(f"{', '.join(sorted(missing))} did not come up in time")


def _drain(inbox: SimpleQueue[tuple[str, bytes]]) -> Iterator[tuple[str, bytes]]:
    yield inbox.get(timeout=_POLL_S)
    for _ in range(inbox.qsize()):
        yield inbox.get_nowait()
