"""What a parameter type expects, in the words of a scenario file, and what is wrong with data given for it.

The decoder refuses the same data, but names neither the index in a list, nor the value, nor what is valid.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, get_args, get_type_hints

import msgspec
from msgspec import inspect

LONGEST_VALUE = 60
"""Values are cut to this many characters in messages."""


@cache
def type_of(kind: type[msgspec.Struct]) -> inspect.StructType:
    """The description of a parameter type."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    return info


def plain(kind: inspect.Type) -> inspect.Type:
    """A type without its metadata."""
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def problems(kind: inspect.Type, value: Any, path: str = "") -> Iterator[str]:
    """What keeps `value`, made of what TOML or JSON decodes to, from being a `kind`; one line each."""
    kind = plain(kind)
    if isinstance(kind, inspect.UnionType):
        if (chosen := _alternative(kind, value)) is not None:
            yield from problems(chosen, value, path)
        elif isinstance(value, Mapping) and (tagged := _tagged(kind)):
            yield _tag_problem(tagged, value, path)
        else:
            yield f"{path} = {shown(value)}: must be {expected(kind)}"
    elif isinstance(kind, inspect.StructType) and isinstance(value, Mapping):
        yield from _in_struct(kind, value, path)
    elif isinstance(kind, inspect.DictType) and isinstance(value, Mapping):
        for key, entry in value.items():
            yield from problems(kind.value_type, entry, joined(path, str(key)))
    elif isinstance(kind, inspect.AnyType) and isinstance(value, Mapping):
        for key, entry in value.items():
            yield from problems(kind, entry, joined(path, str(key)))
    elif isinstance(kind, inspect.AnyType) and _is_list(value):
        for index, entry in enumerate(value):
            yield from problems(kind, entry, f"{path}[{index}]")
    elif isinstance(kind, inspect.VarTupleType | inspect.TupleType) and _is_list(value):
        yield from _in_list(kind, value, path)
    elif not _fits(kind, value):
        yield f"{path} = {shown(value)}: must be {expected(kind)}"


def expected(kind: inspect.Type) -> str:
    """What a value of this type is, as in "a number > 0"."""
    kind = plain(kind)
    match kind:
        case inspect.UnionType():
            members = [one for one in _members(kind) if not isinstance(one, inspect.NoneType)]
            return ", or ".join(dict.fromkeys(map(expected, members)))
        case inspect.StructType() | inspect.DictType():
            return "a table"
        case inspect.TupleType():
            kinds = list(dict.fromkeys(map(expected, kind.item_types)))
            return f"a list of {len(kind.item_types)}, each {kinds[0]}"
        case inspect.VarTupleType():
            if any(isinstance(one, inspect.StructType) for one in _members(kind.item_type)):
                return "a list of tables" + (f", at least {kind.min_length}" if kind.min_length else "")
            least = f"at least {kind.min_length}, each" if kind.min_length else "any length, each"
            return f"a list of {least} {expected(kind.item_type)}"
        case inspect.LiteralType():
            return "one of " + ", ".join(map(str, kind.values))
        case inspect.FloatType() | inspect.IntType():
            what = "a whole number" if isinstance(kind, inspect.IntType) else "a finite number"
            return " ".join((what, *_limits(kind)))
        case inspect.StrType():
            return f"text that matches {kind.pattern}" if kind.pattern else "text"
        case inspect.BoolType():
            return "true or false"
        case inspect.AnyType():
            return "text, a finite number, true or false, or a list or table of such"
        case _:
            raise TypeError(f"no parameter is a {kind}")


def _members(kind: inspect.Type) -> list[inspect.Type]:
    """The types of a union, or the one type."""
    kind = plain(kind)
    return [plain(one) for one in kind.types] if isinstance(kind, inspect.UnionType) else [kind]


def literals(kind: inspect.StructType, name: str) -> inspect.Type:
    """The type of a field; a choice lists its values as declared (msgspec sorts them)."""
    field = next(field for field in kind.fields if field.name == name)
    if isinstance(plain(field.type), inspect.LiteralType):
        return inspect.LiteralType(get_args(get_type_hints(kind.cls)[name]))
    return field.type


def joined(path: str, key: str) -> str:
    """A dotted path with one more key."""
    return f"{path}.{key}" if path else key


def shown(value: Any) -> str:
    """A value as messages show it."""
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."


