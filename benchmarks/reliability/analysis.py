"""What a recording says of the processes that were killed or frozen while it was made."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from operator import attrgetter
from typing import NamedTuple, TypeVar

import numpy as np

from benchmarks.reliability.runs import Case, Done, Event, under_way
from maniple.cli.outcome import recordings_of
from maniple.control.limits import limits_of
from maniple.core.messages import (
    Command,
    Drive,
    FormationState,
    Journal,
    Message,
    Odometry,
    Truth,
    unpack_floats,
)
from maniple.core.time import SECOND, Time, to_seconds

SLACK_S = 0.5
"""What is allowed beyond the age limit and braking,"""
RECOVERED_WITHIN_S = 3.0
"""and until the platoon is under way again."""
STANDS_MPS, STANDS_RADPS = 0.01, 0.02
"""A robot that is slower stands."""

M = TypeVar("M", bound=Message)


class Found(NamedTuple):
    """What came of one case, in seconds of scenario time."""

    case: Case
    stood_s: float | None
    """From the event until those affected stand, None where they did not have to; without a router, for how
    long they rolled on."""
    bound_s: float
    """What that may be: `stop_after_s` + v / deceleration + 0.5 s."""
    held: bool
    """Whether nobody affected moved between the bound and when the process was back."""
    reference_s: float | None
    """From the event until the reference stands, as the controller says; None where it does not."""
    back_s: float
    """From the event until the process is back."""
    recovered_s: float
    """From then until the platoon is under way, and stays so."""
    age_s: float
    """The largest age of a command while its robot was told to move."""
    collisions: int

    @property
    def ok(self) -> bool:
        """Whether the promises hold."""
        return self.held and self.recovered_s <= RECOVERED_WITHIN_S and not self.collisions


class _Call(NamedTuple):
    """A robot took a command in."""

    at: Time
    answered: Time
    """When the odometry was sent that the command was computed from."""
    known_until: Time
    """Up to here its journal tells what else it took in."""


class Analysis:
    """Reads the recording of a run, in all its parts."""

    def __init__(self, done: Done) -> None:
        self._limits = {robot.id: limits_of(done.scenario, robot) for robot in done.scenario.robots}
        self._truth: list[Truth] = []
        self._states: list[FormationState] = []
        self._odometry: list[Odometry] = []
        self._drives: list[Drive] = []
        self._answers: dict[tuple[str, int, int], Time] = {}
        self._calls: defaultdict[str, list[_Call]] = defaultdict(list)
        self._begins: list[Time] = []
        journals: list[Journal] = []
        for recording in recordings_of(done.logs):
            records = list(recording.messages())
            self._begins += [record.log_time_ns for record in records[:1]]
            for record in records:
                match record.message:
                    case Truth() as message:
                        self._truth.append(message)
                    case FormationState() as message:
                        self._states.append(message)
                    case Odometry() as message:
                        self._odometry.append(message)
                    case Drive() as message:
                        self._drives.append(message)
                    case Command() as message:
                        mark = record.topic, message.incarnation, message.seq
                        self._answers[mark] = message.answers.stamp_ns
                    case Journal() as message:
                        journals.append(message)
        for messages in (self._truth, self._states, self._odometry, self._drives):
            messages.sort(key=attrgetter("stamp_ns"))
        self._read(journals)

    def _read(self, journals: Sequence[Journal]) -> None:
        """Which command each robot had, from when on, and how long no journal is missing after that."""
        ordered = sorted(journals, key=_place)
        calls: list[tuple[Time, Time]] = []
        for journal, following in zip_longest(ordered, ordered[1:]):
            for call in journal.calls:
                answered = self._answers.get((call.name, call.incarnation, call.seq))
                if call.kind == "message" and answered is not None:
                    calls.append((call.now_ns, answered))
            source, life, seq = _place(journal)
            if following is None or _place(following) != (source, life, seq + 1):
                self._calls[source] += [_Call(*call, journal.stamp_ns) for call in calls]
                calls = []
        for known in self._calls.values():
            known.sort()

    def found(self, events: Sequence[Event]) -> list[Found]:
        """What came of the cases, which were done in this order."""
        if not self._states:
            raise ValueError("the recording holds no word of a controller")
        ends = [event.begin for event in events[1:]] + [self._states[-1].stamp_ns]
        return [self._one(event, end) for event, end in zip(events, ends, strict=True)]

    def _one(self, event: Event, end: Time) -> Found:
        case, begin, back = event.case, event.begin, self._back(event)
        affected = self._affected(case)
        bound_s = max((self._bound_s(robot, begin) for robot in affected), default=0.0)
        stood_s: float | None
        if case.who == "router":
            stood_s = self._rolled_s(begin, back)
            held = stood_s <= bound_s
        else:
            moving = list(self._moving(case, affected, begin, back))
            stood_s = next((to_seconds(at - begin) for at, moves in moving if not moves), None)
            held = not any(moves for at, moves in moving if at > begin + bound_s * SECOND)
        states = between(self._states, begin, end)
        stopped = [state.stamp_ns for state in states if state.rate == 0.0]
        waits = [state.stamp_ns for state in states if state.stamp_ns >= back and not under_way(state)]
        goes = next((one.stamp_ns for one in states if one.stamp_ns > max([back, *waits])), None)
        hits = [truth.collisions for truth in between(self._truth, begin, end)]
        return Found(
            case,
            stood_s,
            bound_s,
            held,
            to_seconds(stopped[0] - begin) if stopped else None,
            to_seconds(back - begin),
            float("inf") if goes is None else to_seconds(goes - back),
            self._oldest_s(begin, end),
            hits[-1] - hits[0] if hits else 0,
        )

    def _affected(self, case: Case) -> tuple[str, ...]:
        """Who can't go on: nobody without the recorder, all without controller, router or world."""
        if case.who == "recorder":
            return ()
        return (case.who,) if case.who in self._limits else tuple(self._limits)

    def _back(self, event: Event) -> Time:
        """When the process was there again: let go, or first heard of."""
        who, begin = event.case.who, event.begin
        if event.thawed is not None:
            return event.thawed
        if who == "recorder":
            return next(at for at in self._begins if at > begin)
        if who == "router":  # nobody hears anything until it is back
            return next(truth.stamp_ns for truth in self._truth if truth.stamp_ns > begin + SECOND // 20)
        heard: Sequence[Message] = self._states if who == "controller" else self._odometry
        mine = [message for message in heard if message.source == who]
        life = max(message.incarnation for message in mine if message.stamp_ns <= begin)
        return next(message.stamp_ns for message in mine if message.incarnation > life)

    def _bound_s(self, robot: str, begin: Time) -> float:
        limits = self._limits[robot]
        truth = between(self._truth, begin - SECOND, begin)[-1]
        speed = abs(unpack_floats(truth.velocities, 2)[truth.robots.index(robot), 0])
        return float(limits.stop_s + speed / limits.brake + SLACK_S)

    def _rolled_s(self, begin: Time, back: Time) -> float:
        """How long the robot that came farthest would have needed at its speed before: nobody hears anything
        without a router, but all see where everybody is afterwards."""
        before = between(self._truth, begin - SECOND, begin)[-1]
        after = next(truth for truth in self._truth if truth.stamp_ns > max(begin + SECOND // 20, back))
        there, here = (unpack_floats(truth.poses, 3)[:, :2] for truth in (after, before))
        speeds = np.abs(unpack_floats(before.velocities, 2)[:, 0])
        return float((np.hypot(*(there - here).T) / speeds).max())

    def _moving(
        self, case: Case, affected: Sequence[str], begin: Time, end: Time
    ) -> Iterator[tuple[Time, bool]]:
        """When any of them moved and when none: by ground truth or, while there is no world, by what their
        drives were told."""
        if case.who != "simulator":
            for truth in between(self._truth, begin, end):
                yield truth.stamp_ns, _move(truth, affected)
            return
        told = dict.fromkeys(affected, True)
        for drive in between(self._drives, begin, end):
            told[drive.source] = _moves(drive)
            yield drive.stamp_ns, any(told.values())

    def _oldest_s(self, begin: Time, end: Time) -> float:
        ages = [0.0]
        for drive in between(self._drives, begin, end):
            calls = self._calls[drive.source]
            at = bisect_left(calls, (drive.stamp_ns + 1,)) - 1
            if at >= 0 and _moves(drive) and drive.stamp_ns <= calls[at].known_until:
                ages.append(to_seconds(drive.stamp_ns - calls[at].answered))
        return max(ages)


def between(messages: Sequence[M], begin: Time, end: Time) -> Sequence[M]:
    """Those of messages in order that were sent in (begin, end]."""
    stamp = attrgetter("stamp_ns")
    return messages[bisect_left(messages, begin + 1, key=stamp) : bisect_left(messages, end + 1, key=stamp)]


def _move(truth: Truth, robots: Sequence[str]) -> bool:
    """Whether any of some robots moves."""
    rows = [truth.robots.index(robot) for robot in robots]
    moves = np.abs(unpack_floats(truth.velocities, 2)[rows]) > (STANDS_MPS, STANDS_RADPS)
    return bool(moves.any())


def _place(journal: Journal) -> tuple[str, int, int]:
    return journal.source, journal.incarnation, journal.seq


def _moves(drive: Drive) -> bool:
    return abs(drive.u_mps) > STANDS_MPS or abs(drive.w_radps) > STANDS_RADPS
