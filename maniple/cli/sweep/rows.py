"""What a run of a sweep leaves: its figures as columns."""

import json
from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import inspect

from maniple.cli.api import Result
from maniple.cli.progress import Progress

Kind: TypeAlias = Literal["float", "int", "bool", "text", "texts"]

LEFT_OUT = (
    "mode",
    "seed",
    "wall_s",
    "real_time_factor",
    "log",
    "logs",
    "unrecorded",
    "without_truth",
    "restarts",
    "interrupted",
)
"""Of `Result`: what is the same for every run of a sweep, told by another column, or about real processes."""


class Column(NamedTuple):
    """A figure of every run."""

    name: str
    kind: Kind
    """Tables whose keys are not known before are text: JSON."""
    path: tuple[str, ...] = ()
    """Where in a `Result` it is; empty where it is not from there."""


class Row(msgspec.Struct, frozen=True):
    """One finished run, as a line of the file of rows."""

    id: str
    figures: dict[str, Any] = {}
    """By the names of `columns`; empty where the run failed."""
    error: str | None = None
    """What was raised."""


@cache
def columns() -> tuple[Column, ...]:
    """The figures of a run: those of `Result`, tables spread out as TABLE_FIELD, and how far it came."""
    info = inspect.type_info(Result)
    assert isinstance(info, inspect.StructType)
    return (*_columns(info, ()), Column("task_share", "float"), Column("mean_rate", "float"))


def figures(result: Result, last: Progress | None) -> dict[str, Any]:
    """The figures of a run by column; `last` is the last progress it told."""
    table = msgspec.to_builtins(result)
    found = {column.name: _value(table, column) for column in columns() if column.path}
    time_s, of_s = (last.task_time_s, last.task_duration_s) if last is not None else (0.0, 0.0)
    share = 1.0 if result.completed else min(time_s / of_s, 1.0) if of_s > 0.0 else 0.0
    rate = time_s / result.duration_s if result.duration_s > 0.0 else 0.0
    return found | {"task_share": round(share, 6), "mean_rate": round(rate, 6)}


def _value(table: Any, column: Column) -> Any:
    for key in column.path:
        table = table[key]
    return json.dumps(table) if isinstance(table, dict) else table


def _columns(info: inspect.StructType, path: tuple[str, ...]) -> list[Column]:
    found: list[Column] = []
    for field in info.fields:
        here, kind = (*path, field.name), _plain(field.type)
        if isinstance(kind, inspect.StructType):
            found += _columns(kind, here)
        elif field.name not in LEFT_OUT:
            found.append(Column("_".join(here), _kind(kind), here))
    return found


def _plain(kind: inspect.Type) -> inspect.Type:
    """A type without its metadata and without None."""
    kind = kind.type if isinstance(kind, inspect.Metadata) else kind
    if isinstance(kind, inspect.UnionType):
        (kind,) = (one for one in kind.types if not isinstance(one, inspect.NoneType))
        return _plain(kind)
    return kind


def _kind(kind: inspect.Type) -> Kind:
    match kind:
        case inspect.FloatType():
            return "float"
        case inspect.BoolType():
            return "bool"
        case inspect.IntType():
            return "int"
        case inspect.ListType() | inspect.VarTupleType():
            return "texts"
        case _:
            return "text"
