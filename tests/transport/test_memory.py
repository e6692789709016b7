"""Routing in virtual time."""

from maniple.core.envelope import Envelope
from maniple.core.time import MILLISECOND
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
