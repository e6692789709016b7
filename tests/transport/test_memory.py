"""Routing in virtual time."""

import zlib

from maniple.core.envelope import Envelope
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Fault, Partition
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.transport.memory import MemoryNetwork
from tests.host.nodes import scenario_with


def test_a_message_goes_to_all_who_want_it_but_not_back_to_its_source() -> None:
    wanted = {name: frozenset({"robot/r1/odometry"}) for name in ("r2", "controller", "r1")}
    network = MemoryNetwork(scenario_with(), wanted)
    message = Envelope("robot/r1/odometry", "r1", 1, 0, 0, b"", 0)
    assert network.send(message, 100) == [
        (100 + MILLISECOND, "controller", message),
        (100 + MILLISECOND, "r2", message),
    ]


def test_hardware_is_nearer_than_the_fleet() -> None:
    network = MemoryNetwork(scenario_with(), {"r1": frozenset({"hw/r1/motion"})})
    message = Envelope("hw/r1/motion", "simulator", 1, 0, 0, b"", 0)
    assert network.send(message, 0) == [(MILLISECOND // 5, "r1", message)]


def test_copies_are_deliveries_of_their_own_and_the_plan_can_change() -> None:
    rule = Fault(latency_s=0.1, jitter_s=0.05, duplicate=1.0, corrupt=1.0)
    network = MemoryNetwork(scenario_with(faults=(rule,)), {"controller": frozenset({"robot/r1/odometry"})})
    message = Envelope("robot/r1/odometry", "r1", 1, 0, VIRTUAL_EPOCH, b"bytes", zlib.crc32(b"bytes"))
    first, second = network.send(message, VIRTUAL_EPOCH)
    assert first[0] != second[0]
    for due, receiver, arrived in (first, second):
        assert 51 * MILLISECOND <= due - VIRTUAL_EPOCH <= 151 * MILLISECOND
        assert receiver == "controller"
        assert arrived.altered
        assert arrived.data != message.data
    network.replan(FaultPlan(since_ns=VIRTUAL_EPOCH))
    assert network.send(message, VIRTUAL_EPOCH) == [(VIRTUAL_EPOCH + MILLISECOND, "controller", message)]
    assert [decided.corrupted for decided in network.take_decided("controller")] == [True]


def test_a_partition_begins_and_ends_at_its_time_of_the_run() -> None:
    parted = (Partition(groups=(("r1",),), at_s=1.0, for_s=2.0),)
    network = MemoryNetwork(
        scenario_with(partitions=parted), {"controller": frozenset({"robot/r1/odometry"})}
    )
    for seconds, arrives in ((0.9, 1), (1.0, 0), (2.9, 0), (3.0, 1)):
        now = VIRTUAL_EPOCH + round(seconds * SECOND)
        assert len(network.send(Envelope("robot/r1/odometry", "r1", 1, 0, now, b"", 0), now)) == arrives
