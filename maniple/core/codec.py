"""Messages to bytes and back, refusing what must never reach a control law."""

import math
from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from maniple.core.errors import MessageError
from maniple.core.messages import Message
from maniple.core.scenario.types import Parameters
from maniple.core.topics import topic

_encode = msgspec.msgpack.Encoder().encode


def encode(message: Message) -> bytes:
    """The wire bytes of a message."""
    return _encode(message)


def decode(name: str, data: bytes) -> Message:
    """The message of the topic `name` in `data`; unknown fields are ignored.

    Raises:
        MessageError: not the topic's type, a number that is not finite, or an array of the wrong length.
    """
    return decoder(name)(data)


@cache
def decoder(name: str) -> Callable[[bytes], Message]:
    """`decode` for one topic, for those who read it often."""
    kind = topic(name).type
    read = msgspec.msgpack.Decoder(kind).decode
    problem = _problem_finder(kind)

    def read_checked(data: bytes) -> Message:
        try:
            message = read(data)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise MessageError(f"{name}: {error}") from None
        if (text := problem(message)) is not None:
            raise MessageError(f"{name}: {text}")
        return message

    return read_checked


def head(name: str) -> bytes:
    """The first bytes of a message that has no more fields than its type."""
    fields = len(_field_names(topic(name).type))  # the length of a map: in one byte, or two after a mark
    return bytes([0x80 | fields]) if fields < 16 else b"\xde" + fields.to_bytes(2, "big")


def unknown_fields(name: str, data: bytes) -> int:
    """How many fields of a valid message its type does not have: they were ignored."""
    return len(
        msgspec.msgpack.decode(data, type=dict[str, msgspec.Raw]).keys() - _field_names(topic(name).type)
    )


@cache
def float_arrays(kind: type[msgspec.Struct]) -> Mapping[str, int]:
    """The fields of a type that hold float32 arrays as bytes, with how many columns each has."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: columns for name, hint in hints.items() if (columns := _columns(hint))}


@cache
def _field_names(kind: type[msgspec.Struct]) -> frozenset[str]:
    return frozenset(field.encode_name for field in msgspec.structs.fields(kind))


def encoding(name: str) -> str:
    """The Zenoh encoding of a topic: type and version."""
    return f"application/msgpack;maniple.{topic(name).type.__name__}@1"


@cache
def _problem_finder(kind: type[msgspec.Struct]) -> Callable[[msgspec.Struct], str | None]:
    """A function that names what is wrong with the numbers of a `kind`, or returns None."""
    hints = get_type_hints(kind, include_extras=True)
    scalars = tuple(name for name, hint in hints.items() if hint is float)
    vectors = tuple(
        name
        for name, hint in hints.items()
        if get_origin(hint) is tuple and set(get_args(hint)) <= {float, ...}
    )
    arrays = tuple((name, 4 * columns) for name, columns in float_arrays(kind).items())
    nested = tuple((name, _problem_finder(part)) for name, hint in hints.items() if (part := _part(hint)))
    trees = tuple(name for name, hint in hints.items() if _is_tree(hint))
    checks: list[Callable[[Any], str | None]] = []
    if scalars:
        checks.append(_scalars_checked(scalars))
    checks += [_vector_checked(name) for name in vectors]
    checks += [_array_checked(name, row) for name, row in arrays]
    checks += [_parts_checked(name, find) for name, find in nested]
    checks += [_tree_checked(name) for name in trees]
    if not checks:
        return lambda _: None
    if len(checks) == 1:
        return checks[0]

    def find(message: msgspec.Struct) -> str | None:
        for check in checks:
            if (text := check(message)) is not None:
                return text
        return None

    return find


def _scalars_checked(names: tuple[str, ...]) -> Callable[[Any], str | None]:
    values = attrgetter(*names, names[0])  # the first once more: always a tuple

    def check(message: Any) -> str | None:
        return None if math.isfinite(sum(values(message))) else _name_the_worst(message, names)

    return check


def _vector_checked(name: str) -> Callable[[Any], str | None]:
    values = attrgetter(name)

    def check(message: Any) -> str | None:
        return None if math.isfinite(sum(values(message))) else f"{name} is not finite"

    return check


def _array_checked(name: str, row: int) -> Callable[[Any], str | None]:
    def check(message: Any) -> str | None:
        data = getattr(message, name)
        if len(data) % row:
            return f"{name} has {len(data)} bytes, not a multiple of {row}"
        values = np.frombuffer(data, dtype="<f4")
        with np.errstate(over="ignore", invalid="ignore"):
            square = values.dot(values)
        if math.isfinite(square):
            return None
        return f"{name} holds a number that is not finite or absurdly large"

    return check


def _parts_checked(name: str, find: Callable[[Any], str | None]) -> Callable[[Any], str | None]:
    def check(message: Any) -> str | None:
        texts = (find(part) for part in getattr(message, name))
        return next((f"{name}: {text}" for text in texts if text is not None), None)

    return check


def _tree_checked(name: str) -> Callable[[Any], str | None]:
    def check(message: Any) -> str | None:
        value = msgspec.to_builtins(getattr(message, name))
        return None if _all_finite(value) else f"{name} holds a number that is not finite"

    return check


def _all_finite(value: Any) -> bool:
    """Whether every number in what a struct is made of is finite."""
    if isinstance(value, dict | list | tuple):
        return all(map(_all_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _is_tree(hint: Any) -> bool:
    """Whether a field holds one of several structs, or none, or tuples in a tuple."""
    parts = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    if any(get_origin(part) is tuple and get_origin(get_args(part)[0]) is tuple for part in parts):
        return True
    return len(parts) > 1 and any(isinstance(part, type) and issubclass(part, Parameters) for part in parts)


def _name_the_worst(message: msgspec.Struct, scalars: tuple[str, ...]) -> str:
    bad = [name for name in scalars if not math.isfinite(getattr(message, name))]
    return f"{', '.join(bad) or 'a sum of fields'} is not finite"


def _columns(hint: Any) -> int:
    """Columns of a float array; 0 for what is none."""
    for meta in getattr(hint, "__metadata__", ()):
        if isinstance(meta, msgspec.Meta) and "float32" in (meta.description or ""):
            return int((meta.extra or {}).get("columns", 1))
    return 0


def _part(hint: Any) -> type[msgspec.Struct] | None:
    """What a list of structs with float fields is made of; None for any other field."""
    if get_origin(hint) is not tuple:
        return None
    part = get_args(hint)[0]
    if not (isinstance(part, type) and issubclass(part, msgspec.Struct)):
        return None
    return part if float in get_type_hints(part).values() else None
