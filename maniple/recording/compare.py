"""Compares two messages field by field."""

import math
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np

from maniple.core import codec, topics
from maniple.core.errors import ArgumentError
from maniple.core.messages import Message


class Difference(NamedTuple):
    """One value in which two messages differ."""

    path: str
    """Of the value, as in `roster[2].odometry_age_s`; in a float array with its row and column."""
    first: Any
    second: Any
    """As JSON has it; None where there is no such value."""


class Tolerance(msgspec.Struct, frozen=True):
    """How far two numbers may be apart and still count as equal.

    Floats a and b are equal within X if |a - b| <= X max(1, |a|, |b|): X is absolute for small values and
    relative for large ones. Whole numbers and all else have to be the same, unless `fields` names them.
    """

    everywhere: float = 0.0
    """For every float."""
    fields: tuple[tuple[str, float], ...] = ()
    """For fields by name: `x_m`, `roster.odometry_age_s`, or with the type in front, `Odometry.x_m`. A name
    is for each field whose last parts it is, and for all that is in it; the longest that fits counts.
    Infinity is for fields that need not be the same at all."""


EXACT = Tolerance()

ANY = "*"
"""In the path of a field: the keys of a map, whatever they are."""


def tolerance_of(texts: Sequence[str]) -> Tolerance:
    """The tolerance that options describe: each a number, for all floats, or FIELD=NUMBER.

    Raises:
        ArgumentError: a text that is neither, or a field that no message has.
    """
    everywhere, fields = 0.0, dict[str, float]()
    for text in texts:
        name, equals, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not value >= 0.0 or (equals and not all(name.split("."))):
            raise ArgumentError(f"tolerance {text!r}: must be a number from 0 up, or FIELD=NUMBER (x_m=1e-6)")
        if equals and not any(_stands_for(name, path) for path in _paths()):
            raise ArgumentError(
                f"tolerance {text!r}: no message has a field {name}; x_m and Odometry.ticks are some"
            )
        if equals:
            fields[name] = value
        else:
            everywhere = value
    return Tolerance(everywhere, tuple(sorted(fields.items(), key=lambda item: -len(item[0]))))


def differences(first: Message, second: Message, tolerance: Tolerance = EXACT) -> Iterator[Difference]:
    """In what two messages of one type differ, in the order of their fields, float arrays by element.

    Without a tolerance 0.0 and -0.0 differ: their bytes do.
    """
    return _Comparison(type(first).__name__, tolerance).structs(first, second, "", "")


