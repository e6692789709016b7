"""Stamps of clocks that are off, set right."""

import msgspec

from maniple.core.clocks import NodeClock
from maniple.core.envelope import Header
from maniple.core.messages import EmergencyStop, Journal
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.report.true_time import TrueTime
from tests.host.nodes import scenario_with

OFF = {"node": "r1", "offset_s": 1e5, "skew_ppm": 200.0}


def test_what_was_said_is_set_back_to_when_it_was_said() -> None:
    true_time = TrueTime(scenario_with(clocks=[OFF]))
    clock = NodeClock(VIRTUAL_EPOCH, round(1e5 * SECOND), 200.0)
    said = VIRTUAL_EPOCH + 30 * SECOND
    message = EmergencyStop(stopped=True, source="r1", stamp_ns=clock.shown(said))
    assert abs(true_time.of(message).stamp_ns - said) <= 1
    other = msgspec.structs.replace(message, source="controller")
    assert true_time.of(other) is other
    assert abs(true_time.header(Header("r1", 1, 2, clock.shown(said))).stamp_ns - said) <= 1
    assert true_time.header(Header("r2", 1, 2, said)).stamp_ns == said


def test_journals_stay_as_they_are() -> None:
    journal = Journal(calls=(), source="r1", stamp_ns=5)
    assert TrueTime(scenario_with(clocks=[OFF])).of(journal) is journal
