"""Runs a node again from a recording: its journal says what it was called with, the messages are there.

What it sends is numbered and encoded by the code that did so in the run. No I/O but reading the recording.
"""

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Literal

import msgspec

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, Header, header_of
from maniple.core.errors import MessageError, RecordingError
from maniple.core.messages import Call, Decisions, Journal, LinkReports
from maniple.core.node import Node, Outgoing, Received
from maniple.core.time import SECOND, Duration, Time
from maniple.host.stamper import Stamper
from maniple.recording.reader import Recorded, Recording

LATE: Duration = 2 * SECOND
"""An input is looked for in what was recorded up to so long after the journal that names it, and then
everywhere."""

HISTORY: Duration = 10 * SECOND
"""Of what was recorded longer before a life began, only the last of each sender and topic is at hand."""

_HOSTS = (Journal, Decisions, LinkReports)

See = Callable[[Recorded, Header], None]
"""Is shown a recorded message."""


class Life(msgspec.Struct, frozen=True):
    """One life of a node, as its journal tells it."""

    node: str
    incarnation: int
    journals: tuple[Recorded, ...]
    """Those that follow each other from the first on: all that can be run again."""
    ended: Literal["stopped", "cut"]
    """Whether the journal goes up to the node's stop; "cut" where the process was killed, or the recording
    ends before."""
    broken: str = ""
    """Why the journal can't be followed to its end; empty where it can."""

    @property
    def begun(self) -> bool:
        """Whether its beginning is there; nothing can be run again without."""
        return bool(self.journals)

    def calls(self) -> Iterator[tuple[Call, Time]]:
        """The calls into the node that can be made again, in order, each with when it was recorded.

        Raises:
            MessageError: a journal can't be decoded.
        """
        for record in self.journals:
            for call in _journal_in(record).calls:
                yield call, record.log_time_ns


class Step(msgspec.Struct, frozen=True, gc=False):
    """One call into a node that was run again."""

    index: int
    """Of the call within its life, from 0."""
    call: Call
    recorded_ns: Time
    """Log time of the journal it is in."""
    sent: tuple[Envelope, ...]
    """What it sent, as it would be on the wire."""
    told: Mapping[str, int]
    """After the last call of a journal: how many messages the life had sent by then, by that journal. Topics
    that are not there are as they were; those of its host are among them."""
    raised: str = ""
    """What went wrong in the node, where it failed. It sent nothing then."""


class LackingError(RecordingError):
    """What follows of a life can't be run again: an input is not in the recording, or other than it was."""

    def __init__(self, index: int, call: Call | None, why: str) -> None:
        super().__init__(why)
        self.index = index
        """Of the call that could not be made."""
        self.call = call
        """None where the journal itself can't be read."""


