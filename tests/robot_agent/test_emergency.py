from itertools import permutations

import pytest

from maniple.core.messages import EmergencyStop
from robot_agent.emergency import Emergency


def said(stopped: bool, incarnation: int, seq: int = 0, source: str = "a", reason: str = "") -> EmergencyStop:
    return EmergencyStop(
        stopped=stopped, incarnation=incarnation, seq=seq, source=source, stamp_ns=0, reason=reason
    )


def test_stop_and_release() -> None:
    emergency = Emergency()
    assert (emergency.stopped, emergency.reason) == (False, "")
    assert emergency.take(said(True, 1, reason="a dog\nran in")) == "emergency"
    assert (emergency.stopped, emergency.reason) == (True, "emergency stop: a dog ran in")
    assert emergency.take(said(False, 2)) == "armed"
    assert (emergency.stopped, emergency.reason) == (False, "")


def test_what_is_said_again_changes_nothing() -> None:
    emergency = Emergency()
    assert emergency.take(said(False, 1)) is None
    assert emergency.take(said(True, 2)) == "emergency"
    assert emergency.take(said(True, 2, 1)) is None
    assert emergency.reason == "emergency stop"
    assert emergency.take(said(False, 3)) == "armed"
    assert emergency.take(said(False, 3, 1)) is None


def test_a_release_that_is_older_than_the_stop_does_not_release() -> None:
    emergency = Emergency()
    emergency.take(said(True, 5, 1))
    for incarnation, seq in ((4, 9), (5, 0), (5, 1)):
        assert emergency.take(said(False, incarnation, seq, "b")) is None
    assert emergency.stopped


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_two_operators_end_alike_in_every_order(order: tuple[int, ...]) -> None:
    words = [
        said(True, 5, 0, "a"),
        said(False, 6, 0, "b"),
        said(True, 7, 0, "a", "last"),
        said(False, 6, 1, "b"),
    ]
    emergency = Emergency()
    for index in order:
        emergency.take(words[index])
    assert (emergency.stopped, emergency.reason) == (True, "emergency stop: last")


def test_long_reasons_are_cut() -> None:
    emergency = Emergency()
    emergency.take(said(True, 1, reason="x" * 10**6))
    assert len(emergency.reason) < 250
