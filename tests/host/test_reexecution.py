from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.node import Outgoing
from maniple.core.scenario.types import ClockError, Crash, Fault, Freeze
from maniple.core.time import SECOND, Time
from maniple.host.reexecution import Inputs, LackingError, Life, Step, Tape, lives, reexecute
from maniple.recording.reader import Recorded, read
from tests.host.nodes import Answerer
from tests.host.recorded import flipped, makers, record_run, rewrite, without

FAULTS = (Fault(loss=0.2, latency_s=0.05, jitter_s=0.05, duplicate=0.2, reorder=0.2, corrupt=0.2),)


def steps_of(path: Path, name: str, incarnation: int = 1) -> list[Step]:
    """A life that is run again, to its end."""
    recording = read(path)
    life = next(one for one in lives(recording, [name]) if one.incarnation == incarnation)
    node = makers()[name](incarnation)
    return list(reexecute(life, node, Inputs(recording, life, node.subscriptions)))


def recorded_of(path: Path, name: str, incarnation: int = 1) -> dict[tuple[str, int], bytes]:
    """What a life said, as it is recorded; without what its host said."""
    return {
        (record.topic, record.sequence): record.data
        for record in read(path).messages()
        if record.topic.split("/")[0] not in ("journal", "links", "faults")
        and codec.decode(record.topic, record.data).source == name
        and codec.decode(record.topic, record.data).incarnation == incarnation
    }


def made_by(steps: Sequence[Step]) -> dict[tuple[str, int], bytes]:
    return {(one.topic, one.seq): one.data for step in steps for one in step.sent}


@pytest.mark.parametrize("name", makers())
def test_a_life_sends_the_same_bytes_again(tmp_path: Path, name: str) -> None:
    path = record_run(tmp_path / "a.mcap", faults=FAULTS)
    steps = steps_of(path, name)
    assert made_by(steps) == recorded_of(path, name)
    assert len(made_by(steps)) > 20
    assert [step.index for step in steps] == list(range(len(steps)))
    assert steps[0].call.kind == "start"
    assert steps[-1].call.kind == "stop"


def test_every_life_is_there(tmp_path: Path) -> None:
    path = record_run(
        tmp_path / "a.mcap",
        crashes=(Crash(node="r1", at_s=1.03, restart_after_s=0.5),),
        freezes=(Freeze(node="r2", at_s=1.0, for_s=0.7),),
        clocks=(ClockError(node="controller", offset_s=-40.0, skew_ppm=200.0),),
        faults=FAULTS,
    )
    found = lives(read(path))
    assert [(life.node, life.incarnation, life.ended, life.broken) for life in found] == [
        ("controller", 1, "stopped", ""),
        ("r1", 1, "cut", ""),
        ("r1", 2, "stopped", ""),
        ("r2", 1, "stopped", ""),
    ]
    for life in found:
        made = made_by(steps_of(path, life.node, life.incarnation))
        assert made.items() <= recorded_of(path, life.node, life.incarnation).items()
    tail = recorded_of(path, "r1").keys() - made_by(steps_of(path, "r1")).keys()
    assert len(tail) <= 2  # what it said in its last 0.2 s, ten times a second


def test_the_journal_says_how_many_were_sent(tmp_path: Path) -> None:
    path = record_run(tmp_path / "a.mcap", duration_s=1)
    told: dict[str, int] = {}
    made = 0
    for step in steps_of(path, "r1"):
        made += len(step.sent)
        told |= step.told
        assert not step.told or told["robot/r1/odometry"] == made
    assert told["robot/r1/odometry"] == made


def test_an_input_that_is_not_recorded(tmp_path: Path) -> None:
    path = rewrite(
        record_run(tmp_path / "a.mcap"), tmp_path / "b.mcap", without("robot/r1/odometry", 4, 5, 6)
    )
    with pytest.raises(LackingError) as caught:
        steps_of(path, "controller")
    assert str(caught.value) == "the recording lacks robot/r1/odometry 4 of r1 (life 1)"
    assert caught.value.call is not None
    assert (caught.value.call.name, caught.value.call.seq) == ("robot/r1/odometry", 4)


def test_an_input_that_is_not_what_the_node_got(tmp_path: Path) -> None:
    path = rewrite(record_run(tmp_path / "a.mcap"), tmp_path / "b.mcap", flipped("robot/r1/odometry", 4))
    with pytest.raises(
        LackingError, match=r"robot/r1/odometry 4 of r1 \(life 1\) is not recorded as controller got it"
    ):
        steps_of(path, "controller")


