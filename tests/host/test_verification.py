from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from maniple.core import codec, topics
from maniple.core.envelope import header_of
from maniple.core.messages import Alive, EmergencyStop, Journal, Odometry
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import ClockError, Crash, Fault, Freeze, Partition
from maniple.core.time import SECOND, VIRTUAL_EPOCH, Time
from maniple.host.reexecution import lives, may_be_of
from maniple.host.runner import NodeRunner
from maniple.host.verification import (
    LONGEST_TAIL,
    Census,
    Divergence,
    Proof,
    census,
    longest_tail,
    problems_of,
    prove,
)
from maniple.host.virtual import Factory
from maniple.recording.compare import EXACT, Tolerance
from maniple.recording.reader import Recorded, read
from tests.host.nodes import Reporter, odometry, scenario_with
from tests.host.recorded import ROBOTS, flipped, makers, record_run, rewrite, without, writer

FAULTS = (Fault(loss=0.2, latency_s=0.05, jitter_s=0.05, duplicate=0.2, reorder=0.2, corrupt=0.2),)

Change = Callable[[Recorded], Iterable[Recorded]]


def proved(
    path: Path, factories: Mapping[str, Factory] | None = None, tolerance: Tolerance = EXACT
) -> dict[tuple[str, int], Proof]:
    """What comes of every life."""
    makes = factories or makers()
    found = prove(read(path), makes, tolerance)
    return {(proof.node, proof.incarnation): proof for proof in found}


def problems(path: Path) -> list[str]:
    return problems_of(census(read(path)), list(proved(path).values()), makers())


def divergence(proof: Proof) -> Divergence:
    assert proof.verdict == "diverges"
    assert not proof.holds
    assert proof.divergence is not None
    return proof.divergence


class Drifted(Reporter):
    """Says that it is a little further."""

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        (said,) = super().on_timer(timer, now)
        assert isinstance(said.message, Odometry)
        if len(self.heard) < 10:
            return (said,)
        return (
            Outgoing(said.topic, msgspec.structs.replace(said.message, x_m=said.message.x_m * (1 + 1e-9))),
        )


def with_r1(make: Factory) -> Mapping[str, Factory]:
    return {**makers(), "r1": make}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With losses, late and double messages and flipped bits; all stopped in order."""
    return record_run(tmp_path_factory.mktemp("run") / "a.mcap", faults=FAULTS)


def changed(run: Path, folder: Path, change: Change) -> Path:
    return rewrite(run, folder / "b.mcap", change)


def test_an_honest_recording_is_identical(run: Path) -> None:
    found = proved(run)
    assert set(found) == {("controller", 1), ("r1", 1), ("r2", 1)}
    for proof in found.values():
        assert (proof.verdict, proof.ended, proof.reason) == ("identical", "stopped", "")
        assert (proof.differing, proof.unproved, proof.unrecorded, proof.near) == (0, 0, 0, 0)
        assert proof.holds
    said = [
        record for record in read(run).messages() if any(may_be_of(name, record.topic) for name in makers())
    ]
    assert sum(proof.messages for proof in found.values()) == len(said)
    assert problems(run) == []


def test_with_all_that_may_happen(tmp_path: Path) -> None:
    """The killed lives' last 0.2 s are unproved, and nothing else."""
    path = record_run(
        tmp_path / "a.mcap",
        duration_s=6,
        crashes=(
            Crash(node="r1", at_s=1.03, restart_after_s=0.5),
            Crash(node="controller", at_s=2.55, restart_after_s=0.3),
        ),
        freezes=(Freeze(node="r2", at_s=3.0, for_s=1.7),),
        partitions=(Partition(groups=(("r1",), ("controller",)), at_s=4.0, for_s=1.0),),
        clocks=(
            ClockError(node="controller", offset_s=-40.0, skew_ppm=200.0),
            ClockError(node="r2", offset_s=1e5),
        ),
        faults=FAULTS,
    )
    found = proved(path)
    assert set(found) == {("controller", 1), ("controller", 2), ("r1", 1), ("r1", 2), ("r2", 1)}
    assert all(proof.holds for proof in found.values())
    assert [key for key, proof in found.items() if proof.ended == "cut"] == [("controller", 1), ("r1", 1)]
    assert all(proof.unproved_s <= 0.2 for proof in found.values())
    assert sum(proof.unproved for proof in found.values()) > 0
    assert problems(path) == []


