import copy
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core import topics
from maniple.core.codec import decode, encode, encoding
from maniple.core.errors import MessageError
from maniple.core.messages import Message, pack_floats


def as_map(message: Message) -> Any:
    return msgspec.msgpack.decode(encode(message))


def with_floats_replaced(value: Any, by: float) -> Iterator[Any]:
    """Copies of a structure, each with one float replaced."""
    if isinstance(value, float):
        yield by
    elif isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            for changed in with_floats_replaced(value[key], by):
                result = copy.deepcopy(value)
                result[key] = changed
                yield result


def test_messages_survive_the_wire(example: tuple[str, Message]) -> None:
    name, message = example
    assert decode(name, encode(message)) == message
    assert encode(decode(name, encode(message))) == encode(message)


def test_unknown_fields_are_ignored(example: tuple[str, Message]) -> None:
    name, message = example
    assert decode(name, msgspec.msgpack.encode({**as_map(message), "since_v2": [1, 2]})) == message


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_number_that_is_not_finite_gets_through(example: tuple[str, Message], bad: float) -> None:
    name, message = example
    for changed in with_floats_replaced(as_map(message), bad):
        with pytest.raises(MessageError, match=r"not finite|Expected `float`"):
            decode(name, msgspec.msgpack.encode(changed))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nor_in_an_array(example: tuple[str, Message], bad: float) -> None:
    name, message = example
    for field, value in as_map(message).items():
        if isinstance(value, bytes):
            data = bytearray(value)
            data[-4:] = pack_floats([bad])
            with pytest.raises(MessageError, match=f"{field} holds a number that is not finite"):
                decode(name, msgspec.msgpack.encode({**as_map(message), field: bytes(data)}))


def test_arrays_have_whole_rows(example: tuple[str, Message]) -> None:
    name, message = example
    columns = {"errors": 6, "poses": 3, "velocities": 2, "beams": 3, "points": 2}
    for field, value in as_map(message).items():
        if isinstance(value, bytes):
            for cut in range(1, 4 * columns.get(field, 1)):
                with pytest.raises(MessageError, match=f"{field} has {len(value) - cut} bytes"):
                    decode(name, msgspec.msgpack.encode({**as_map(message), field: value[:-cut]}))


def test_missing_fields_and_wrong_types_are_refused(example: tuple[str, Message]) -> None:
    name, message = example
    for field in msgspec.structs.fields(message):
        data = as_map(message)
        with pytest.raises(MessageError, match=name):
            decode(name, msgspec.msgpack.encode({**data, field.name: {"not": None}}))
        del data[field.name]
        if field.required:
            with pytest.raises(MessageError, match=field.name):
                decode(name, msgspec.msgpack.encode(data))


def test_a_message_of_another_topic_is_refused() -> None:
    drive = msgspec.msgpack.encode({"u_mps": 0.1, "w_radps": 0.0, "active": True})
    with pytest.raises(MessageError, match="layer"):
        decode(topics.command("r1"), drive)


def test_values_that_only_overflow_when_added_are_refused_all_the_same() -> None:
    huge = {"u_mps": 1.7e308, "w_radps": 1.7e308, "active": True}
    with pytest.raises(MessageError, match="not finite"):
        decode(topics.drive("r1"), msgspec.msgpack.encode(huge))


@settings(deadline=None, derandomize=True, max_examples=200)
@given(
    st.binary(max_size=200), st.sampled_from([topics.odometry("r1"), topics.command("r1"), topics.scan("r1")])
)
def test_no_bytes_raise_anything_else(data: bytes, name: str) -> None:
    with pytest.raises(MessageError):
        decode(name, data)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x91" * 100_000, b"\x81\xa6source\xa2\xff\xfe"])
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode(topics.odometry("r1"), data)


def test_the_encoding_names_type_and_version() -> None:
    assert encoding("robot/r1/odometry") == "application/msgpack;maniple.Odometry@1"
    assert encoding("hw/r1/scan") == encoding("robot/r1/ranges") == "application/msgpack;maniple.Scan@1"
