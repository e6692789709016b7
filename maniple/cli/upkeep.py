"""Which processes of a run that died are waited for, which are started again, and when. Pure."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from maniple.core import edges
from maniple.core.faults import crash_between, dead, dies_by
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Crash, Scenario
from maniple.core.time import Time

FIRST_S = 0.2
"""Wall time until a process that has died is started again, doubled each time it dies soon after,"""
LONGEST_S = 5.0
"""up to this,"""
CALM_S = 30.0
"""and from the beginning for one that has lived for so long."""
SIMULATOR = "simulator"
"""The world: there is no second one."""


class Moment(NamedTuple):
    """Now, by two clocks."""

    wall_s: float
    """Monotonic."""
    time: Time
    """Of the scenario."""


class Death(NamedTuple):
    """What is to be expected of a process that has died."""

    crash: Crash | None
    """What the fault plan says of it, if that killed it."""
    back: bool
    """Whether it will be back."""
    due_s: float
    """When it is started again if the plan has no say, monotonic wall time."""


class _Post(NamedTuple):
    life: int
    since: Moment
    deaths: int = 0
    """In a row."""
    death: Death | None = None


class Upkeep:
    """Keeps book of the lives of each process. It is told what happens and says what is due.

    What the plan kills is back as the plan says; what dies otherwise is started again with `keep_alive`
    only, the simulator never, and no vehicle: these stand for hardware.
    """

    def __init__(self, scenario: Scenario, keep_alive: bool) -> None:
        self._scenario = scenario
        self._keep_alive = keep_alive
        self._hardware = {SIMULATOR, *(edges.vehicle_of(robot.id) for robot in scenario.robots)}
        self._posts: dict[str, _Post] = {}
        self._lives: dict[str, int] = {}

    def started(self, name: str, life: int, now: Moment) -> None:
        """A process was started, as this life of its node."""
        deaths = self._posts[name].deaths if name in self._posts else 0
        self._posts[name] = _Post(life, now, deaths)
        self.met(name, life)

    def met(self, name: str, life: int) -> None:
        """There is or was this life of a node, whoever started it."""
        self._lives[name] = max(life, self._lives.get(name, 0))

    def died(self, name: str, plan: FaultPlan, now: Moment) -> Death:
        """A process was found dead; says what is to be expected."""
        post = self._posts[name]
        deaths = 1 if now.wall_s - post.since.wall_s >= CALM_S else post.deaths + 1
        crash = self._crash(name, plan, post.since.time, now.time)
        kept = self._keep_alive and name not in self._hardware
        back = kept if crash is None else crash.restart_after_s is not None
        death = Death(crash, back, now.wall_s + backoff_s(deaths))
        self._posts[name] = post._replace(deaths=deaths, death=death)
        return death

    def is_dead(self, name: str) -> bool:
        """Whether `died` was told of this process since it was started."""
        return self._posts[name].death is not None

    def life(self, name: str) -> int:
        """Which life of its node a process was last started as; 0 for one that never was."""
        return self._posts[name].life if name in self._posts else 0

    def next_life(self, name: str) -> int:
        """The number of the next life of a node."""
        return self._lives.get(name, 0) + 1

    def due(self, plan: FaultPlan, now: Moment, guests: Collection[str]) -> list[str]:
        """Who is to be started now; not who has a guest in its place."""
        return [
            name
            for name, post in self._posts.items()
            if post.death is not None and name not in guests and self._is_due(name, post.death, plan, now)
        ]

    def lost(self, guests: Collection[str]) -> frozenset[str]:
        """Who is dead for good, without a guest in its place."""
        return frozenset(
            name
            for name, post in self._posts.items()
            if post.death is not None and not post.death.back and name not in guests
        )

    def absent(self, guests: Collection[str]) -> Mapping[str, Death]:
        """Who is dead now, without a guest in its place."""
        return {name: post.death for name, post in self._posts.items() if post.death and name not in guests}

    def _is_due(self, name: str, death: Death, plan: FaultPlan, now: Moment) -> bool:
        if dead(plan, dies_by(name, self._scenario), now.time) is not None:
            return False
        return death.crash is not None or (death.back and now.wall_s >= death.due_s)

    def _crash(self, name: str, plan: FaultPlan, since: Time, now: Time) -> Crash | None:
        """What of the plan killed a process that has lived since then."""
        killers = dies_by(name, self._scenario)
        return crash_between(plan, killers, since, now) or dead(plan, killers, now)


def backoff_s(deaths: int) -> float:
    """How long to wait before a process is started again that died so many times in a row, s."""
    return min(FIRST_S * 2.0 ** min(deaths - 1, 30), LONGEST_S)