class Tape:
    """Reads a recording once, for all who want to see something of it."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.position: Time = -1
        """Log time of the last message that was read."""
        self._wants: list[tuple[Callable[[str], bool], See]] = []
        self._by_topic: dict[str, tuple[See, ...]] = {}
        self._records = recording.messages(lambda topic: bool(self._who_sees(topic)))

    def show(self, wants: Callable[[str], bool], see: See) -> None:
        """Show the messages of the topics that somebody `wants`, from the next one on, that have a header."""
        self._wants.append((wants, see))
        self._by_topic.clear()

    def read(self) -> bool:
        """Read one more message; False at the end.

        Raises:
            RecordingError: the recording is damaged.
        """
        record = next(self._records, None)
        if record is None:
            self.position = 2**63
            return False
        self.position = record.log_time_ns
        try:
            header = header_of(record.topic, record.data)
        except MessageError:
            return True
        for see in self._by_topic.get(record.topic) or self._who_sees(record.topic):
            see(record, header)
        return True

    def _who_sees(self, topic: str) -> tuple[See, ...]:
        found = self._by_topic[topic] = tuple(see for wants, see in self._wants if wants(topic))
        return found


class Inputs:
    """What one life of a node was sent, read from the recording as it is needed, or from a tape that is read
    for several lives.

    Only what the node may still be given is kept: of each sender and topic it never takes an older message.
    `own` is shown what was recorded under the node's own name, in the order of the recording.
    """

    def __init__(
        self,
        source: Recording | Tape,
        life: Life,
        subscriptions: Collection[str],
        own: See | None = None,
    ) -> None:
        self._tape = source if isinstance(source, Tape) else Tape(source)
        self._life = life
        self._subscriptions = subscriptions
        self._waiting: dict[tuple[str, str], dict[tuple[int, int], tuple[bytes, ...]]] = {}
        began = life.journals[0].log_time_ns if life.journals else 0
        self._from: Time = began - HISTORY
        self._closed = False
        self._tape.show(subscriptions.__contains__, self._keep)
        if own is not None:
            self._own = own
            self._tape.show(lambda topic: may_be_of(life.node, topic), self._show_own)

    def take(self, call: Call, journaled: Time) -> bytes:
        """The bytes of the message in a call, whose journal was recorded at the time `journaled`.

        Raises:
            RecordingError: they are not in the recording, or it is damaged.
        """
        if call.data is not None:
            return call.data
        mark = call.incarnation, call.seq
        key = call.name, call.source
        stream = self._waiting.get(key)
        if stream is None:
            stream = self._waiting[key] = {}
        until = journaled + LATE
        tape = self._tape
        while mark not in stream and tape.position <= until:
            if not tape.read():
                break
        for data in stream.get(mark, ()):
            if zlib.crc32(data) == call.crc32:
                _forget(stream, mark)
                return data
        return self._search(call)

    @property
    def waiting(self) -> int:
        """How many messages are kept for the node."""
        return sum(map(len, self._waiting.values()))

    def drain(self) -> None:
        """Read to the end of the recording, for what `own` is to see.

        Raises:
            RecordingError: it is damaged.
        """
        self.close()
        while self._tape.read():
            pass

    def close(self) -> None:
        """Keep nothing more: the node has been given all."""
        self._closed = True
        self._waiting.clear()

    def _keep(self, record: Recorded, header: Header) -> None:
        """A message of a topic that the node has subscribed to."""
        if self._closed:
            return
        key = record.topic, header.source
        stream = self._waiting.get(key)
        if stream is None:
            stream = self._waiting[key] = {}
        elif record.log_time_ns < self._from:
            stream.clear()
        mark = header.incarnation, header.seq
        known = stream.get(mark)
        if known is None:
            stream[mark] = (record.data,)
        elif record.data not in known:
            stream[mark] = (*known, record.data)

    def _show_own(self, record: Recorded, header: Header) -> None:
        if header.source == self._life.node:
            self._own(record, header)

    def _search(self, call: Call) -> bytes:
        """Look for a message in all of the recording."""
        found = set[int]()
        for record in self._tape.recording.messages(lambda topic: topic == call.name):
            try:
                header = header_of(record.topic, record.data)
            except MessageError:
                continue
            if (header.source, header.incarnation, header.seq) == (call.source, call.incarnation, call.seq):
                if (crc32 := zlib.crc32(record.data)) == call.crc32:
                    return record.data
                found.add(crc32)
        which = f"{call.name} {call.seq} of {call.source} (life {call.incarnation})"
        if not found:
            raise RecordingError(f"the recording lacks {which}")
        crcs = ", ".join(f"{crc32:08x}" for crc32 in sorted(found))
        raise RecordingError(
            f"{which} is not recorded as {self._life.node} got it: CRC-32 {crcs} in the recording, "
            f"{call.crc32:08x} in journal/{self._life.node}"
        )


def lives(recording: Recording, nodes: Collection[str] | None = None) -> tuple[Life, ...]:
    """All lives of all nodes, or of some, that have left a journal, by name and incarnation.

    Raises:
        RecordingError: the recording is damaged.
    """
    found: dict[tuple[str, int], dict[int, list[Recorded]]] = {}
    for record in recording.messages(lambda topic: _is_journal(topic, nodes)):
        name = record.topic.partition("/")[2]
        try:
            header = header_of(record.topic, record.data)
        except MessageError:
            continue
        if header.source == name:
            same = found.setdefault((name, header.incarnation), {}).setdefault(header.seq, [])
            if all(record.data != other.data for other in same):
                same.append(record)
    return tuple(_life(*key, journals) for key, journals in sorted(found.items()))


def reexecute(life: Life, node: Node, inputs: Inputs) -> Iterator[Step]:
    """Call a fresh `node` as that life of it was called, step by step.

    A node that fails where the run's node did (its next call is its stop) goes on with that stop, as there.

    Raises:
        LackingError: an input can't be had; what follows can't be run again.
        RecordingError: the recording is damaged.
    """
    stamper = Stamper(life.node, life.incarnation)
    index = 0
    for record in life.journals:
        try:
            journal = _journal_in(record)
        except MessageError as error:
            why = f"{record.topic} {record.sequence} can't be read: {error}"
            raise LackingError(index, None, why) from None
        last = len(journal.calls) - 1
        for place, call in enumerate(journal.calls):
            received = _received(call, index, inputs, record.log_time_ns) if call.kind == "message" else None
            raised, sent = "", tuple[Envelope, ...]()
            try:
                outgoing = _call(node, call, received)
                sent = tuple(stamper.stamp(topic, said, call.now_ns) for topic, said in outgoing)
            except Exception as error:  # noqa: BLE001 - what a node does is what is looked at
                raised = f"{type(error).__name__}: {error}"
            yield Step(index, call, record.log_time_ns, sent, journal.sent if place == last else {}, raised)
            index += 1


def may_be_of(node: str, topic: str) -> bool:
    """Whether messages of a topic may be what a node itself says: not its host."""
    try:
        return topics.may_send(topic, node) and topics.topic(topic).type not in _HOSTS
    except MessageError:
        return False


def _received(call: Call, index: int, inputs: Inputs, journaled: Time) -> Received:
    """The message of a call as the node got it."""
    try:
        return Received(call.name, codec.decoder(call.name)(inputs.take(call, journaled)))
    except RecordingError as error:
        raise LackingError(index, call, str(error)) from None
    except MessageError as error:
        which = f"{call.name} {call.seq} of {call.source} (life {call.incarnation})"
        raise LackingError(index, call, f"{which} can't be read by this version: {error}") from None


def _call(node: Node, call: Call, received: Received | None) -> Sequence[Outgoing]:
    if received is not None:
        return node.on_message(received, call.now_ns)
    if call.kind == "timer":
        return node.on_timer(call.name, call.now_ns)
    return node.on_start(call.now_ns) if call.kind == "start" else node.on_stop(call.now_ns)


def _life(node: str, incarnation: int, journals: Mapping[int, Sequence[Recorded]]) -> Life:
    """A life from its journals by their numbers, each as often as it is there with other bytes."""
    length = 0
    while len(journals.get(length, ())) == 1:
        length += 1
    whole = tuple(journals[seq][0] for seq in range(length))
    topic = topics.journal(node)
    broken = ""
    if length in journals:
        broken = f"{topic} {length} is there {len(journals[length])} times, with different content"
    elif length < len(journals):
        following = min(seq for seq in journals if seq > length)
        numbers = str(length) if following == length + 1 else f"{length}-{following - 1}"
        broken = f"the recording lacks {topic} {numbers}"
    return Life(node, incarnation, whole, "stopped" if _is_stopped(journals) else "cut", broken)


def _is_stopped(journals: Mapping[int, Sequence[Recorded]]) -> bool:
    """Whether the last journal has the node's stop."""
    try:
        calls = _journal_in(journals[max(journals)][-1]).calls
    except MessageError:
        return False
    return bool(calls) and calls[-1].kind == "stop"


def _journal_in(record: Recorded) -> Journal:
    journal = record.decode()
    assert isinstance(journal, Journal), "its topic says so"
    return journal


def _is_journal(topic: str, nodes: Collection[str] | None) -> bool:
    try:
        is_journal = topics.topic(topic).type is Journal
    except MessageError:
        return False
    return is_journal and (nodes is None or topic.partition("/")[2] in nodes)


def _forget(stream: dict[tuple[int, int], tuple[bytes, ...]], mark: tuple[int, int]) -> None:
    """Drop what the node will not take any more: up to `mark`, as far as it is in front."""
    while stream and (first := next(iter(stream))) <= mark:
        del stream[first]
