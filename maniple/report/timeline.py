"""What happened when: spans of time and events, from what was said."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from typing import NamedTuple

from maniple.core.faults import NEVER
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal
from maniple.core.plans import numbered
from maniple.core.time import SECOND, Time, from_seconds, to_seconds


class Span(NamedTuple):
    """A time in which something stays the same."""

    begin: float
    """s."""
    end: float
    what: str


class Event(NamedTuple):
    """Something that happened."""

    t: float
    """s."""
    what: str


def spans_of(
    said: Iterable[tuple[Time, str]], begin: Time, end_s: float, silent_s: float
) -> tuple[Span, ...]:
    """What was said, in order of time, as spans; each lasts until something else is said, or until nothing
    has been for `silent_s`. Nothing is said by an empty string."""
    rows = [((stamp - begin) / SECOND, what) for stamp, what in said]
    spans: list[Span] = []
    for (t, what), (following, _) in zip_longest(rows, rows[1:], fillvalue=(end_s, "")):
        until = following if following - t <= silent_s else min(t + silent_s, following)
        if spans and spans[-1].what == what and spans[-1].end >= t:
            spans[-1] = spans[-1]._replace(end=until)
        else:
            spans.append(Span(t, until, what))
    return tuple(span for span in spans if span.what)


def events_of(
    states: Sequence[FormationState],
    goals: Sequence[Goal],
    contacts: Iterable[tuple[float, str]],
    begin: Time,
    stops: Sequence[EmergencyStop] = (),
    plans: Sequence[FaultPlan] = (),
    end: Time = NEVER,
) -> tuple[Event, ...]:
    """Changes that the controller told of, what operators wanted, faults that begin, and contacts, in the
    order of time. `stops` and `plans` are in the order in which they were sent; no fault begins after
    `end`."""
    events = [Event(t, f"contact: {who.replace('|', ' and ')}") for t, who in contacts]
    events += [Event(to_seconds(goal.stamp_ns - begin), f"goal: {_wish(goal)}") for goal in goals]
    for last, stop in zip([None, *stops], stops, strict=False):
        if last is None or (stop.source, stop.incarnation) != (last.source, last.incarnation):
            why = f": {stop.reason}" if stop.reason else ""
            what = f"emergency stop{why}" if stop.stopped else "armed"
            events.append(Event(to_seconds(stop.stamp_ns - begin), what))
    events += [Event(to_seconds(t - begin), what) for t, what in _injected(plans, end)]
    for before, now in zip([None, *states], states, strict=False):
        t = to_seconds(now.stamp_ns - begin)
        events += [Event(t, what) for what in _changes(before, now)]
    return tuple(sorted(events, key=lambda event: event.t))


def _injected(plans: Sequence[FaultPlan], end: Time) -> Iterator[tuple[Time, str]]:
    """What begins while the plan it is in holds; once, however often it is said."""
    told: set[tuple[float, str]] = set()
    for plan, until in zip(plans, [*(plan.stamp_ns for plan in plans[1:]), end], strict=False):
        planned = set(_planned(plan))
        told &= planned
        for at_s, what in sorted(planned - told):
            if (t := max(plan.since_ns + from_seconds(at_s), plan.stamp_ns)) <= until:
                told.add((at_s, what))
                yield t, what


def _planned(plan: FaultPlan) -> Iterator[tuple[float, str]]:
    """When each part of a plan begins, in s since its start."""
    for number, rule in numbered(plan).items():
        link = f"fault rule {number}, from {rule.source} to {rule.destination}, topic {rule.topic}"
        for start, end in rule.windows:
            yield start, f"{link}, for {end - start:g} s"
        if not rule.windows:
            yield 0.0, link
    for one in plan.partitions:
        groups = " | ".join(",".join(group) for group in one.groups)
        yield one.at_s, f"partition {groups} | all others{_lasting(one.for_s)}"
    for crash in plan.crashes:
        back = "" if crash.restart_after_s is None else f", back after {crash.restart_after_s:g} s"
        yield crash.at_s, f"{crash.node} is killed{back}"
    for freeze in plan.freezes:
        yield freeze.at_s, f"{freeze.node} is frozen{_lasting(freeze.for_s)}"


def _lasting(for_s: float | None) -> str:
    return "" if for_s is None else f" for {for_s:g} s"


def _changes(before: FormationState | None, now: FormationState) -> Iterable[str]:
    """What is new in a state. Of a wait it is told why it began, not who joins in and who leaves."""
    if before is None or now.phase != before.phase:
        yield f"{now.phase}{': ' * bool(now.reason)}{now.reason}"
    elif now.reason and now.reason != before.reason and not (now.waits_for and before.waits_for):
        yield now.reason
    if before is None:
        return
    if now.incarnation != before.incarnation:
        yield "the controller lives anew"
    if now.leg != before.leg:
        yield f"part {now.leg + 1} of the task"
    if now.chain != before.chain:
        yield f"chain {' '.join(now.chain) or 'of nobody'}"
    if now.goal != before.goal and now.goal:
        yield f"goal refused: {now.goal_refused}" if now.goal_refused else "goal accepted"
    known = {} if before.phase == "waiting" else {robot.id: robot.state for robot in before.roster}
    for robot in now.roster:
        if known.get(robot.id, robot.state) != robot.state:
            yield f"{robot.id} {robot.state}"
    yield from (f"supervisor: {note}" for note in now.supervisor if note not in before.supervisor)


def _wish(goal: Goal) -> str:
    """What an operator wants, in few words."""
    words = []
    if goal.task is not None:
        words.append(f"task {goal.task.__struct_config__.tag}")
    if goal.formation is not None:
        words.append("another shape")
    if goal.hold is not None:
        words.append("hold" if goal.hold else "resume")
    return ", ".join(words) or "nothing"
