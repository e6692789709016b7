"""A run as processes of their own over Zenoh on this machine, supervised."""

import contextlib
import socket
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

from maniple.cli.interrupt import on_interrupt
from maniple.cli.nodes import RUNDOWN_S, time_limit_s
from maniple.cli.outcome import Outcome, figures_of, part
from maniple.cli.processes import LIFE, Child, Process, finish_all, stop_order, table
from maniple.cli.progress import Progress, ProgressWatch
from maniple.cli.upkeep import SIMULATOR, Death, Moment, Upkeep
from maniple.core import codec, topics
from maniple.core.errors import MessageError, RunError, TransportError
from maniple.core.faults import NEVER, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.scenario.parse import to_json
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
LOOK_S = 0.25
"""How often frozen processes are looked for, wall time."""
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
) -> Outcome:
    """Run to the end of the task, or of `duration_s`.

    Raises:
        RunError: a process could not be started, or one died that the platoon can't do without.
        RecordingError: the recording can't be written or read.
    """
    platoon = Platoon(scenario, log, speed, on_notice, keep_alive)
    with on_interrupt(platoon.interrupt):
        failure = platoon.run(duration_s, on_progress)
    logs = tuple(path for path in platoon.logs if path.exists())
    if failure:
        there = ", ".join(map(str, logs))
        raise RunError(f"{failure}\nrecorded up to then: {there}" if there else failure)
    figures = Summary(scenario).figures() if platoon.interrupted and not logs else figures_of(logs, scenario)
    return Outcome(figures, platoon.interrupted, logs, platoon.restarts)


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

    What the fault plan kills comes back as it says; with `keep_alive` everything but the simulator that dies
    is started again. Without, robots may be lost as long as enough are left for a formation. They may come
    back as processes of somebody else. `on_notice` is told.
    """

    def __init__(
        self,
        scenario: Scenario,
        log: Path,
        speed: float,
        on_notice: Callable[[str], None] = lambda _: None,
        keep_alive: bool = False,
    ) -> None:
        self._scenario = scenario
        self._robots = frozenset(robot.id for robot in scenario.robots)
        self._notice = on_notice
        self._clock = Anchor.here(speed)
        self._json = to_json(scenario)
        self._processes: dict[str, Process] = {}
        self._children: dict[str, Child] = {}
        self._upkeep = Upkeep(scenario, keep_alive)
        self._plan = plan_of(scenario, NEVER)
        self._plan_mark = (-1, -1)
        self._guests: dict[str, int] = {}
        self._frozen: frozenset[str] = frozenset()
        self._look_at = 0.0
        self._lives: SimpleQueue[Life] = SimpleQueue()
        self._liveness = Liveness("", 0, from_seconds(SETTLE_S * speed), from_seconds(GRACE_S * speed))
        self._inbox: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
        self._watch = ProgressWatch(scenario)
        self._patience = 1.0
        self.logs = [log]
        self.restarts: dict[str, int] = {}
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
                while not (self.interrupted or self._watch.done or time.monotonic() >= until):
                    self._listen()
                    self._bury()
                    self._revive()
                    self._look_for_frozen()
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
        for stage in table(self._scenario, endpoint, str(self._clock), str(self.logs[0])):
            if self.interrupted:
                break
            for process in stage:
                if process.name not in self._children:
                    self._spawn(process, LIFE)
            self._await({process.name for process in stage}, until)
        return endpoint

    def _start_router(self, until: float) -> str:
        """Start a router on a port that nobody takes in between; returns its endpoint."""
        for attempt in range(1, PORTS + 1):
            endpoint = free_endpoint()
            ((process,), *_) = table(self._scenario, endpoint, str(self._clock), str(self.logs[0]))
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
                life = self._lives.get(timeout=_POLL_S)
                self._liveness.heard(*life, self._clock.now())
                if life.alive:
                    missing.discard(life.node)
            self._require_alive()
            _require_time(until, missing)

    def _spawn(self, process: Process, life: int) -> Child:
        """Start a process."""
        self._processes[process.name] = process
        self._upkeep.started(process.name, life, self._now())
        child = self._children[process.name] = Child(process, self._json)
        return child

    def _now(self) -> Moment:
        return Moment(time.monotonic(), self._clock.now())

    def _require_alive(self) -> None:
        dead = [child.epitaph() for child in self._children.values() if not child.alive]
        if dead:
            raise RunError("\n".join(dead))

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
            self._meet(life)

    def _replan(self, plan: FaultPlan) -> None:
        """The newest plan counts; the router may say one again."""
        if (mark := (plan.incarnation, plan.seq)) > self._plan_mark:
            self._plan, self._plan_mark = plan, mark

    def _meet(self, life: Life) -> None:
        """Welcome a node that somebody else started in the place of one of ours, and miss it when it goes."""
        node = life.node
        if node not in self._robots | {"controller"} or life.incarnation == self._upkeep.life(node):
            return
        self._upkeep.met(node, life.incarnation)
        if life.alive:
            self._guests[node] = life.incarnation
            back = self._upkeep.is_dead(node)
            self._notice(f"{node} is {'back' if back else 'there twice'} (incarnation {life.incarnation})")
        elif self._guests.get(node) == life.incarnation:
            del self._guests[node]
            self._go_on(f"{node} is gone again (incarnation {life.incarnation})")

    def _bury(self) -> None:
        """Find who has died, and what that means.

        Raises:
            RunError: the platoon can't do without.
        """
        for name, child in sorted(self._children.items()):
            if not (child.alive or self._upkeep.is_dead(name)):
                death = self._upkeep.died(name, self._plan, self._now())
                planned = ", as the fault plan says" if death.crash else ""
                self._go_on(child.epitaph(planned + self._consequence(name, death)))

    def _consequence(self, name: str, death: Death) -> str:
        """What the death of a process means for the platoon, in words."""
        lasts_s = death.crash.restart_after_s if death.crash else None
        if name == SIMULATOR:
            return "; a run can't go on without it"
        if name not in self._robots:
            back = f"back after {lasts_s:g} s" if lasts_s else "it will be back"
            return f"; {back}" if death.back else ""
        absent = self._upkeep.absent(self._guests)
        here = len(self._robots - absent.keys())
        later = sum(absent[one].back for one in self._robots & absent.keys())
        return f"; {here} robots go on" + (f", {later} will be back" if later else "")

    def _go_on(self, what: str) -> None:
        """Say what happened, if the platoon goes on.

        Raises:
            RunError: it can't do without who is lost.
        """
        lost = self._upkeep.lost(self._guests)
        if lost - self._robots or len(self._robots - lost) < LEAST:
            raise RunError(what)
        self._notice(what)

    def _revive(self) -> None:
        """Start again who is due."""
        for name in self._upkeep.due(self._plan, self._now(), self._guests):
            self._children[name].finish(0.0)
            life, process = self._upkeep.next_life(name), self._processes[name]
            about = f" (incarnation {life})" if "--incarnation" in process.arguments else ""
            if name == "recorder":
                process = process.having("--log", str(self._next_log()))
                about = f": {self.logs[-1]}"
            self._spawn(process.having("--incarnation", str(life)), life)
            self.restarts[name] = self.restarts.get(name, 0) + 1
            self._notice(f"{name} is started again{about}")

    def _next_log(self) -> Path:
        """A new file for the next part of the recording."""
        number = len(self.logs) + 1
        while (path := part(self.logs[0], number)).exists():
            number += 1
        self.logs.append(path)
        return path

    def _look_for_frozen(self) -> None:
        """Say who is frozen and who goes on."""
        if (now := time.monotonic()) < self._look_at:
            return
        self._look_at = now + LOOK_S
        frozen = frozenset(name for name, child in self._children.items() if child.frozen)
        for name in sorted(frozen - self._frozen):
            self._notice(f"{name} (process {self._children[name].pid}) is frozen")
        for name in sorted(self._frozen - frozen):
            if self._children[name].alive:
                self._notice(f"{name} (process {self._children[name].pid}) goes on")
        self._frozen = frozen

    def _progress(self, endpoint: str) -> Progress:
        absent = dict.fromkeys(sorted(self._upkeep.absent(self._guests)), "dead")
        processes = absent | dict.fromkeys(sorted(self._frozen), "frozen")
        return self._watch.progress()._replace(connect=endpoint, processes=processes)

    def _stop(self) -> None:
        """Stop all processes in order; by force what does not follow in its time."""
        begin = time.monotonic()
        order = zip(stop_order(self._scenario), STOP_WITHIN_S, strict=True)
        for names, within_s in order:
            until = begin + self._patience * within_s
            if names == (SIMULATOR,) and SIMULATOR in self._children:
                left = until - LAST_S - time.monotonic()
                speed = self._clock.speed
                time.sleep(max(min(RUNDOWN_S / speed, RUNDOWN_S, left), 0.0))
            finish_all([self._children[name] for name in names if name in self._children], until)


_FAIR = FaultPlan(since_ns=0)
"""Nothing is wrong between the supervisor and its processes."""


def _require_time(until: float, missing: Collection[str]) -> None:
    if missing and time.monotonic() > until:
        raise RunError(f"{', '.join(sorted(missing))} did not come up in time")


def _drain(inbox: SimpleQueue[tuple[str, bytes]]) -> Iterator[tuple[str, bytes]]:
    yield inbox.get(timeout=_POLL_S)
    for _ in range(inbox.qsize()):
        yield inbox.get_nowait()
