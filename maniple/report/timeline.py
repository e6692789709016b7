"""What happened when: spans of time and events, from what was said."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from typing import NamedTuple

from maniple.core import happenings
from maniple.core.faults import NEVER
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal
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
    events = [Event(t, happenings.contact(who).what) for t, who in contacts]
    events += [Event(to_seconds(goal.stamp_ns - begin), happenings.wish(goal).what) for goal in goals]
    for last, stop in zip([None, *stops], stops, strict=False):
        if last is None or (stop.source, stop.incarnation) != (last.source, last.incarnation):
            events.append(Event(to_seconds(stop.stamp_ns - begin), happenings.stop(stop).what))
    events += [Event(to_seconds(t - begin), what) for t, what in _injected(plans, end)]
    for before, now in zip([None, *states], states, strict=False):
        t = to_seconds(now.stamp_ns - begin)
        events += [Event(t, change.what) for change in happenings.changes(before, now)]
    return tuple(sorted(events, key=lambda event: event.t))


def _injected(plans: Sequence[FaultPlan], end: Time) -> Iterator[tuple[Time, str]]:
    """What begins while the plan it is in holds; once, however often it is said."""
    told: set[tuple[float, str]] = set()
    for plan, until in zip(plans, [*(plan.stamp_ns for plan in plans[1:]), end], strict=False):
        planned = set(happenings.planned(plan))
        told &= planned
        for at_s, what in sorted(planned - told):
            if (t := max(plan.since_ns + from_seconds(at_s), plan.stamp_ns)) <= until:
                told.add((at_s, what))
                yield t, what
