"""Messages of two runs, one by one."""

from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from maniple.core import codec, topics
from maniple.core.messages import Command, FormationState, Message, Stamp, pack_floats
from maniple.core.time import MILLISECOND, SECOND
from maniple.recording.reader import Recorded
from maniple.report.comparison_messages import TopicDifference, compared
from maniple.report.comparison_tolerances import tolerances_of

COMMAND = Command(
    source="controller",
    incarnation=1,
    layer="drive",
    values=(0.1, 0.0),
    answers=Stamp(1, 0, 0),
    inputs_age_ns=0,
)
STATE = FormationState(
    source="controller",
    incarnation=1,
    phase="running",
    task_time_s=1.0,
    task_duration_s=2.0,
    reference=(0.0, 0.0, 0.0),
    reference_velocity=(0.0, 0.0, 0.0),
    chain=("r1", "r2", "r3"),
    errors=pack_floats([[0.0] * 6]),
    roster=(),
)


def at(message: Message, seq: int, topic: str = topics.command("r1"), **changes: Any) -> Recorded:
    """A message, sent ten a second, recorded 1 ms later."""
    stamp = SECOND + seq * 100 * MILLISECOND
    sent = replace(message, seq=seq, stamp_ns=stamp, **changes)
    return Recorded(topic, codec.encode(sent), stamp + MILLISECOND, stamp, seq)


def differ(
    a: list[Recorded], b: list[Recorded], *tolerances: str, ignore: tuple[str, ...] = ()
) -> dict[str, TopicDifference]:
    found = compared(a, b, (SECOND, SECOND), tolerances_of(tolerances, ignore))
    assert msgspec.json.decode(msgspec.json.encode(found), type=tuple[TopicDifference, ...]) == found
    return {one.topic: one for one in found}


def test_the_first_and_the_largest_difference_of_each_field() -> None:
    a = [at(COMMAND, seq) for seq in range(6)]
    b = [
        at(COMMAND, seq, values=(0.1 + off, 0.0), third=third)
        for seq, (off, third) in enumerate(
            [(0.0, 0.0), (0.001, 0.0), (0.0, 0.0), (-0.3, 0.5), (0.2, 0.0), (0.0, 0.0)]
        )
    ]
    found = differ(a, b, "robot/*/command:values=0.01")["robot/r1/command"]
    assert (found.a, found.b, found.identical, found.within, found.beyond) == (6, 6, 3, 1, 2)
    assert not found.same
    values, third = found.fields
    assert (values.field, values.messages, values.beyond, values.tolerance) == ("values", 3, 2, 0.01)
    assert values.first.message.seq == values.largest.message.seq == 3
    assert values.first.difference == pytest.approx(0.3)
    assert values.first.message.at_s == pytest.approx(0.3)
    assert (third.field, third.messages, third.largest.a, third.largest.b) == ("third", 1, 0.0, 0.5)


def test_within_the_tolerance_is_the_same() -> None:
    a = [at(COMMAND, seq) for seq in range(3)]
    b = [at(COMMAND, seq, values=(0.1 + 1e-9, 0.0)) for seq in range(3)]
    assert not differ(a, b)["robot/r1/command"].same
    found = differ(a, b, "1e-6")["robot/r1/command"]
    assert found.same
    assert (found.within, found.beyond) == (3, 0)
    assert found.fields[0].messages == 3
    assert not found.fields[0].beyond


def test_text_is_not_near_to_anything() -> None:
    found = differ([at(COMMAND, 0)], [at(COMMAND, 0, layer="compensation")], "1e9")["robot/r1/command"]
    assert found.beyond == 1
    assert (found.fields[0].largest.a, found.fields[0].largest.difference) == ("drive", None)


def test_arrays_by_element_and_of_another_length() -> None:
    one = pack_floats([[0.0, 0.0, 0.5, 0.0, 0.0, 0.0]])
    a = [at(STATE, seq, "formation/state") for seq in range(2)]
    b = [at(STATE, 0, "formation/state", errors=one), at(STATE, 1, "formation/state", errors=one * 2)]
    element, length = differ(a, b)["formation/state"].fields
    assert (element.field, element.first.field, element.first.b) == ("errors", "errors[0][2]", 0.5)
    assert (length.field, length.first.a, length.first.b) == ("errors.length", 1, 2)
    assert differ(a, b, ignore=("formation/state:errors",))["formation/state"].same
    assert differ(a, b, ignore=("formation/*",)) == {}


def test_what_is_missing_in_one() -> None:
    a = [at(COMMAND, seq) for seq in range(5)]
    b = [at(COMMAND, seq) for seq in (1, 2, 4)] + [
        at(COMMAND, 0, incarnation=2),
        at(STATE, 7, "formation/state"),
    ]
    found = differ(a, b)
    command = found["robot/r1/command"]
    assert (command.identical, command.only_a, command.only_b) == (3, 2, 1)
    assert command.first_only_a is not None
    assert command.first_only_a.seq == 0
    assert command.first_only_b is not None
    assert command.first_only_b.incarnation == 2
    assert found["formation/state"].only_b == 1
    assert not found["formation/state"].same


def test_order_and_repetition_do_not_matter() -> None:
    a = [at(COMMAND, seq) for seq in range(9)]
    b = [*a[4:], *a[:4], a[2], a[5]]
    assert differ(a, b)["robot/r1/command"].same
    assert differ([*a, a[8]], b)["robot/r1/command"].identical == 9


def test_what_cant_be_decoded_is_compared_by_its_bytes() -> None:
    broken = at(COMMAND, 0)._replace(data=b"?")
    foreign = at(COMMAND, 1)._replace(topic="some/thing")
    other = foreign._replace(data=foreign.data[:-1] + b"\x01")
    assert differ([broken, foreign], [broken, foreign])["some/thing"].same
    found = differ([broken, foreign], [broken._replace(data=b"!"), other])
    assert found["robot/r1/command"].fields[0].first.a == b"?".hex()
    assert found["some/thing"].fields[0].field == "bytes"
