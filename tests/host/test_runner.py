"""The runner numbers what a node sends, refuses what it must not see, and keeps its journal."""

import zlib

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.messages import (
    Alive,
    Command,
    Counters,
    Decided,
    Decisions,
    Journal,
    LinkReport,
    LinkReports,
    Message,
    Refused,
)
from maniple.core.time import SECOND
from maniple.host.runner import NodeRunner
from tests.host.nodes import Reporter, command, odometry

START = 1000 * SECOND


@pytest.fixture
def reporter() -> Reporter:
    return Reporter()


@pytest.fixture
def runner(reporter: Reporter) -> NodeRunner:
    made = NodeRunner(reporter, incarnation=3)
    for life in (1, 2):
        made.announced("controller", life)
    made.start(START)
    return made


def sent(message: Message, topic: str, source: str, seq: int, incarnation: int = 1) -> Envelope:
    stamped = msgspec.structs.replace(
        message, source=source, seq=seq, incarnation=incarnation, stamp_ns=START
    )
    return envelope_of(topic, codec.encode(stamped))


def heard(reporter: Reporter) -> list[Message]:
    return [message for _, message in reporter.heard]


def journal_of(envelopes: list[Envelope]) -> Journal:
    (found,) = [e for e in envelopes if e.topic == "journal/r1"]
    message = codec.decode(found.topic, found.data)
    assert isinstance(message, Journal)
    return message


def test_outgoing_messages_are_stamped_and_numbered_per_topic(runner: NodeRunner) -> None:
    first, second = runner.timer("report", START + 5)[0], runner.timer("report", START + 9)[0]
    assert [(e.source, e.incarnation, e.seq, e.stamp_ns) for e in (first, second)] == [
        ("r1", 3, 0, START + 5),
        ("r1", 3, 1, START + 9),
    ]
    assert envelope_of(first.topic, first.data) == first


def test_old_and_repeated_messages_are_refused_within_an_incarnation(
    runner: NodeRunner, reporter: Reporter
) -> None:
    topic = topics.command("r1")
    for incarnation, seq in ((1, 5), (1, 5), (1, 4), (1, 6), (2, 0), (1, 7)):
        runner.receive(sent(command(), topic, "controller", seq, incarnation), START)
    accepted = [(m.incarnation, m.seq) for m in heard(reporter) if isinstance(m, Command)]
    assert accepted == [(1, 5), (1, 6), (2, 0)]
    runner.flush((), START + 1)
    refused = [(m.reason, m.count) for m in heard(reporter) if isinstance(m, Refused)]
    assert refused == [("old", 1), ("old", 2)], "the first at once, what follows with the next flush"


def test_of_a_flood_of_garbage_each_kind_is_told_once_a_flush_and_all_of_it_counted(
    runner: NodeRunner, reporter: Reporter
) -> None:
    for k in range(10_000):
        runner.refuse(topics.command("r1"), f"forged-{k}" * 100, "sender", START)
    runner.flush((), START + 1)
    told = [m for m in heard(reporter) if isinstance(m, Refused)]
    assert len(told) < 70
    assert sum(m.count for m in told) == 10_000
    assert max(len(m.sender) for m in told) <= 64


def test_what_was_counted_of_each_link_is_reported_once_a_second(runner: NodeRunner) -> None:
    topic = topics.command("r1")
    for seq in (3, 4, 8, 5):
        runner.receive(sent(command(), topic, "controller", seq), START)
    dropped = Decided("controller", topic, 1, 6, True, 0, cause="loss")
    (report,) = [e for e in runner.flush([dropped], START + SECOND) if e.topic == "links/r1"]
    message = codec.decode(report.topic, report.data)
    assert isinstance(message, LinkReports)
    assert message.links == (LinkReport("controller", topic, received=3, missing=3, injected=1, refused=1),)
    assert not [e for e in runner.flush((), START + SECOND + 1) if e.topic == "links/r1"]


def test_unknown_fields_are_ignored_and_counted(runner: NodeRunner, reporter: Reporter) -> None:
    known = sent(command(), topics.command("r1"), "controller", 0)
    more = msgspec.msgpack.decode(known.data) | {"colour": "red", "mood": 3}
    runner.receive(envelope_of(known.topic, msgspec.msgpack.encode(more)), START)
    assert isinstance(heard(reporter)[0], Command)
    reporter.subscriptions |= {topics.HOST_COUNTERS}
    runner.flush((), START + SECOND)
    (counters,) = [m for m in heard(reporter) if isinstance(m, Counters)]
    assert counters.counters["unknown_fields"] == 2


