"""The text log: what happened, told once, in order of the log."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from maniple.core import happenings
from maniple.core.happenings import Happening
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal, Message, Status, Truth
from maniple.core.time import SECOND, Duration, Time, from_seconds

_BAD_MODES = ("emergency", "fault")
_UNEASY_MODE = "holding"

_GRACE: Duration = SECOND
"""What began no longer than this before the first message is told with it."""


class Line(NamedTuple):
    """One line of the log."""

    name: str
    """Whom it is about."""
    happening: Happening


class Narrator:
    """Hears messages and tells what is new in them. `plan` is what is injected until another is heard."""

    def __init__(self, plan: FaultPlan | None = None) -> None:
        self._state: FormationState | None = None
        self._modes: dict[str, str] = {}
        self._lives: dict[str, int] = {}
        self._contacts: frozenset[str] = frozenset()
        self._stopped_by: tuple[str, int] | None = None
        self._goal: str | None = None
        self._told: set[tuple[float, str]] = set()
        self._since: Time | None = None
        self._to_come: list[tuple[Time, float, str]] = []
        self._handlers: Mapping[type[Message], Callable[[Any], Iterable[Line]]] = {
            FormationState: self._on_state,
            Status: self._on_status,
            Truth: self._on_truth,
            Goal: self._on_goal,
            EmergencyStop: self._on_stop,
            FaultPlan: self._on_plan,
        }
        if plan is not None:
            self._take(plan)

    def hear(self, message: Message) -> Iterable[Line]:
        """What a message tells that is new."""
        handler = self._handlers.get(type(message))
        return () if handler is None else handler(message)

    def due(self, now: Time) -> Iterator[Line]:
        """Faults that have begun; not those from before it was asked for the first time."""
        if self._since is None:
            self._since = now - _GRACE
        while self._to_come and self._to_come[0][0] <= now:
            began, at_s, what = self._to_come.pop(0)
            self._told.add((at_s, what))
            if began >= self._since:
                yield Line("faults", Happening(what, "warning"))

    def _on_state(self, state: FormationState) -> Iterator[Line]:
        before, self._state = self._state, state
        yield from (Line("controller", change) for change in happenings.changes(before, state))

    def _on_status(self, status: Status) -> Iterator[Line]:
        name, life = status.source, status.incarnation
        if life > self._lives.setdefault(name, life):
            self._lives[name] = life
            yield Line(name, Happening(f"{name} lives anew", "warning"))
        if self._modes.get(name) == status.mode:
            return
        self._modes[name] = status.mode
        text = f"{name} {status.mode}{f': {status.reason}' if status.reason else ''}"
        if status.mode in _BAD_MODES:
            yield Line(name, Happening(text, "error"))
        else:
            yield Line(name, Happening(text, "warning" if status.mode == _UNEASY_MODE else "info"))

    def _on_truth(self, truth: Truth) -> Iterator[Line]:
        before, self._contacts = self._contacts, frozenset(truth.contacts)
        yield from (Line("simulator", happenings.contact(who)) for who in sorted(self._contacts - before))

    def _on_goal(self, goal: Goal) -> Iterator[Line]:
        if goal.id != self._goal:
            self._goal = goal.id
            yield Line("operator", happenings.wish(goal))

    def _on_stop(self, said: EmergencyStop) -> Iterator[Line]:
        by = said.source, said.incarnation
        if by != self._stopped_by:
            self._stopped_by = by
            yield Line("operator", happenings.stop(said))

    def _on_plan(self, plan: FaultPlan) -> tuple[Line, ...]:
        self._take(plan)
        return ()

    def _take(self, plan: FaultPlan) -> None:
        """What begins while this plan holds, unless it was told of; once, however often it is said."""
        wanted = set(happenings.planned(plan))
        self._told &= wanted
        self._to_come = sorted(
            (max(plan.since_ns + from_seconds(at_s), plan.stamp_ns), at_s, what)
            for at_s, what in wanted - self._told
        )