def test_a_flipped_bit_is_found_where_it_was_sent(run: Path, tmp_path: Path) -> None:
    path = changed(run, tmp_path, flipped("robot/r1/odometry", 7, len_before_x()))
    found = proved(path)
    first = divergence(found["r1", 1])
    assert (first.node, first.incarnation, first.topic, first.seq) == ("r1", 1, "robot/r1/odometry", 7)
    assert (first.field, first.fields) == ("x_m", 1)
    assert first.recorded != first.recomputed
    assert (first.kind, first.name) == ("timer", "report")
    assert 0.7 < first.life_s < 0.9
    assert found["r1", 1].differing == 1
    assert found["r2", 1].holds


def len_before_x() -> int:
    """Place of the last byte of x_m in an odometry, from the end."""
    message = msgspec.structs.replace(odometry("r1"), source="r1", incarnation=1, seq=7, stamp_ns=10**18)
    data = codec.encode(message)
    return data.index(b"y_m") - 2 - len(data)


def test_a_receiver_that_got_other_bytes(tmp_path: Path) -> None:
    path = record_run(tmp_path / "a.mcap")
    found = proved(changed(path, tmp_path, flipped("robot/r1/odometry", 7, len_before_x())))
    proof = found["controller", 1]
    assert (proof.verdict, proof.holds, proof.divergence) == ("unproved", False, None)
    assert "robot/r1/odometry 7 of r1 (life 1) is not recorded as controller got it: CRC-32" in proof.reason
    assert proof.unproved > 10
    assert proof.messages > 10


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    """Of all that nodes say, wherever it is."""
    path = record_run(tmp_path / "a.mcap", duration_s=1)
    said = [
        (record.topic, record.sequence, len(record.data))
        for record in read(path).messages()
        if any(may_be_of(name, record.topic) for name in makers())
    ]
    random = np.random.default_rng(4)
    for number in range(60):
        topic, seq, length = said[random.integers(len(said))]
        place = int(random.integers(length))
        altered = rewrite(path, tmp_path / f"{number}.mcap", flipped(topic, seq, place))
        found = proved(altered)
        assert problems(altered) or not all(one.holds for one in found.values()), (topic, seq, place)


def test_another_parameter_is_found_where_it_acted(run: Path) -> None:
    """And its trace ends with the call."""
    found = proved(run, with_r1(lambda _: Drifted("r1")))
    proof = found["r1", 1]
    first = divergence(proof)
    assert (first.topic, first.field) == ("robot/r1/odometry", "x_m")
    assert first.recorded >= 10.0
    assert first.recomputed == first.recorded * (1 + 1e-9)
    assert proof.differing > 10
    assert proof.messages == first.seq + 1  # at its stop it says something else
    assert len(first.trace) == 11
    assert [one.call for one in first.trace] == list(range(first.call - 10, first.call + 1))
    assert (first.trace[-1].kind, first.trace[-1].now_ns) == ("timer", first.now_ns)
    command = next(one for one in first.trace if one.name == "robot/r1/command")
    assert command.message["layer"] == "drive"
    assert found["r2", 1].holds


def test_what_differs_by_less_than_the_tolerance(run: Path) -> None:
    drifted = with_r1(lambda _: Drifted("r1"))
    for tolerance in (Tolerance(1e-8), Tolerance(0.0, (("Odometry.x_m", 1e-8),))):
        proof = proved(run, drifted, tolerance)["r1", 1]
        assert (proof.verdict, proof.differing) == ("within tolerance", 0)
        assert proof.near > 10
        assert proof.holds
    assert proved(run, drifted, Tolerance(1e-10))["r1", 1].verdict == "diverges"
    assert proved(run, drifted, Tolerance(1.0, (("x_m", 0.0),)))["r1", 1].verdict == "diverges"


def test_what_the_recorder_lost_is_counted(run: Path, tmp_path: Path) -> None:
    path = changed(run, tmp_path, without("robot/r1/command"))
    found = proved(path)
    assert found["controller", 1].holds
    assert found["controller", 1].unrecorded > 10
    assert found["r1", 1].verdict == "unproved"
    assert "the recording lacks robot/r1/command 0 of controller (life 1)" in found["r1", 1].reason