def _in_struct(kind: inspect.StructType, value: Mapping[str, Any], path: str) -> Iterator[str]:
    names = [field.name for field in kind.fields]
    if kind.tag_field is not None:
        names.insert(0, kind.tag_field)
        if (found := value.get(kind.tag_field)) != kind.tag:
            yield f"{joined(path, kind.tag_field)} = {shown(found)}: must be {kind.tag}"
    for key in value:
        if key not in names:
            yield f"{joined(path, str(key))}: unknown field; valid: {', '.join(names)}"
    for field in kind.fields:
        here = joined(path, field.name)
        if field.name in value:
            yield from problems(literals(kind, field.name), value[field.name], here)
        elif field.required:
            yield f"{here}: missing; must be {expected(literals(kind, field.name))}"


def _in_list(
    kind: inspect.VarTupleType | inspect.TupleType, value: Sequence[Any], path: str
) -> Iterator[str]:
    if isinstance(kind, inspect.TupleType):
        if len(value) != len(kind.item_types):
            yield f"{path} = {shown(value)}: must be {expected(kind)}"
            return
        kinds: Sequence[inspect.Type] = kind.item_types
    else:
        if len(value) < (kind.min_length or 0):
            yield f"{path} = {shown(value)}: must be {expected(kind)}"
        kinds = [kind.item_type] * len(value)
    for index, (one, entry) in enumerate(zip(kinds, value, strict=True)):
        if not (isinstance(entry, float) and _fits(plain(one), entry)):
            yield from problems(one, entry, f"{path}[{index}]")


def _alternative(union: inspect.UnionType, value: Any) -> inspect.Type | None:
    """The type of the union that the value is meant to be."""
    if isinstance(value, Mapping) and (tagged := _tagged(union)):
        return next((table for table in tagged if table.tag == value.get(table.tag_field or "")), None)
    if value is None:
        meant: tuple[type[inspect.Type], ...] = (inspect.NoneType,)
    elif isinstance(value, Mapping):
        meant = (inspect.StructType,)
    elif _is_list(value):
        meant = (inspect.TupleType, inspect.VarTupleType)
    elif isinstance(value, str):
        meant = (inspect.StrType,)
    elif isinstance(value, bool):
        meant = (inspect.BoolType,)
    else:
        meant = (inspect.FloatType,) if _is_number(value) else ()
    return next((kind for kind in _members(union) if isinstance(kind, meant)), None)


def _tagged(union: inspect.UnionType) -> list[inspect.StructType]:
    """The tables of a union that are told apart by one of their fields."""
    return [one for one in _members(union) if isinstance(one, inspect.StructType) and one.tag_field]


def _tag_problem(tables: Sequence[inspect.StructType], value: Mapping[str, Any], path: str) -> str:
    field = tables[0].tag_field or ""
    said = f" = {shown(value[field])}:" if field in value else ": missing;"
    return f"{joined(path, field)}{said} must be one of {', '.join(str(table.tag) for table in tables)}"


def _fits(kind: inspect.Type, value: Any) -> bool:
    """Whether a value that is no table or list is of this type."""
    match kind:
        case inspect.FloatType():
            return _is_number(value) and _is_finite(value) and _within(kind, value)
        case inspect.IntType():
            return isinstance(value, int) and not isinstance(value, bool) and _within(kind, value)
        case inspect.LiteralType():
            return isinstance(value, str) and value in kind.values
        case inspect.StrType():
            return isinstance(value, str) and (
                kind.pattern is None or bool(re.fullmatch(kind.pattern, value))
            )
        case inspect.BoolType():
            return isinstance(value, bool)
        case inspect.AnyType():
            return value is None or isinstance(value, bool | str) or (_is_number(value) and _is_finite(value))
        case _:
            return isinstance(kind, inspect.NoneType) and value is None


def _is_plain(value: Any) -> bool:
    """Whether a value is the same again after it was written as JSON."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) for key in value) and all(map(_is_plain, value.values()))
    if _is_list(value):
        return all(map(_is_plain, value))
    return isinstance(value, str | bool) or (_is_number(value) and _is_finite(value))


def _limits(kind: inspect.FloatType | inspect.IntType) -> list[str]:
    pairs = ((">", kind.gt), (">=", kind.ge), ("<", kind.lt), ("<=", kind.le))
    texts = [f"{sign} {limit}" for sign, limit in pairs if limit is not None]
    return [" and ".join(texts)] if texts else []


def _within(kind: inspect.FloatType | inspect.IntType, value: float) -> bool:
    return (
        (kind.gt is None or value > kind.gt)
        and (kind.ge is None or value >= kind.ge)
        and (kind.lt is None or value < kind.lt)
        and (kind.le is None or value <= kind.le)
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple)
