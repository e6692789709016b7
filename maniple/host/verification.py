"""Compares what a node sends when it is run again with what is recorded of it, byte by byte."""

import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import islice, pairwise
from operator import itemgetter
from statistics import median
from typing import Any, Literal, NamedTuple

import msgspec

from maniple.core import codec, topics
from maniple.core.envelope import Header, header_of
from maniple.core.errors import MessageError
from maniple.core.messages import Alive, Call, Message, unpack_floats
from maniple.core.node import Node
from maniple.core.time import SECOND, Duration, Time, to_seconds
from maniple.host.reexecution import Inputs, LackingError, Life, Step, Tape, lives, may_be_of, reexecute
from maniple.host.runner import FLUSH_PERIOD, HOST
from maniple.recording.compare import EXACT, Tolerance, differences
from maniple.recording.reader import Recorded, Recording

TRACE = 10
"""Calls before the first divergence that are shown."""

LONGEST_TAIL: Duration = SECOND
"""What a killed node said after its last journal is no more than this, at the pace of the clock; else its
journal is missing."""

Verdict = Literal["identical", "within tolerance", "diverges", "unproved"]
"""Of a life: all that it sends again is recorded with the same bytes; or differs by no more than was allowed;
or by more; or it can't be run again to where its journal ends."""

Factory = Callable[[int], Node]
"""Makes a node, given its incarnation."""

Watch = Callable[[], None]
"""Is called now and then; may raise to end it."""

_SHOWN = 10
"""Messages that are named in one line."""

_WATCHED = 4096
"""Messages that are counted in between."""


class Input(msgspec.Struct, frozen=True):
    """One call before a divergence."""

    call: int
    """Its number within the life, from 0."""
    now_ns: Time
    """By the node's clock."""
    kind: str
    name: str = ""
    """The topic of a message, or the timer."""
    source: str = ""
    incarnation: int = 0
    seq: int = 0
    message: Any = None
    """What was in it, without its header; None for what is no message."""


class Divergence(msgspec.Struct, frozen=True):
    """Where a node that is run again first does something else than the recording says."""

    node: str
    incarnation: int
    call: int
    """Number of the call within the life, from 0."""
    kind: str
    name: str
    """What the call is, as in `Input`."""
    now_ns: Time
    """By the node's clock."""
    life_s: float
    """Since the life began."""
    journaled_ns: Time
    """When the journal of that call was recorded: puts divergences of several nodes in order."""
    problem: str
    """In words."""
    topic: str = ""
    seq: int = -1
    field: str = ""
    """The first that differs, or the byte where it is no field; empty where it is not about a value."""
    recorded: Any = None
    recomputed: Any = None
    fields: int = 0
    """How many values of that message differ."""
    trace: tuple[Input, ...] = ()
    """The calls before it, and it."""


class Met(msgspec.Struct, frozen=True):
    """A life of another node, as its host told a node of it."""

    node: str
    incarnation: int
    span_s: float
    """How long it was there at a stretch, by the clock of the node that was told."""


class Proof(msgspec.Struct, frozen=True, kw_only=True):
    """What came of running one life of a node again."""

    node: str
    incarnation: int
    verdict: Verdict
    ended: Literal["stopped", "cut"]
    """Whether its journal goes up to its stop."""
    calls: int
    """That were made again."""
    messages: int
    """That have the same bytes as the recorded ones."""
    near: int = 0
    """That differ by no more than the tolerance."""
    differing: int = 0
    """That differ, that the node does not send, or are recorded twice in different ways."""
    unproved: int = 0
    """That are recorded, but were said after the last call that could be made again."""
    unproved_s: float = 0.0
    """For how long the node went on saying them."""
    unrecorded: int = 0
    """That the node sends, but the recorder did not get."""
    altered: int = 0
    """Messages that the node got with bits flipped on the way; their bytes are in its journal."""
    scenario: str = ""
    """Digest of the scenario that its host ran; empty where the journal does not say."""
    met: tuple[Met, ...] = ()
    """Who it was told is there."""
    reason: str = ""
    """Why it can't be run again to its end."""
    divergence: Divergence | None = None
    """The first."""

    @property
    def holds(self) -> bool:
        """Whether all of it was proved, but for what a killed node had not journaled yet."""
        return self.verdict in ("identical", "within tolerance")


