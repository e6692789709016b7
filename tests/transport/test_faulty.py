"""Faults at a receiver: which messages, and the same ones whatever the order they come in."""

from typing import Any

from maniple.core.envelope import Envelope
from maniple.core.faults import plan_of
from maniple.core.scenario.types import Fault
from maniple.core.time import MILLISECOND
from maniple.transport.faulty import FaultyReceiver
from tests.host.nodes import scenario_with


def receiver_with(destination: str, *faults: Fault, seed: int = 1, **changes: Any) -> FaultyReceiver:
    scenario = scenario_with(faults=faults, seed=seed, **changes)
    return FaultyReceiver(destination, scenario, plan_of(scenario, 0), 0)


def delays(receiver: FaultyReceiver, message: Envelope) -> list[int]:
    return [arrival.delay for arrival in receiver.admit(message)]


def envelope(seq: int, topic: str = "robot/r1/odometry", source: str = "r1") -> Envelope:
    return Envelope(topic, source, 1, seq, 0, b"", 0)


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
