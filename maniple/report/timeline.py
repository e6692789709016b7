"""What happened when: spans of time and events, from what was said."""

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import NamedTuple

from maniple.core.messages import FormationState, Goal
from maniple.core.time import SECOND, Time, to_seconds


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
) -> tuple[Event, ...]:
    """Changes that the controller told of, what operators wanted, and contacts, in the order of time."""
    events = [Event(t, f"contact: {who.replace('|', ' and ')}") for t, who in contacts]
    events += [Event(to_seconds(goal.stamp_ns - begin), f"goal: {_wish(goal)}") for goal in goals]
    for before, now in zip([None, *states], states, strict=False):
        t = to_seconds(now.stamp_ns - begin)
        events += [Event(t, what) for what in _changes(before, now)]
    return tuple(sorted(events, key=lambda event: event.t))


def _changes(before: FormationState | None, now: FormationState) -> Iterable[str]:
    """What is new in a state."""
    if before is None or now.phase != before.phase:
        yield f"{now.phase}{': ' * bool(now.reason)}{now.reason}"
    elif now.reason and now.reason != before.reason:
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