class Speaker(msgspec.Struct, frozen=True):
    """Who says something in a recording: one life of a source."""

    source: str
    incarnation: int
    messages: int
    of_host: int
    """Of these, what its host says: journals, counters of links, fault decisions."""
    first_ns: Time
    """When its first message was said, by its clock."""
    last_ns: Time
    span_s: float
    """From its first message to its last."""
    journaled: bool


class Census(msgspec.Struct, frozen=True):
    """All that is recorded, by who said it."""

    speakers: tuple[Speaker, ...]
    headless: int
    """Messages that had no valid header when they were recorded."""
    changed: tuple[str, ...]
    """Messages, as "TOPIC NUMBER", that had another header when they were recorded: the bytes in the file are
    not those that were written."""
    foreign: dict[str, int]
    """Messages on a topic that belongs to somebody else, by "SOURCE on TOPIC"."""
    disordered: int = 0
    """Messages that are there again, or after later ones of the same life on the same topic."""


def prove(
    recording: Recording,
    makers: Mapping[str, Factory],
    tolerance: Tolerance = EXACT,
    trace: int = TRACE,
    watch: Watch = lambda: None,
) -> tuple[Proof, ...]:
    """Run every life of some nodes again that has left a journal, and compare; `makers` gives for each name
    what makes that node for a life. The recording is read once for all.

    Raises:
        RecordingError: the recording is damaged.
    """
    tape = Tape(recording)
    found = lives(recording, makers)
    again = [_Again(tape, life, makers[life.node](life.incarnation), tolerance) for life in found]
    due = [(life.journals[0].log_time_ns if life.journals else 0, index) for index, life in enumerate(found)]
    heapify(due)
    while due:
        watch()
        time, index = heappop(due)
        stopped = again[index].run(min(due[0][0], time + SECOND) if due else time + SECOND)
        if stopped is not None:
            heappush(due, (stopped, index))
    while tape.read():
        pass
    return tuple(one.proof(recording, tolerance, trace) for one in again)


def census(recording: Recording, watch: Watch = lambda: None) -> Census:
    """Who says how much in a recording.

    Raises:
        RecordingError: it is damaged.
    """
    tallies: defaultdict[tuple[str, int], _Tally] = defaultdict(_Tally)
    foreign: Counter[str] = Counter()
    headless = disordered = 0
    following: dict[tuple[str, str, int], int] = {}
    changed: list[str] = []
    owners: dict[str, tuple[tuple[str, ...], bool, bool]] = {}
    for count, record in enumerate(recording.messages()):
        if count % _WATCHED == 0:
            watch()
        topic = record.topic
        try:
            header = header_of(topic, record.data)
        except MessageError:
            if (record.sequence, record.publish_time_ns) == (0, record.log_time_ns):
                headless += 1
            else:
                changed.append(f"{topic} {record.sequence}")
            continue
        if (header.seq, header.stamp_ns) != (record.sequence, record.publish_time_ns):
            changed.append(f"{topic} {record.sequence}")
        stream = topic, header.source, header.incarnation
        if header.seq < following.get(stream, 0):
            disordered += 1
        else:
            following[stream] = header.seq + 1
        known = owners.get(topic)
        if known is None:
            known = owners[topic] = _owner(topic)
        owners_of, of_host, is_journal = known
        tallies[header.source, header.incarnation].add(header.stamp_ns, of_host, is_journal)
        if owners_of and header.source not in owners_of:
            foreign[f"{header.source} on {topic}"] += 1
    speakers = tuple(tally.speaker(*key) for key, tally in sorted(tallies.items()))
    return Census(speakers, headless, tuple(changed), dict(sorted(foreign.items())), disordered)


