"""What happened when: spans of time and events, from what was said."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from math import inf
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

from maniple.core import happenings
from maniple.core.faults import NEVER
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal
from maniple.core.time import SECOND, Time, from_seconds, to_seconds

F = TypeVar("F", bound=tuple[Any, ...])

FaultKind: TypeAlias = Literal["links", "partition", "frozen", "killed"]
"""What is injected: rules of links, partitions of nodes, nodes that freeze or die."""


class Span(NamedTuple):
    """A time in which something stays the same."""

    begin: float
    """s."""
    end: float
    what: str


class Injected(NamedTuple):
    """A time in which something is injected."""

    begin: float
    """s."""
    end: float
    kind: FaultKind
    who: str
    """The nodes that it is about."""


class _Fault(NamedTuple):
    """Something that a plan injects."""

    at_s: float
    """Since the start of the run."""
    kind: FaultKind
    who: str
    for_s: float


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


def injected_of(plans: Sequence[FaultPlan], begin: Time, end: Time) -> tuple[Injected, ...]:
    """When which faults were on, in s since `begin`, by their beginnings; each once, however often its plan
    is said. `plans` are in the order in which they were sent; a fault ends with the plan it is in, but who
    is killed or frozen stays so for as long as was planned then."""
    planned = [frozenset(_faults(plan)) for plan in plans]
    end_s = to_seconds(end - begin)
    found = []
    for t, (at_s, kind, who, for_s), plan, gone in _begun(plans, planned, end):
        if kind in ("killed", "frozen"):
            last = to_seconds(t - begin) + for_s
        else:
            last = min(to_seconds(plan.since_ns - begin) + at_s + for_s, to_seconds(gone - begin))
        first = max(to_seconds(t - begin), 0.0)
        if min(last, end_s) > first:
            found.append(Injected(first, min(last, end_s), kind, who))
    return tuple(sorted(found))


def _faults(plan: FaultPlan) -> Iterator[_Fault]:
    """All that a plan injects."""
    for rule in plan.faults:
        who = f"{rule.source} to {rule.destination}"
        for start, stop in rule.windows or ((0.0, inf),):
            yield _Fault(start, "links", who, stop - start)
    for one in plan.partitions:
        who = " | ".join(",".join(group) for group in one.groups)
        yield _Fault(one.at_s, "partition", who, _or_for_ever(one.for_s))
    for crash in plan.crashes:
        yield _Fault(crash.at_s, "killed", crash.node, _or_for_ever(crash.restart_after_s))
    for freeze in plan.freezes:
        yield _Fault(freeze.at_s, "frozen", freeze.node, _or_for_ever(freeze.for_s))


def _or_for_ever(for_s: float | None) -> float:
    return inf if for_s is None else for_s


def _injected(plans: Sequence[FaultPlan], end: Time) -> Iterator[tuple[Time, str]]:
    """What begins, in words, and when."""
    planned = [frozenset(happenings.planned(plan)) for plan in plans]
    for t, (_, what), _, _ in _begun(plans, planned, end):
        yield t, what


def _begun(
    plans: Sequence[FaultPlan], planned: Sequence[frozenset[F]], end: Time
) -> Iterator[tuple[Time, F, FaultPlan, Time]]:
    """What begins while a plan that it is in holds, once, however often it is said: when, what, in which
    plan, and when the first plan came that it is no longer in. `planned` is what is in each of `plans`, with
    the time when it begins, in s since the start of the plan, first."""
    told: frozenset[F] = frozenset()
    said = [*(plan.stamp_ns for plan in plans), end]
    for place, (plan, now) in enumerate(zip(plans, planned, strict=True)):
        told &= now
        for one in sorted(now - told):
            if (t := max(plan.since_ns + from_seconds(one[0]), plan.stamp_ns)) <= said[place + 1]:
                told |= {one}
                gone = (said[k] for k in range(place + 1, len(plans)) if one not in planned[k])
                yield t, one, plan, next(gone, end)