def test_an_input_may_be_recorded_long_after_and_twice(tmp_path: Path) -> None:
    """The right one is told by its checksum."""
    path = record_run(tmp_path / "a.mcap", duration_s=8)

    def change(record: Recorded) -> Sequence[Recorded]:
        if (record.topic, record.sequence) != ("robot/r1/odometry", 4):
            return (record,)
        late = record._replace(log_time_ns=record.log_time_ns + 7 * SECOND)
        return *flipped(record.topic, 4)(record), late

    changed = rewrite(path, tmp_path / "b.mcap", change)
    assert made_by(steps_of(changed, "controller")) == recorded_of(path, "controller")


def test_a_missing_journal_ends_what_can_be_run(tmp_path: Path) -> None:
    path = rewrite(record_run(tmp_path / "a.mcap"), tmp_path / "b.mcap", without("journal/r1", 3, 4))
    (life,) = lives(read(path), ["r1"])
    assert (life.begun, life.broken, len(life.journals)) == (True, "the recording lacks journal/r1 3-4", 3)
    begin = rewrite(tmp_path / "a.mcap", tmp_path / "c.mcap", without("journal/r1", 0))
    (life,) = lives(read(begin), ["r1"])
    assert (life.begun, life.broken) == (False, "the recording lacks journal/r1 0")


def test_a_journal_that_can_not_be_read(tmp_path: Path) -> None:
    def change(record: Recorded) -> Sequence[Recorded]:
        if (record.topic, record.sequence) != ("journal/r1", 2):
            return (record,)
        fields = msgspec.msgpack.decode(record.data)
        return (record._replace(data=msgspec.msgpack.encode(fields | {"calls": 5})),)

    path = rewrite(record_run(tmp_path / "a.mcap"), tmp_path / "b.mcap", change)
    with pytest.raises(LackingError, match=r"journal/r1 2 can't be read: .*Expected `array`"):
        steps_of(path, "r1")


def test_two_journals_of_one_number(tmp_path: Path) -> None:
    def change(record: Recorded) -> Sequence[Recorded]:
        return (record, *flipped("journal/r1", 2)(record))

    path = rewrite(record_run(tmp_path / "a.mcap"), tmp_path / "b.mcap", change)
    (life,) = lives(read(path), ["r1"])
    assert life.broken == "journal/r1 2 is there 2 times, with different content"


class Fragile(Answerer):
    """Fails at the tenth message."""

    def __init__(self) -> None:
        super().__init__(("r1",))
        self.count = 0

    def on_message(self, message: object, now: Time) -> Sequence[Outgoing]:
        self.count += 1
        if self.count == 10:
            raise ValueError("too many")
        return super().on_message(message, now)  # type: ignore[arg-type]


def test_a_node_that_fails_goes_on_to_its_stop(tmp_path: Path) -> None:
    path = record_run(tmp_path / "a.mcap")
    recording = read(path)
    (life,) = lives(recording, ["controller"])
    node = Fragile()
    (failed,) = (
        step
        for step in reexecute(life, node, Inputs(recording, life, node.subscriptions | {"robot/r2/odometry"}))
        if step.raised
    )
    assert (failed.raised, failed.sent) == ("ValueError: too many", ())


def test_little_of_the_recording_is_kept(tmp_path: Path) -> None:
    """What the node will never take any more is dropped."""
    path = record_run(tmp_path / "a.mcap", duration_s=20)
    recording = read(path)
    (life,) = lives(recording, ["controller"])
    inputs = Inputs(recording, life, Answerer(("r1", "r2")).subscriptions)
    most = 0
    for _ in reexecute(life, Answerer(("r1", "r2")), inputs):
        most = max(most, inputs.waiting)
    assert most < 20


def test_calls_are_in_order(tmp_path: Path) -> None:
    (life,) = lives(read(record_run(tmp_path / "a.mcap")), ["r1"])
    assert isinstance(life, Life)
    times = [(call.now_ns, recorded) for call, recorded in life.calls()]
    assert times == sorted(times)
    assert all(0 < recorded - now < SECOND for now, recorded in times)


def test_a_host_made_message_comes_from_the_journal(tmp_path: Path) -> None:
    steps = steps_of(record_run(tmp_path / "a.mcap"), "r1")
    told = [step.call for step in steps if step.call.name == topics.HOST_ALIVE]
    assert told
    assert all(call.data is not None for call in told)


def test_a_tape_is_read_once_for_all(tmp_path: Path) -> None:
    recording = read(record_run(tmp_path / "a.mcap", faults=FAULTS))
    tape = Tape(recording)
    steps = []
    for life in lives(recording):
        node = makers()[life.node](1)
        steps.append(reexecute(life, node, Inputs(tape, life, node.subscriptions)))
    together = [list(map(made_by, zip(one, strict=True))) for one in steps]
    alone = [
        [made_by([step]) for step in steps_of(tmp_path / "a.mcap", life.node)] for life in lives(recording)
    ]
    assert together == alone
    assert not tape.read() or tape.position > 0