def problems_of(census: Census, proofs: Collection[Proof], nodes: Collection[str]) -> list[str]:
    """What keeps a recording from being proved, beside the lives that were run again; `nodes` are those that
    were looked at."""
    proved = {(proof.node, proof.incarnation) for proof in proofs}
    found = [f"{count} messages of {what}, which is not theirs" for what, count in census.foreign.items()]
    if census.changed:
        which = ", ".join(census.changed[:_SHOWN]) + " ..." * (len(census.changed) > _SHOWN)
        found.append(f"{len(census.changed)} messages are not as the recorder wrote them: {which}")
    for one in census.speakers:
        if one.source not in nodes or (one.source, one.incarnation) in proved:
            continue
        who = f"{one.source} (life {one.incarnation})"
        messages = one.messages - one.of_host
        if one.span_s > to_seconds(LONGEST_TAIL):
            found.append(f"{who}: the recording lacks its journal; {messages} messages are unproved")
        elif (other := _out_of_order(one, census.speakers)) is not None:
            order = "before" if one.incarnation < other.incarnation else "after"
            found.append(
                f"{who}: it has no journal, and its messages ({messages}) were not said {order} those of "
                f"life {other.incarnation}: it never was"
            )
    heard = {(one.source, one.incarnation) for one in census.speakers}
    missed: dict[tuple[str, int], tuple[float, Proof]] = {}
    for proof in proofs:
        for met in proof.met:
            life = met.node, met.incarnation
            if met.node in nodes and life not in heard and met.span_s > to_seconds(LONGEST_TAIL):
                missed[life] = max(missed.get(life, (0.0, proof)), (met.span_s, proof), key=itemgetter(0))
    for (node, incarnation), (span_s, proof) in sorted(missed.items(), key=itemgetter(0)):
        found.append(
            f"{node} (life {incarnation}): the recording lacks all of it; it was there for {span_s:.1f} s, "
            f"as {proof.node} (life {proof.incarnation}) was told"
        )
    if not proofs:
        found.append("the recording lacks the journals of all nodes that were to be run again")
    return found


def _out_of_order(one: Speaker, speakers: Sequence[Speaker]) -> Speaker | None:
    """Another life of the same source, where the two did not follow each other as their numbers do."""
    for other in speakers:
        if other.source == one.source and other.incarnation != one.incarnation:
            before, after = sorted((one, other), key=lambda life: life.incarnation)
            if before.last_ns >= after.first_ns:
                return other
    return None


class _Tally:
    """What is counted of one speaker."""

    def __init__(self) -> None:
        self.messages = self.of_host = 0
        self.journaled = False
        self.first: Time = 2**63
        self.last: Time = 0

    def add(self, stamp_ns: Time, of_host: bool, is_journal: bool) -> None:
        self.messages += 1
        self.of_host += of_host
        self.journaled = self.journaled or is_journal
        self.first, self.last = min(self.first, stamp_ns), max(self.last, stamp_ns)

    def speaker(self, source: str, incarnation: int) -> Speaker:
        span_s = to_seconds(self.last - self.first)
        return Speaker(
            source,
            incarnation,
            self.messages,
            self.of_host,
            self.first,
            self.last,
            span_s,
            self.journaled,
        )


class _Finding(NamedTuple):
    """Something that is not as recorded."""

    call: int
    problem: str
    topic: str = ""
    seq: int = -1
    recorded: bytes = b""
    made: bytes = b""