def test_what_a_node_did_not_send(run: Path, tmp_path: Path) -> None:
    """Under a number of its own that was not used; under one that was; and under one of another life."""

    def forge(number: int, seq: int, life: int = 1) -> Change:
        fake = odometry("r1", x_m=-5.0, source="r1", incarnation=life, seq=seq, stamp_ns=10**18)

        def change(record: Recorded) -> Iterable[Recorded]:
            yield record
            if (record.topic, record.sequence) == ("robot/r1/odometry", number):
                yield record._replace(data=codec.encode(fake), sequence=seq, publish_time_ns=10**18)

        return change

    first = divergence(proved(changed(run, tmp_path, forge(3, 999)))["r1", 1])
    assert first.problem == "robot/r1/odometry 999 is recorded, but it does not send it"
    before, after = (
        divergence(proved(rewrite(run, tmp_path / f"c{number}.mcap", forge(number, 5)))["r1", 1])
        for number in (1, 9)
    )
    assert before.problem == "robot/r1/odometry 5 is recorded with other content than it sends"
    assert after.problem == "robot/r1/odometry 5 is recorded twice, once with what it does not send"
    path = rewrite(run, tmp_path / "d.mcap", forge(3, 0, life=2))
    assert proved(path)["r1", 1].holds
    assert problems(path) == [
        "r1 (life 2): it has no journal, and its messages (1) were not said after those of life 1: "
        "it never was"
    ]


@pytest.mark.parametrize("life", [0, 2])
def test_a_life_that_never_was(run: Path, tmp_path: Path, life: int) -> None:
    """A message under another life's name, and one of a life that was killed at once."""

    def change(record: Recorded) -> Iterable[Recorded]:
        if (record.topic, record.sequence) == ("robot/r1/odometry", 7):
            said = msgspec.structs.replace(record.decode(), incarnation=life)
            record = record._replace(data=codec.encode(said))
        yield record

    order = "after" if life else "before"
    assert problems(changed(run, tmp_path, change)) == [
        f"r1 (life {life}): it has no journal, and its messages (1) were not said {order} those of "
        "life 1: it never was"
    ]


def test_a_life_that_was_killed_at_once(run: Path, tmp_path: Path) -> None:
    last = [record for record in read(run).messages() if record.topic == "journal/r1"][-1]

    def change(record: Recorded) -> Iterable[Recorded]:
        yield record
        if (record.topic, record.sequence) == (last.topic, last.sequence):
            stamp = record.publish_time_ns + SECOND
            said = odometry("r1", source="r1", incarnation=2, seq=0, stamp_ns=stamp)
            yield Recorded("robot/r1/odometry", codec.encode(said), record.log_time_ns, stamp, 0)

    assert problems(changed(run, tmp_path, change)) == []