class _Comparison:
    """Of two messages of the type `kind`. Everywhere `field` is `path` without indices."""

    def __init__(self, kind: str, tolerance: Tolerance) -> None:
        self._kind = kind
        self._tolerance = tolerance

    def structs(
        self, first: msgspec.Struct, second: msgspec.Struct, path: str, field: str
    ) -> Iterator[Difference]:
        """In what two structs of one type differ."""
        arrays = codec.float_arrays(type(first))
        for name in first.__struct_fields__:
            a, b = getattr(first, name), getattr(second, name)
            place = f"{path}.{name}" if path else name, f"{field}.{name}" if field else name
            if columns := arrays.get(name):
                yield from self._arrays(a, b, *place, columns)
            else:
                yield from self._values(a, b, *place)

    def _values(self, first: Any, second: Any, path: str, field: str) -> Iterator[Difference]:
        if isinstance(first, msgspec.Struct) and type(first) is type(second):
            yield from self.structs(first, second, path, field)
        elif isinstance(first, tuple) and isinstance(second, tuple) and len(first) == len(second):
            for index, (a, b) in enumerate(zip(first, second, strict=True)):
                yield from self._values(a, b, f"{path}[{index}]", field)
        elif isinstance(first, dict) and isinstance(second, dict):
            for key in sorted(first.keys() | second.keys()):
                yield from self._values(first.get(key), second.get(key), f"{path}[{key}]", f"{field}.{key}")
        elif not self._equal(first, second, field):
            yield Difference(path, msgspec.to_builtins(first), msgspec.to_builtins(second))

    def _equal(self, first: Any, second: Any, field: str) -> bool:
        named = _named(self._tolerance, self._kind, field)
        if named == math.inf:
            return True
        if isinstance(first, float) and isinstance(second, float):
            limit = self._tolerance.everywhere if named is None else named
            if limit:
                return abs(first - second) <= limit * max(1.0, abs(first), abs(second))
            return first == second and math.copysign(1.0, first) == math.copysign(1.0, second)
        if named and isinstance(first, int) and isinstance(second, int):
            return abs(first - second) <= named * max(1, abs(first), abs(second))
        return bool(first == second)

    def _arrays(
        self, first: bytes, second: bytes, path: str, field: str, columns: int
    ) -> Iterator[Difference]:
        """In what two arrays of float32 differ."""
        named = _named(self._tolerance, self._kind, field)
        if first == second or named == math.inf:
            return
        if len(first) != len(second):
            yield Difference(f"len({path})", len(first) // 4 // columns, len(second) // 4 // columns)
            return
        a, b = (np.frombuffer(data, dtype="<f4").astype(np.float64) for data in (first, second))
        limit = self._tolerance.everywhere if named is None else named
        if limit:
            off = np.abs(a - b) > limit * np.maximum(1.0, np.maximum(np.abs(a), np.abs(b)))
        else:
            off = np.frombuffer(first, dtype="<u4") != np.frombuffer(second, dtype="<u4")
        for index in np.flatnonzero(off).tolist():
            row, column = divmod(index, columns)
            place = f"[{row}]" if columns == 1 else f"[{row}][{column}]"
            yield Difference(path + place, float(a[index]), float(b[index]))


@lru_cache(4096)
def _named(tolerance: Tolerance, kind: str, field: str) -> float | None:
    """What a tolerance says of a field by name; None where it says nothing."""
    path = (kind, *field.split("."))
    return next((value for name, value in tolerance.fields if _stands_for(name, path)), None)


def _stands_for(name: str, path: tuple[str, ...]) -> bool:
    """Whether a name is for a field, given with all that it is in, from the message type on."""
    parts = name.split(".")
    return any(
        all(there in (part, ANY) for part, there in zip(parts, path[start:], strict=False))
        and (len(path) - start >= len(parts) or path[-1] == ANY)
        for start, first in enumerate(path)
        if first == parts[0]
    )


@cache
def _paths() -> frozenset[tuple[str, ...]]:
    """All fields of all messages, each with what it is in, from the message type on."""
    kinds = tuple({row.type for row in topics.TOPICS})
    found = msgspec.inspect.multi_type_info(kinds)
    return frozenset(
        path for kind, info in zip(kinds, found, strict=True) for path in _inside((kind.__name__,), info, ())
    )


def _inside(path: tuple[str, ...], info: Any, above: tuple[Any, ...]) -> Iterator[tuple[str, ...]]:
    """The path of a field, and those of the fields in it."""
    yield path
    if isinstance(info, msgspec.inspect.Metadata):
        yield from _inside(path, info.type, above)
    elif isinstance(info, msgspec.inspect.VarTupleType | msgspec.inspect.ListType):
        yield from _inside(path, info.item_type, above)
    elif isinstance(info, msgspec.inspect.TupleType):
        for item in info.item_types:
            yield from _inside(path, item, above)
    elif isinstance(info, msgspec.inspect.UnionType):
        for kind in info.types:
            yield from _inside(path, kind, above)
    elif isinstance(info, msgspec.inspect.DictType | msgspec.inspect.AnyType):
        yield (*path, ANY)
    elif isinstance(info, msgspec.inspect.StructType) and info.cls not in above:
        for field in info.fields:
            yield from _inside((*path, field.name), field.type, (*above, info.cls))