class _Matcher:
    """Brings together what one life sends when it is run again and what is recorded of it, in whatever order
    they come."""

    def __init__(self, life: Life, tolerance: Tolerance) -> None:
        self._life = life
        self._tolerance = tolerance
        self._made: dict[tuple[str, int], tuple[int, bytes]] = {}
        self._early: dict[tuple[str, int], list[Recorded]] = {}
        self._sums: dict[str, array[int]] = {}
        self._told: dict[str, int] = {}
        self._now: Time = 0
        self._met: dict[tuple[str, int], Duration] = {}
        self._there: dict[tuple[str, int], Time] = {}
        self._failed = ""
        self._miscounted = False
        self.same = self.near = self.differing = self.altered = 0
        self.calls = 0
        self.first: _Finding | None = None

    def recorded(self, record: Recorded, header: Header) -> None:
        """A message is recorded under the node's name."""
        topic, seq = record.topic, header.seq
        if header.incarnation != self._life.incarnation or not may_be_of(self._life.node, topic):
            return
        if (made := self._made.pop((topic, seq), None)) is not None:
            self._compare(*made, record)
        elif seq < len(sums := self._sums.get(topic, ())):
            if zlib.crc32(record.data) != sums[seq]:
                self._twice(record, self.calls - 1)
        else:
            same = self._early.setdefault((topic, seq), [])
            if all(record.data != other.data for other in same):
                same.append(record)

    def step(self, step: Step) -> None:
        """A call was made again."""
        call = step.call
        if self._failed and call.kind != "stop":
            self._find(_Finding(step.index - 1, f"it fails when it is run again: {self._failed}"))
        self._failed = step.raised
        self.calls = step.index + 1
        if call.now_ns < self._now:
            self._find(_Finding(step.index, "its journal goes back in time"))
        self._now = call.now_ns
        if call.name == topics.HOST_ALIVE and call.data is not None:
            said = codec.decode(call.name, call.data)
            assert isinstance(said, Alive), "it took it"
            self._meet((said.node, said.node_incarnation), said.alive)
        self.altered += call.data is not None and call.source != HOST
        for one in step.sent:
            self._sums.setdefault(one.topic, array("L")).append(one.crc32)
            key = one.topic, one.seq
            if (early := self._early.pop(key, None)) is None:
                self._made[key] = step.index, one.data
                continue
            best = next((record for record in early if record.data == one.data), early[0])
            self._compare(step.index, one.data, best)
            for other in early:
                if other is not best:
                    self._twice(other, step.index)
        if step.told:
            self._count(step)

    def close(self, reason: str) -> tuple[int, Duration, int]:
        """It ends, before its journal does if there is a `reason`. Returns how many recorded messages are
        unproved, for how long after the last journal they were said, and how many are not recorded."""
        left = [record for records in self._early.values() for record in records]
        if self._failed:
            self._find(_Finding(self.calls - 1, f"it fails when it is run again: {self._failed}"))
        if not reason:
            stopped, later = self._life.ended == "stopped", list[Recorded]()
            for record in sorted(left, key=lambda record: record.publish_time_ns):
                if not stopped and record.publish_time_ns >= self._now:
                    later.append(record)
                    continue
                problem = f"{record.topic} {record.sequence} is recorded, but it does not send it"
                self._find(_Finding(self.calls - 1, problem, record.topic, record.sequence))
            left = later
        last = max((record.publish_time_ns for record in left), default=0)
        journaled = self._life.journals[-1].publish_time_ns if self._life.journals else last
        return len(left), max(last - journaled, 0), len(self._made)

    def met(self) -> tuple[Met, ...]:
        """Who it was told is there, by name and incarnation."""
        for life in list(self._there):
            self._meet(life, alive=False)
        return tuple(Met(*life, to_seconds(span)) for life, span in sorted(self._met.items()))

    def _meet(self, life: tuple[str, int], alive: bool) -> None:
        """It is told that a life is there, or gone."""
        if alive:
            self._there.setdefault(life, self._now)
        elif (since := self._there.pop(life, None)) is not None:
            self._met[life] = max(self._now - since, self._met.get(life, 0))

    def _compare(self, index: int, made: bytes, record: Recorded) -> None:
        if made == record.data:
            self.same += 1
            return
        topic, seq = record.topic, record.sequence
        problem = f"{topic} {seq} is recorded with other content than it sends"
        try:
            known, again = record.decode(), codec.decode(topic, made)
        except MessageError as error:
            problem = f"{topic} {seq} is recorded with other bytes than it sends, and is no message: {error}"
        else:
            if self._tolerance != EXACT and not any(differences(known, again, self._tolerance)):
                self.near += 1
                return
        self._find(_Finding(index, problem, topic, seq, record.data, made))

    def _twice(self, record: Recorded, index: int) -> None:
        problem = f"{record.topic} {record.sequence} is recorded twice, once with what it does not send"
        self._find(_Finding(index, problem, record.topic, record.sequence))

    def _count(self, step: Step) -> None:
        """Check against how many messages the journal says were sent."""
        self._told |= step.told
        for topic in self._told.keys() | self._sums.keys():
            if not may_be_of(self._life.node, topic):
                continue
            sent, told = len(self._sums.get(topic, ())), self._told.get(topic, 0)
            if sent != told and not self._miscounted:
                self._miscounted = True
                problem = f"it sends {sent} messages on {topic}, its journal says {told}"
                self._find(_Finding(step.index, problem, topic))

    def _find(self, finding: _Finding) -> None:
        self.differing += 1
        if self.first is None or finding.call < self.first.call:
            self.first = finding


