"""What operators said in the course of a recorded run, to be said again in virtual time."""

import zlib
from typing import NamedTuple

from msgspec.structs import replace

from maniple.core import codec, topics
from maniple.core.clocks import node_clock
from maniple.core.envelope import Envelope
from maniple.core.messages import FaultPlan, FormationState, Journal, Message
from maniple.core.time import VIRTUAL_EPOCH, Duration, Time
from maniple.host.liveness import ROUTER
from maniple.recording.reader import Recorded, Recording

FROM_ANYBODY = (topics.FORMATION_GOAL, topics.STOP, topics.PLAN)


class Course(NamedTuple):
    """What came to a recorded run from outside."""

    inputs: tuple[tuple[Time, Envelope], ...]
    """What operators said, in its order, and when, in virtual time; stamps and plans are moved there."""
    done: bool
    """Whether the task was done at the end."""
    lasted: Duration
    """From the start of the run until its nodes were stopped; where no journal says when that was, until the
    controller was heard last, or anything."""


def course_of(recording: Recording) -> Course:
    """What came to a recorded run from outside: goals, emergency stops, other fault plans, and its end.

    Raises:
        RecordingError: it is damaged, or its scenario can't be read.
    """
    said: dict[tuple[str, str, int, int], tuple[Recorded, Message]] = {}
    begin: Time | None = None
    first = last = 0
    told: Time | None = None
    phase = ""
    stops: dict[str, Time] = {}
    for record in recording.messages():
        first = first or record.log_time_ns
        last = record.log_time_ns
        if not (record.topic in _WORDS or record.topic.startswith(_JOURNALS)):
            continue
        match message := record.message:
            case FaultPlan(source=source) if source == ROUTER:
                begin = message.since_ns if begin is None else begin
            case FormationState():
                phase, told = message.phase, record.log_time_ns
            case Journal():
                if message.calls and (last_call := message.calls[-1]).kind == "stop":
                    stops[message.source] = last_call.now_ns
            case None:
                pass
            case _:
                identity = record.topic, message.source, message.incarnation, message.seq
                said.setdefault(identity, (record, message))  # what is latched may be recorded again
    virtual = recording.metadata.get("mode") == "virtual"
    start = VIRTUAL_EPOCH if virtual else first if begin is None else begin
    inputs = tuple(_moved(record, message, start, virtual) for record, message in said.values())
    end = _end(recording, stops, start, last if told is None else told)
    return Course(inputs, phase == "done", end - start)


_WORDS = frozenset({*FROM_ANYBODY, topics.FORMATION_STATE})
_JOURNALS = topics.journal("")


def _end(recording: Recording, stops: dict[str, Time], start: Time, last: Time) -> Time:
    """When the controller and the robots were stopped, in true scenario time; by a clock that is right, if
    there is one."""
    scenario = recording.scenario
    off = {error.node for error in scenario.clocks}
    names = [name for name in ("controller", *(robot.id for robot in scenario.robots)) if name in stops]
    for name in sorted(names, key=lambda name: name in off):
        return node_clock(scenario, name, start).true(stops[name])
    return last


def _moved(record: Recorded, message: Message, start: Time, virtual: bool) -> tuple[Time, Envelope]:
    """What somebody said, and when; of a realtime run by the time it arrived, moved into virtual time."""
    when = message.stamp_ns if virtual else max(record.log_time_ns - start, 0) + VIRTUAL_EPOCH
    message = replace(message, stamp_ns=when)
    if isinstance(message, FaultPlan):
        message = replace(message, since_ns=max(message.since_ns - start + VIRTUAL_EPOCH, 0))
    data = codec.encode(message)
    envelope = Envelope(
        record.topic, message.source, message.incarnation, message.seq, when, data, zlib.crc32(data)
    )
    return when, envelope