def test_a_killed_life_has_said_nothing_more_before_its_last_call(tmp_path: Path) -> None:
    path = record_run(tmp_path / "a.mcap", crashes=(Crash(node="r1", at_s=2.15),))

    def forge(later: bool) -> Change:
        def change(record: Recorded) -> Iterable[Recorded]:
            yield record
            if (record.topic, record.sequence) == ("journal/r1", 9):
                stamp = record.publish_time_ns + (SECOND // 10 if later else -SECOND)
                said = odometry("r1", source="r1", incarnation=1, seq=500, stamp_ns=stamp)
                yield Recorded("robot/r1/odometry", codec.encode(said), record.log_time_ns, stamp, 500)

        return change

    was = proved(path)["r1", 1]
    tail = proved(rewrite(path, tmp_path / "b.mcap", forge(later=True)))["r1", 1]
    assert (tail.verdict, tail.unproved) == ("identical", was.unproved + 1)
    first = divergence(proved(rewrite(path, tmp_path / "c.mcap", forge(later=False)))["r1", 1])
    assert first.problem == "robot/r1/odometry 500 is recorded, but it does not send it"


def test_a_life_without_any_journal(run: Path, tmp_path: Path) -> None:
    path = changed(run, tmp_path, without("journal/r1"))
    assert ("r1", 1) not in proved(path)
    assert problems(path) == ["r1 (life 1): the recording lacks its journal; 31 messages are unproved"]


def test_a_life_of_which_nothing_is_left(tmp_path: Path) -> None:
    """The others were told that it was there."""
    path = record_run(tmp_path / "a.mcap", crashes=(Crash(node="r1", at_s=0.5, restart_after_s=0.2),))
    assert problems(path) == []

    def change(record: Recorded) -> Iterable[Recorded]:
        header = header_of(record.topic, record.data)
        return () if (header.source, header.incarnation) == ("r1", 2) else (record,)

    gone = rewrite(path, tmp_path / "b.mcap", change)
    found = proved(gone)
    met = {(one.node, one.incarnation): one.span_s for one in found["r2", 1].met}
    assert met["r1", 1] < 1.0 < 2.0 < met["r1", 2]
    said = f"r1 (life 2): the recording lacks all of it; it was there for {met['r1', 2]:.1f} s, as"
    assert problems(gone) == [f"{said} r2 (life 1) was told"]
    assert problems_of(census(read(gone)), list(found.values()), ["r2"]) == []


def test_a_journal_that_goes_back_in_time(run: Path, tmp_path: Path) -> None:
    def change(record: Recorded) -> Iterable[Recorded]:
        message = record.decode()
        if (record.topic, record.sequence) == ("journal/r1", 5):
            assert isinstance(message, Journal)
            first, *others = message.calls
            calls = (msgspec.structs.replace(first, now_ns=first.now_ns - SECOND), *others)
            data = codec.encode(msgspec.structs.replace(message, calls=calls))
            record = record._replace(data=data)
        yield record

    first = divergence(proved(changed(run, tmp_path, change))["r1", 1])
    assert first.problem == "its journal goes back in time"


def test_no_journal_at_all(run: Path, tmp_path: Path) -> None:
    path = changed(run, tmp_path, lambda one: () if one.topic.startswith("journal/") else (one,))
    assert problems(path)[-1] == "the recording lacks the journals of all nodes that were to be run again"


def test_a_journal_with_a_gap(run: Path, tmp_path: Path) -> None:
    found = proved(changed(run, tmp_path, without("journal/r1", 6, 7)))["r1", 1]
    assert (found.verdict, found.reason) == ("unproved", "the recording lacks journal/r1 6-7")
    assert found.messages > 5
    assert found.unproved > 10
    found = proved(rewrite(run, tmp_path / "c.mcap", without("journal/r1", 0)))["r1", 1]
    assert (found.verdict, found.calls, found.messages) == ("unproved", 0, 0)


def test_a_journal_that_ends_long_before_the_node(run: Path, tmp_path: Path) -> None:
    """It was not killed: its journal is missing."""
    last = [record.sequence for record in read(run).messages() if record.topic == "journal/r1"]
    found = proved(changed(run, tmp_path, without("journal/r1", *last[-8:])))["r1", 1]
    assert (found.verdict, found.ended) == ("unproved", "cut")
    assert "its journal ends 1." in found.reason
    found = proved(rewrite(run, tmp_path / "c.mcap", without("journal/r1", last[-1])))["r1", 1]
    assert (found.verdict, found.ended, found.unproved) == ("identical", "cut", 1)


class Chatty(Reporter):
    """Says the same once more at its stop."""

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        return (*super().on_stop(now), *super().on_stop(now))


class Silent(Reporter):
    """Says nothing any more after a while."""

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        return super().on_timer(timer, now) if len(self.heard) < 10 else ()


def test_a_node_that_says_more_or_less_than_it_did(run: Path) -> None:
    first = divergence(proved(run, with_r1(lambda _: Chatty("r1")))["r1", 1])
    assert first.problem == "it sends 32 messages on robot/r1/odometry, its journal says 31"
    assert first.kind == "stop"
    first = divergence(proved(run, with_r1(lambda _: Silent("r1")))["r1", 1])
    assert "messages on robot/r1/odometry, its journal says" in first.problem


class Failing(Reporter):
    """Fails at a call of its timer."""

    def __init__(self, at: int) -> None:
        super().__init__("r1")
        self.left = at

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        self.left -= 1
        if not self.left:
            raise ZeroDivisionError("by nothing")
        return super().on_timer(timer, now)


def test_a_node_that_fails_now(run: Path) -> None:
    first = divergence(proved(run, with_r1(lambda _: Failing(5)))["r1", 1])
    assert first.problem == "it fails when it is run again: ZeroDivisionError: by nothing"
    assert (first.kind, first.name) == ("timer", "report")


def test_a_node_that_failed_in_the_run_as_it_does_now(tmp_path: Path) -> None:
    """Its host stops it then, and so the next call is its stop."""
    runner = NodeRunner(Failing(5), 1)
    sent = runner.start(VIRTUAL_EPOCH)
    for count in range(1, 5):
        sent += runner.timer("report", VIRTUAL_EPOCH + count * SECOND)
    with pytest.raises(ZeroDivisionError):
        runner.timer("report", VIRTUAL_EPOCH + 5 * SECOND)
    sent += runner.stop((), VIRTUAL_EPOCH + 6 * SECOND)
    path = tmp_path / "a.mcap"
    with writer(path, scenario_with()) as file:
        for one in sent:
            file.write(one.topic, one.data, one.stamp_ns, one.stamp_ns, one.seq)
    found = proved(path, {"r1": lambda _: Failing(5)})["r1", 1]
    assert (found.verdict, found.calls, found.messages) == ("identical", 7, 5)
    assert proved(path, {"r1": lambda _: Failing(4)})["r1", 1].verdict == "diverges"
    assert proved(path, {"r1": lambda _: Reporter("r1")})["r1", 1].verdict == "diverges"


class Gullible(Reporter):
    """Believes all it hears."""

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        assert isinstance(message.message, Alive) or message.topic == "robot/r1/command"
        return ()


def test_inputs_of_another_kind_do_no_harm(run: Path) -> None:
    found = proved(run, with_r1(lambda _: Gullible("r1")))["r1", 1]
    assert found.verdict == "diverges"


def test_who_says_what(run: Path, tmp_path: Path) -> None:
    stop = EmergencyStop(source="operator-1", incarnation=1, seq=0, stamp_ns=7, stopped=True)

    def change(record: Recorded) -> Iterable[Recorded]:
        yield record
        if (record.topic, record.sequence) == ("robot/r1/odometry", 3):
            now = record.log_time_ns
            yield Recorded(topics.STOP, codec.encode(stop), now, 7, 0)
            yield Recorded("robot/r1/odometry", b"garbage", now, now, 0)
            yield record
            fake = odometry("r1", source="r2", incarnation=1, seq=500, stamp_ns=9)
            yield Recorded("robot/r1/odometry", codec.encode(fake), now, 9, 500)

    path = changed(run, tmp_path, change)
    found = census(read(path))
    assert {(one.source, one.incarnation) for one in found.speakers} == {
        ("controller", 1),
        ("operator-1", 1),
        ("r1", 1),
        ("r2", 1),
    }
    assert (found.headless, found.changed, found.disordered) == (1, (), 1)
    assert problems(path)[0] == "1 messages of r2 on robot/r1/odometry, which is not theirs"
    r1 = next(one for one in found.speakers if one.source == "r1")
    assert (r1.messages - r1.of_host, r1.journaled) == (32, True)
    assert 2.5 < r1.span_s < 3.5


def test_a_message_that_has_lost_its_header(run: Path, tmp_path: Path) -> None:
    path = changed(run, tmp_path, flipped("robot/r1/odometry", 7, 0))
    assert problems(path) == ["1 messages are not as the recorder wrote them: robot/r1/odometry 7"]
    assert proved(path)["r1", 1].unrecorded == 1


def test_nothing_is_asked_of_an_empty_census() -> None:
    assert problems_of(Census((), 0, (), {}), (), ROBOTS) == [
        "the recording lacks the journals of all nodes that were to be run again"
    ]


def test_watching_may_end_it(run: Path) -> None:
    class EnoughError(Exception):
        pass

    def watch() -> None:
        raise EnoughError

    with pytest.raises(EnoughError):
        prove(read(run), makers(), watch=watch)


def test_a_long_tail_is_judged_by_the_pace_of_the_clock(tmp_path: Path) -> None:
    path = record_run(tmp_path / "a.mcap", duration_s=30)
    seqs = [record.sequence for record in read(path).messages() if record.topic == "journal/r1"]
    assert len(seqs) > 100
    found = proved(rewrite(path, tmp_path / "b.mcap", without("journal/r1", *seqs[-10:])))["r1", 1]
    assert (found.verdict, found.unproved_s > 1.5) == ("unproved", True)

    def faster(record: Recorded) -> Iterable[Recorded]:
        """Clocks at ten times the speed."""
        publish = VIRTUAL_EPOCH + 10 * (record.publish_time_ns - VIRTUAL_EPOCH)
        return (record._replace(publish_time_ns=publish),) if record.topic == "journal/r1" else (record,)

    (life,) = lives(read(rewrite(path, tmp_path / "c.mcap", faster)), ["r1"])
    assert longest_tail(life) == 10 * LONGEST_TAIL