class _Again:
    """One life of a node that is run again, some steps at a time."""

    def __init__(self, tape: Tape, life: Life, node: Node, tolerance: Tolerance) -> None:
        self._life = life
        self._matcher = _Matcher(life, tolerance)
        self._inputs = Inputs(tape, life, node.subscriptions, self._matcher.recorded)
        self._steps = reexecute(life, node, self._inputs)
        self._reason = life.broken

    def run(self, until: Time) -> Time | None:
        """Go on up to what was journaled `until` then; returns when the next journal was, None at the end."""
        try:
            for step in self._steps:
                self._matcher.step(step)
                if step.recorded_ns > until:
                    return step.recorded_ns
        except LackingError as error:
            self._reason = f"call {error.index}: {error}"
        self._inputs.close()
        return None

    def proof(self, recording: Recording, tolerance: Tolerance, trace: int) -> Proof:
        """What came of it, after all of the recording has been read."""
        life, matcher, reason = self._life, self._matcher, self._reason
        unproved, tail, unrecorded = matcher.close(reason)
        if not reason and tail > longest_tail(life):
            reason = f"its journal ends {to_seconds(tail):.2f} s before its last message"
        verdict: Verdict = "within tolerance" if matcher.near else "identical"
        if matcher.first is not None:
            verdict = "diverges"
        elif reason:
            verdict = "unproved"
        return Proof(
            node=life.node,
            incarnation=life.incarnation,
            verdict=verdict,
            ended=life.ended,
            calls=matcher.calls,
            messages=matcher.same,
            near=matcher.near,
            differing=matcher.differing,
            unproved=unproved,
            unproved_s=to_seconds(tail),
            unrecorded=unrecorded,
            altered=matcher.altered,
            scenario=_scenario_of(life),
            met=matcher.met(),
            reason=reason,
            divergence=matcher.first and _divergence(recording, life, matcher.first, tolerance, trace),
        )


def _scenario_of(life: Life) -> str:
    """The digest of the scenario that a life ran, as its start says."""
    try:
        call = next((call for call, _ in life.calls()), None)
    except MessageError:
        return ""
    return call.name if call is not None and call.kind == "start" else ""


