"""Faults at a receiver: which messages, and the same ones whatever the order they come in."""

import zlib
from typing import Any

from msgspec.structs import replace

from maniple.core.envelope import Envelope
from maniple.core.faults import plan_of
from maniple.core.links import Link
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Burst, ClockError, Controller, Fault, Partition
from maniple.core.time import MILLISECOND, SECOND
from maniple.core.topics import FORMATION_GOAL, PLAN, STOP
from maniple.transport.faulty import FaultyReceiver
from tests.host.nodes import scenario_with


def receiver_with(destination: str, *faults: Fault, seed: int = 1, **changes: Any) -> FaultyReceiver:
    scenario = scenario_with(faults=faults, seed=seed, **changes)
    return FaultyReceiver(destination, scenario, plan_of(scenario, 0), 0)


def delays(receiver: FaultyReceiver, message: Envelope) -> list[int]:
    return [arrival.delay for arrival in receiver.admit(message)]


def envelope(seq: int, topic: str = "robot/r1/odometry", source: str = "r1") -> Envelope:
    return Envelope(topic, source, 1, seq, 0, b"", 0)


def made(data: bytes) -> Envelope:
    return replace(envelope(0), data=data, crc32=zlib.crc32(data))


def test_without_a_plan_everything_passes_and_nothing_is_noted() -> None:
    receiver = receiver_with("controller")
    assert delays(receiver, envelope(0)) == [0]
    assert receiver.take_decided() == ()


def test_topics_that_faults_do_not_apply_to_pass() -> None:
    receiver = receiver_with("r1", Fault(loss=1.0), seed=1)
    assert delays(receiver, envelope(0, "hw/r1/motion", "simulator")) == [0]
    assert receiver.take_decided() == ()


def test_links_that_no_rule_matches_pass() -> None:
    receiver = receiver_with("controller", Fault(source="r2", loss=1.0), seed=1)
    assert delays(receiver, envelope(0)) == [0]
    assert receiver.admit(envelope(0, "robot/r2/odometry", "r2")) == ()


def test_the_same_messages_are_lost_in_any_order() -> None:
    plan = (Fault(loss=0.4, latency_s=0.1, jitter_s=0.05),)
    forward, backward = receiver_with("controller", *plan, seed=7), receiver_with("controller", *plan, seed=7)
    there = {seq: forward.admit(envelope(seq)) for seq in range(500)}
    back = {seq: backward.admit(envelope(seq)) for seq in reversed(range(500))}
    assert there == back


def test_decisions_say_what_happened() -> None:
    receiver = receiver_with("controller", Fault(loss=0.5, latency_s=0.02), seed=3)
    admitted = [delays(receiver, envelope(seq)) for seq in range(100)]
    decided = receiver.take_decided()
    assert [[] if d.dropped else [d.delay_ns] for d in decided] == admitted
    assert sorted(map(len, admitted))[::99] == [0, 1]
    assert {delay for one in admitted for delay in one} == {20 * MILLISECOND}
    assert receiver.take_decided() == ()


def test_a_corrupted_message_has_other_bytes_and_the_crc_of_what_was_sent() -> None:
    receiver = receiver_with("controller", Fault(corrupt=1.0, duplicate=1.0))
    sent = made(b"what was sent")
    first, second = receiver.admit(sent)
    assert first.envelope == second.envelope
    assert first.envelope.altered
    assert first.envelope.crc32 == sent.crc32 != zlib.crc32(first.envelope.data)
    (decided,) = receiver.take_decided()
    assert (decided.corrupted, decided.copy_delay_ns, decided.cause) == (True, 0, "")


def test_a_new_plan_replaces_the_old_and_the_queue_before_an_unchanged_rule_stays() -> None:
    limited, other = Fault(rate_kbps=8.0, queue_s=10.0), Fault(rate_kbps=8.0, queue_s=9.0)
    receiver = receiver_with("controller", limited)
    sent = made(bytes(1000))  # takes a second
    assert delays(receiver, sent) == [SECOND]
    receiver.replan(FaultPlan(since_ns=0, faults=(limited, Fault(latency_s=0.5))))
    assert delays(receiver, sent) == [2 * SECOND + SECOND // 2]
    receiver.replan(FaultPlan(since_ns=0, faults=(other,)))
    assert delays(receiver, sent) == [SECOND]
    receiver.replan(FaultPlan(since_ns=0))
    assert delays(receiver, sent) == [0]


def test_nobody_is_cut_off_from_what_runs_beside_it() -> None:
    alone = (Partition(groups=(("controller",),)),)
    receiver = receiver_with("controller", partitions=alone, controller=Controller(host="r1"))
    assert delays(receiver, envelope(0)) == [0]
    assert delays(receiver, envelope(0, "robot/r2/odometry", "r2")) == []
    assert [decided.cause for decided in receiver.take_decided()] == ["cut"]


def test_the_safety_line_and_the_instrument_are_never_cut() -> None:
    receiver = receiver_with("r1", Fault(loss=1.0), partitions=(Partition(groups=(("r1",),)),))
    for topic in (STOP, PLAN):
        assert delays(receiver, envelope(0, topic, "operator")) == [0]
    assert delays(receiver, envelope(0, FORMATION_GOAL, "operator")) == []


def test_windows_are_of_true_time_whatever_the_senders_clock_shows() -> None:
    rule = Fault(loss=1.0, windows=((1.0, 2.0),))
    receiver = receiver_with("controller", rule, clocks=(ClockError(node="r1", offset_s=100.0),))
    for true_s, lost in ((0.5, False), (1.5, True), (2.5, False)):
        sent = replace(envelope(0), stamp_ns=round((100.0 + true_s) * SECOND))
        assert (receiver.admit(sent) == ()) is lost


def test_senders_with_forged_names_cost_a_bounded_memory() -> None:
    receiver = receiver_with("controller", Fault(rate_kbps=8.0))
    for number in range(10_000):
        receiver.admit(envelope(0, FORMATION_GOAL, f"forged{number}"))
    assert len(receiver._links) <= 4096
    assert len(receiver._queues) <= 4096


def test_decisions_say_what_the_link_decides() -> None:
    """The receiver adds nothing of its own."""
    rule = Fault(latency_s=0.1, jitter_s=0.1, loss=0.2, duplicate=0.3, burst=Burst(enter=0.1, leave=0.4))
    receiver = receiver_with("controller", rule, seed=9)
    link = Link(FaultPlan(since_ns=0, faults=(rule,)), 9, "r1", "controller", "robot/r1/odometry")
    for seq in range(300):
        arrivals = delays(receiver, envelope(seq))
        (decided,) = receiver.take_decided()
        decision = link.decide(1, seq, 0, 0)
        copies = [] if decision.copy_delay is None else [decision.copy_delay]
        assert arrivals == ([] if decision.dropped else [decision.delay, *copies])
        assert (decided.dropped, decided.cause) == (decision.dropped, decision.cause)
        assert decided.copy_delay_ns == (-1 if decision.copy_delay is None else decision.copy_delay)


def test_what_is_handed_over_is_as_late_as_on_its_link_and_never_lost() -> None:
    receiver = receiver_with("controller", Fault(latency_s=2.0, jitter_s=0.5, loss=1.0))
    waits = [receiver.delay(envelope(seq)) for seq in range(50)]
    assert all(1500 * MILLISECOND <= wait <= 2500 * MILLISECOND for wait in waits)
    assert len(set(waits)) > 40
    assert receiver.delay(envelope(0, STOP, "operator")) == 0
    assert receiver.take_decided() == ()