@pytest.mark.parametrize("rest", [{}, {"layer": "nothing"}, {"layer": 7, "values": "x"}])
def test_what_has_only_a_header_is_refused_and_told(
    runner: NodeRunner, reporter: Reporter, rest: dict[str, object]
) -> None:
    header = {"source": "controller", "incarnation": 1, "seq": 0, "stamp_ns": START}
    topic = topics.command("r1")
    runner.receive(envelope_of(topic, msgspec.msgpack.encode(header | rest)), START)
    (refused,) = heard(reporter)
    assert isinstance(refused, Refused)
    assert refused.reason == "malformed"


def test_a_number_that_is_not_finite_is_refused_and_does_not_make_the_next_one_old(
    runner: NodeRunner, reporter: Reporter
) -> None:
    topic = topics.command("r1")
    runner.receive(sent(command(values=(float("nan"), 0.0)), topic, "controller", 7), START)
    runner.receive(sent(command(), topic, "controller", 3), START)
    assert [type(m) for m in heard(reporter)] == [Refused, Command]


def test_a_foreign_sender_is_refused(runner: NodeRunner, reporter: Reporter) -> None:
    runner.receive(sent(command(), topics.command("r1"), "r2", 0), START)
    (refused,) = heard(reporter)
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.sender) == ("sender", "r2")


def test_the_journal_holds_every_call_in_order_with_the_bytes_the_host_made(runner: NodeRunner) -> None:
    arrived = sent(command(), topics.command("r1"), "controller", 0)
    runner.timer("report", START + 1)
    runner.receive(arrived, START + 2)
    runner.alive("r2", 4, True, START + 3)
    journal = journal_of(runner.stop((), START + 4))
    assert [(call.kind, call.now_ns - START, call.name) for call in journal.calls] == [
        ("start", 0, ""),
        ("timer", 1, "report"),
        ("message", 2, topics.command("r1")),
        ("message", 3, topics.HOST_ALIVE),
        ("stop", 4, ""),
    ]
    received, alive = journal.calls[2], journal.calls[3]
    assert received.data is None
    assert received.crc32 == zlib.crc32(arrived.data)
    assert (received.source, received.incarnation, received.seq) == ("controller", 1, 0)
    assert alive.data is not None
    told = codec.decode(alive.name, alive.data)
    assert isinstance(told, Alive)
    assert (told.node, told.node_incarnation, told.alive) == ("r2", 4, True)


def test_a_flush_sends_the_journal_once_and_the_decisions(runner: NodeRunner) -> None:
    decided = Decided("controller", topics.command("r1"), 1, 0, True, 0)
    first = runner.flush([decided], START + 1)
    assert [e.topic for e in first] == [topics.DECISIONS, "journal/r1"]
    message = codec.decode(first[0].topic, first[0].data)
    assert isinstance(message, Decisions)
    assert message.decided == (decided,)
    assert runner.flush((), START + 2) == []


def test_a_node_that_does_not_subscribe_to_host_messages_is_not_called(runner: NodeRunner) -> None:
    assert topics.HOST_COUNTERS not in runner.node.subscriptions
    assert [e.topic for e in runner.flush((), START + 2 * SECOND)] == ["journal/r1"]
    assert runner.flush((), START + 4 * SECOND) == []


def test_the_last_message_of_a_node_is_still_sent(runner: NodeRunner, reporter: Reporter) -> None:
    last = runner.stop((), START + 1)[0]
    assert reporter.stopped
    assert codec.decode(last.topic, last.data) == msgspec.structs.replace(
        odometry("r1", x_m=-1.0), source="r1", incarnation=3, seq=0, stamp_ns=START + 1
    )


def test_a_stopped_node_is_not_called_again() -> None:
    class Curious(Reporter):
        def __init__(self) -> None:
            super().__init__()
            self.subscriptions |= {topics.HOST_COUNTERS}

    node = Curious()
    runner = NodeRunner(node, incarnation=1)
    runner.start(START)
    assert journal_of(runner.stop((), START + 10 * SECOND)).calls[-1].kind == "stop"
    assert node.heard == []


def test_news_is_what_is_newer_than_what_was_received(runner: NodeRunner) -> None:
    topic = topics.command("r1")
    assert runner.is_news(sent(command(), topic, "controller", 0))
    runner.receive(sent(command(), topic, "controller", 3), START)
    assert [runner.is_news(sent(command(), topic, "controller", seq)) for seq in (2, 3, 4)] == [
        False,
        False,
        True,
    ]
    assert runner.is_news(sent(command(), topic, "controller", 0, incarnation=2))


def test_the_journal_says_how_many_were_sent(runner: NodeRunner) -> None:
    runner.timer("report", START + 1)
    runner.timer("report", START + 2)
    assert journal_of(runner.flush((), START + 3)).sent["robot/r1/odometry"] == 2
    runner.timer("report", START + 4)
    told = journal_of(runner.stop((), START + 5)).sent
    assert told == {"robot/r1/odometry": 4}, "the last of on_stop too; not the journal, nor what stays here"