def _divergence(
    recording: Recording, life: Life, finding: _Finding, tolerance: Tolerance, trace: int
) -> Divergence:
    """All that is to be told of a finding."""
    began = next(life.calls())[0].now_ns
    first = max(finding.call - trace, 0)
    told = list(islice(life.calls(), first, finding.call + 1))
    calls = list(enumerate((call for call, _ in told), first))
    last, journaled_ns = told[-1]
    field, recorded, recomputed, fields = _values(finding, tolerance)
    return Divergence(
        life.node,
        life.incarnation,
        finding.call,
        last.kind,
        last.name,
        last.now_ns,
        to_seconds(last.now_ns - began),
        journaled_ns,
        finding.problem,
        finding.topic,
        finding.seq,
        field,
        recorded,
        recomputed,
        fields,
        _traced(recording, calls),
    )


def _values(finding: _Finding, tolerance: Tolerance) -> tuple[str, Any, Any, int]:
    """The first value that differs: where it is, as recorded and as made again, and how many do."""
    if not finding.made:
        return "", None, None, 0
    try:
        known, again = (codec.decode(finding.topic, data) for data in (finding.recorded, finding.made))
    except MessageError:
        return *_byte(finding.recorded, finding.made), 0
    found = list(differences(known, again, tolerance))
    if not found:
        return *_byte(finding.recorded, finding.made), 0
    return *found[0], len(found)


def _byte(recorded: bytes, made: bytes) -> tuple[str, Any, Any]:
    """Where two messages differ in no field: one is no message, the name of a field that has its default was
    changed, or there are fields that this version does not know."""
    if len(recorded) != len(made):
        return "length in bytes", len(recorded), len(made)
    place = next(place for place, (a, b) in enumerate(zip(recorded, made, strict=True)) if a != b)
    return f"byte {place} of {len(made)}", recorded[place], made[place]


def _traced(recording: Recording, calls: Sequence[tuple[int, Call]]) -> tuple[Input, ...]:
    """Calls with what was in their messages."""
    wanted = {
        (call.name, call.source, call.incarnation, call.seq): call.crc32
        for _, call in calls
        if call.kind == "message" and call.data is None
    }
    names = {name for name, *_ in wanted}
    found: dict[tuple[str, str, int, int], bytes] = {}
    if wanted:
        for record in recording.messages(names.__contains__):
            try:
                header = header_of(record.topic, record.data)
            except MessageError:
                continue
            key = record.topic, header.source, header.incarnation, header.seq
            if wanted.get(key) == zlib.crc32(record.data):
                found[key] = record.data
                if len(found) == len(wanted):
                    break
    traced = []
    for index, call in calls:
        key = call.name, call.source, call.incarnation, call.seq
        data = found.get(key) if call.data is None else call.data
        traced.append(Input(index, call.now_ns, call.kind, *key, data and _content(call.name, data)))
    return tuple(traced)


_HEADER = frozenset(Message.__struct_fields__)


def _content(topic: str, data: bytes) -> Any:
    """A message as JSON has it, without its header, float arrays as lists; None where it is no message."""
    try:
        message = codec.decode(topic, data)
    except MessageError:
        return None
    arrays = codec.float_arrays(type(message))
    return {
        name: unpack_floats(value).tolist() if name in arrays else msgspec.to_builtins(value)
        for name in message.__struct_fields__
        if name not in _HEADER and (value := getattr(message, name)) is not None
    }


def longest_tail(life: Life) -> Duration:
    """How long a killed node may have gone on after its last journal, by its clock. Where that goes faster,
    the steps from journal to journal are greater."""
    stamps = [record.publish_time_ns for record in life.journals]
    steps = [after - before for before, after in pairwise(stamps)]
    return round(LONGEST_TAIL * max(median(steps) / FLUSH_PERIOD if steps else 1.0, 1.0))


def _owner(topic: str) -> tuple[tuple[str, ...], bool, bool]:
    """Who alone may send on a topic, whether it is hosts that do, and whether it is a journal."""
    try:
        owners, kind = topics.senders_of(topic), topics.topic(topic).type.__name__
    except MessageError:
        return (), False, False
    return owners, not may_be_of(owners[0] if owners else "", topic), kind == "Journal"
