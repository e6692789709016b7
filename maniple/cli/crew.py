"""The processes of a run: starts them, finds who has died or is frozen, starts again who is due."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path

from maniple.cli.processes import LIFE, Child, Process, finish_all
from maniple.cli.upkeep import SIMULATOR, Death, Moment, Upkeep
from maniple.core import edges
from maniple.core.errors import RunError
from maniple.core.messages import FaultPlan
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.host.clock import Anchor
from maniple.host.liveness import Life
from maniple.recording.writer import part, parts_of

RECORDER = "recorder"
LEAST = 3
"""Robots that make a formation."""
LOOK_S = 0.25
"""How often frozen processes are looked for, wall time."""


class Crew:
    """What the fault plan kills comes back as it says; with `keep_alive` everything but the simulator and
    vehicles that dies is started again. Without, robots may be lost as long as enough are left for a
    formation; one is lost with its agent, its driver or its vehicle. These and the controller may come back
    as processes of somebody else, guests. `notice` is told.
    """

    def __init__(
        self, scenario: Scenario, log: Path, clock: Anchor, keep_alive: bool, notice: Callable[[str], None]
    ) -> None:
        self._robots = frozenset(robot.id for robot in scenario.robots)
        self._robot_of = {robot.id: robot.id for robot in scenario.robots} | {
            process: robot.id for robot in scenario.robots for process in edges.processes_of(robot)
        }
        self._json = to_json(scenario)
        self._clock = clock
        self._notice = notice
        self._upkeep = Upkeep(scenario, keep_alive)
        self._processes: dict[str, Process] = {}
        self._children: dict[str, Child] = {}
        self._guests: dict[str, int] = {}
        self._frozen: frozenset[str] = frozenset()
        self._look_at = 0.0
        self._log = log
        self._others = frozenset(parts_of(log))
        self.restarts: dict[str, int] = {}
        """How often each process was started again."""

    def __contains__(self, name: str) -> bool:
        """Whether a process was ever started."""
        return name in self._children

    @property
    def logs(self) -> list[Path]:
        """The parts of the recording that are there."""
        return [path for path in parts_of(self._log) if path not in self._others]

    def spawn(self, process: Process, life: int = LIFE) -> Child:
        """Start a process, as a life of its node.

        Raises:
            RunError: it can't be started.
        """
        self._processes[process.name] = process
        self._upkeep.started(process.name, life, self._now())
        child = self._children[process.name] = Child(process, self._json)
        return child

    def require_alive(self, names: Collection[str]) -> None:
        """During the start: these must live, if they were started.

        Raises:
            RunError: one is dead; with its last words.
        """
        ours = [self._children[name] for name in sorted(names) if name in self]
        if dead := [child.epitaph() for child in ours if not child.alive]:
            raise RunError("\n".join(dead))

    def finish(self, names: Sequence[str], until: float) -> None:
        """End some of them, by force at `until` (monotonic seconds)."""
        finish_all([self._children[name] for name in names if name in self], until)

    def meet(self, life: Life) -> None:
        """Welcome a node that somebody else started in the place of one of ours, and miss it when it goes.

        Raises:
            RunError: the platoon can't do without.
        """
        node = life.node
        ours = node in self._robot_of or node == "controller"
        if not ours or life.incarnation == self._upkeep.life(node):
            return
        self._upkeep.met(node, life.incarnation)
        if life.alive:
            self._guests[node] = life.incarnation
            back = self._upkeep.is_dead(node)
            self._notice(f"{node} is {'back' if back else 'there twice'} (incarnation {life.incarnation})")
        elif self._guests.get(node) == life.incarnation:
            del self._guests[node]
            self._go_on(f"{node} is gone again (incarnation {life.incarnation})")

    def bury(self, plan: FaultPlan) -> None:
        """Find who has died, and what that means.

        Raises:
            RunError: the platoon can't do without.
        """
        for name, child in sorted(self._children.items()):
            if not (child.alive or self._upkeep.is_dead(name)):
                death = self._upkeep.died(name, plan, self._now())
                planned = ", as the fault plan says" if death.crash else ""
                self._go_on(child.epitaph(planned + self._consequence(name, death)))

    def revive(self, plan: FaultPlan) -> None:
        """Start again who is due."""
        for name in self._upkeep.due(plan, self._now(), self._guests):
            self._children[name].finish(0.0)
            life, process = self._upkeep.next_life(name), self._processes[name]
            about = f" (incarnation {life})" if "--incarnation" in process.arguments else ""
            if name == RECORDER:
                process = process.also("--next")
                about = f": {self._next_log()}"
            self.spawn(process.having("--incarnation", str(life)), life)
            self.restarts[name] = self.restarts.get(name, 0) + 1
            self._notice(f"{name} is started again{about}")

    def look_for_frozen(self) -> None:
        """Say who is frozen and who goes on, not more often than every `LOOK_S`."""
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

    def pass_on(self) -> None:
        """Say what the recorder, drivers and vehicles say."""
        for name, child in self._children.items():
            if name == RECORDER or (name in self._robot_of and name not in self._robots):
                for line in child.news():
                    self._notice(line if line.startswith(name) else f"{name}: {line}")

    def troubles(self) -> Mapping[str, str]:
        """Who is "dead" or "frozen" now."""
        absent = dict.fromkeys(sorted(self._upkeep.absent(self._guests)), "dead")
        return absent | dict.fromkeys(sorted(self._frozen), "frozen")

    def _consequence(self, name: str, death: Death) -> str:
        """What the death of a process means for the platoon, in words."""
        lasts_s = death.crash.restart_after_s if death.crash else None
        if name == SIMULATOR:
            return "; a run can't go on without it"
        if name not in self._robot_of:
            back = f"back after {lasts_s:g} s" if lasts_s else "it will be back"
            return f"; {back}" if death.back else ""
        missing = self._robots_of(self._upkeep.absent(self._guests))
        lost = self._robots_of(self._upkeep.lost(self._guests))
        here, later = len(self._robots - missing), len(missing - lost)
        armed = name == edges.driver_of(self._robot_of[name]) and not death.back
        left = "; its vehicle may still be armed" if armed else ""
        if here + later < LEAST:
            return f"{left}; {here} robots are left, a formation needs {LEAST}"
        return f"{left}; {here} robots go on" + (f", {later} will be back" if later else "")

    def _go_on(self, what: str) -> None:
        """Say what happened, if the platoon goes on.

        Raises:
            RunError: it can't do without who is lost.
        """
        lost = self._upkeep.lost(self._guests)
        if lost - self._robot_of.keys() or len(self._robots - self._robots_of(lost)) < LEAST:
            raise RunError(what)
        self._notice(what)

    def _robots_of(self, processes: Collection[str]) -> frozenset[str]:
        """The robots that need one of these."""
        return frozenset(self._robot_of[name] for name in processes if name in self._robot_of)

    def _next_log(self) -> Path:
        """Where the next part of the recording goes."""
        return next(path for path in map(partial(part, self._log), count(1)) if not path.exists())

    def _now(self) -> Moment:
        return Moment(time.monotonic(), self._clock.now())
