"""Messages as rows of a table: which columns each type has, and how values become arrays.

A message is a row. Nested structs are flattened (`answers.seq`), tuples of known length too
(`reference.x_m`). Float arrays and lists stay together in one column. What a message has several of (robots,
triangles, calls) can be had a row each. What has no fixed form (a task, counters) is JSON text.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from operator import attrgetter
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from maniple.core.messages import (
    Command,
    ExternalPose,
    FormationState,
    Message,
    Motion,
    Odometry,
    Scan,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.time import SECOND, Time

Kind: TypeAlias = Literal[
    "int", "float", "float32", "bool", "text", "bytes", "json", "ints", "floats", "texts", "array"
]
"""What a column holds. "array": a list of float32 numbers, or of rows of `Column.parts`."""

DTYPES: Mapping[Kind, Any] = {
    "int": np.int64,
    "float": np.float64,
    "float32": np.float32,
    "bool": np.bool_,
    "text": object,
    "bytes": object,
    "json": object,
    "ints": np.int64,
    "floats": np.float64,
    "texts": object,
    "array": np.float32,
}

UNITS = {
    "_radps": "rad/s",
    "_kbps": "kbit/s",
    "_mps": "m/s",
    "_rad": "rad",
    "_ns": "ns",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
}
"""By the end of a name."""

PARTS: Mapping[tuple[type, str], tuple[str, ...]] = {
    (Scan, "mount"): ("x_m", "y_m", "psi_rad"),
    (Scan, "beams"): ("x_m", "y_m", "direction_rad"),
    (Scan, "ranges"): ("range_m",),
    (Command, "values"): ("0", "1"),
    (FormationState, "reference"): ("x_m", "y_m", "psi_rad"),
    (FormationState, "reference_velocity"): ("x_mps", "y_mps", "psi_radps"),
    (FormationState, "errors"): ("x_m", "y_m", "psi_F_rad", "p_m", "q_m", "beta_rad"),
    (FormationState, "points"): ("x_m", "y_m"),
    (Motion, "applied"): ("u_mps", "w_radps"),
    (Motion, "pose"): ("x_m", "y_m", "psi_rad"),
    (Motion, "twist"): ("u_mps", "w_radps", "v_mps"),
    (Odometry, "motion_pose"): ("x_m", "y_m", "psi_rad"),
    (Status, "limits"): ("u_max_mps", "w_max_radps", "v_max_mps"),
    (ExternalPose, "pose"): ("x_m", "y_m", "psi_rad"),
    (ExternalPose, "sigma"): ("x_m", "y_m", "psi_rad"),
    (Truth, "poses"): ("x_m", "y_m", "psi_rad"),
    (Truth, "velocities"): ("u_mps", "w_radps"),
    (Truth, "clearances"): ("clearance_m",),
    (Truth, "sideways"): ("v_mps",),
}
"""What the numbers of a tuple or of a row of a float array are, as the docstrings in `messages` say."""


class Row(NamedTuple):
    """What a row of a table is made of."""

    topic: str
    log_time_ns: Time
    message: Message
    place: int
    """Which of the elements of the message."""
    element: Any
    """The message itself, or one of those."""


class Column(NamedTuple):
    """One column of a table."""

    name: str
    kind: Kind
    get: Callable[[Row], Any]
    """Its value; None for none, bytes of an array as in the message."""
    unit: str = ""
    """Of a single number, or of all numbers of a list."""
    parts: tuple[str, ...] = ()
    """Of an array: what the numbers of each of its rows are."""
    optional: bool = False
    """Whether a row may have no value."""

    @property
    def is_list(self) -> bool:
        """Whether a row holds several values."""
        return self.kind in ("ints", "floats", "texts", "array")


class Form(NamedTuple):
    """How messages of one type become rows."""

    columns: tuple[Column, ...]
    elements: Callable[[Any], Iterable[Any]]
    """The elements of a message, a row each."""


class Cells(NamedTuple):
    """The values of one column."""

    values: NDArray[Any]
    """One for each row; of lists all numbers of all rows, one after the other, of arrays (k, numbers)."""
    lengths: NDArray[np.int64] | None = None
    """Of lists and arrays: how many values belong to each row."""
    known: NDArray[np.bool_] | None = None
    """Which rows have a value; None: all."""


def form(kind: type[Message], each: str, identity: str, start_ns: Time) -> Form:
    """How messages of a type become rows: one each, or one for each of their `each`.

    `identity` names what the second part of the topic says ("robot" or "node"; empty: nothing). `t_s` counts
    from `start_ns`.

    Raises:
        KeyError: messages of this type have no such elements.
    """
    columns, elements = _forms(kind)[each]
    head = [Column("topic", "text", attrgetter("topic"))]
    if identity:
        head.append(Column(identity, "text", lambda row: row.topic.split("/")[1]))
    head += [
        Column("t_s", "float", lambda row: (row.log_time_ns - start_ns) / SECOND, "s"),
        Column("log_time_ns", "int", attrgetter("log_time_ns"), "ns"),
        Column("source", "text", attrgetter("message.source")),
        Column("incarnation", "int", attrgetter("message.incarnation")),
        Column("seq", "int", attrgetter("message.seq")),
        Column("stamp_ns", "int", attrgetter("message.stamp_ns"), "ns"),
    ]
    if each:
        head.append(Column("index", "int", attrgetter("place")))
    taken = {column.name for column in head}
    renamed = [c._replace(name=f"{each}.{c.name}") if c.name in taken else c for c in columns]
    return Form((*head, *renamed), elements)


def parts_of(kind: type[Message]) -> tuple[str, ...]:
    """What messages of a type have several of, so that a table can have a row for each."""
    return tuple(each for each in _forms(kind) if each)


def rows_of(form: Form, topic: str, log_time_ns: Time, message: Message) -> Iterator[Row]:
    """The rows of one message."""
    for place, element in enumerate(form.elements(message)):
        yield Row(topic, log_time_ns, message, place, element)


def fits(columns: Iterable[Column], row: Row) -> bool:
    """Whether every whole number of a row has room in 64 bits."""
    numbers = (value for c in columns if c.kind in ("int", "ints") for value in _listed(c.get(row)))
    return all(-(2**63) <= number < 2**63 for number in numbers)


def cells(column: Column, rows: Sequence[Row]) -> Cells:
    """The values of a column.

    Raises:
        OverflowError: a whole number has no room in 64 bits.
    """
    values = [column.get(row) for row in rows]
    if column.kind == "array":
        data = np.frombuffer(b"".join(values), dtype="<f4").astype(np.float32)
        lengths = np.array([len(value) for value in values], dtype=np.int64) // (4 * len(column.parts))
        return Cells(data.reshape(-1, len(column.parts)) if len(column.parts) > 1 else data, lengths)
    if column.is_list:
        lengths = np.array([len(value) for value in values], dtype=np.int64)
        return Cells(_array(list(chain.from_iterable(values)), column.kind), lengths)
    known = np.array([value is not None for value in values], dtype=np.bool_)
    if known.all():
        return Cells(_array(values, column.kind))
    empty = _EMPTY[column.kind]
    return Cells(_array([empty if value is None else value for value in values], column.kind), None, known)


_EMPTY: Mapping[Kind, Any] = {
    "int": 0,
    "float": np.nan,
    "float32": np.nan,
    "bool": False,
    "text": None,
    "bytes": None,
    "json": None,
}


def _array(values: list[Any], kind: Kind) -> NDArray[Any]:
    if DTYPES[kind] is object:
        array = np.empty(len(values), dtype=object)
        same: dict[Any, Any] = {}  # of equal texts one is kept
        array[:] = [same.setdefault(value, value) for value in values]
        return array
    return np.array(values, dtype=DTYPES[kind])


def _listed(value: Any) -> Iterable[int]:
    if value is None:
        return ()
    return value if isinstance(value, tuple) else (value,)


@cache
def _forms(kind: type[Message]) -> dict[str, Form]:
    """Columns and elements of a type, by what a row is for: "" for a row a message."""
    found = {"": Form(tuple(_columns(kind, skip=frozenset(Message.__struct_fields__))), lambda m: (m,))}
    for name, hint in get_type_hints(kind).items():
        if part := _element(hint):
            found[name] = Form(tuple(_columns(part)), attrgetter(name))
    return found | _ALIGNED.get(kind, {})


def _columns(
    kind: type[msgspec.Struct], path: str = "", may_lack: bool = False, skip: frozenset[str] = frozenset()
) -> Iterator[Column]:
    """The columns of a struct that is at `path` of an element. Of a message the header is to `skip`, and its
    lists of structs are left out: they have rows of their own."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if name in skip or (skip and _element(hint)):
            continue
        full = f"{path}{name}"
        base, described, optional = _stripped(hint)
        lacking = may_lack or optional
        get = _getter(full, lacking)
        if isinstance(base, type) and issubclass(base, msgspec.Struct):
            yield from _columns(base, f"{full}.", lacking)
        elif base is bytes and "float32" in described:
            parts = PARTS[kind, name]
            yield Column(full, "array", get, _unit(parts[0]) if len(parts) == 1 else "", parts)
        elif get_origin(base) is tuple and get_args(base)[-1] is not ... and set(get_args(base)) == {float}:
            for place, part in enumerate(PARTS[kind, name]):
                yield Column(f"{full}.{part}", "float", _item(get, place), _unit(part), optional=lacking)
        else:
            which = _kind(base)
            if which == "json":
                yield Column(full, which, _as_json(get), optional=lacking)
            else:
                yield Column(full, which, get, _unit(name), optional=lacking)


def _kind(base: Any) -> Kind:
    """What a column of this type holds."""
    plain: dict[Any, Kind] = {int: "int", float: "float", bool: "bool", str: "text", bytes: "bytes"}
    lists: dict[Any, Kind] = {int: "ints", float: "floats", str: "texts"}
    if get_origin(base) is Literal:
        return "text"
    if get_origin(base) is tuple and get_args(base)[1:] == (...,):
        return lists.get(get_args(base)[0], "json")
    return plain.get(base, "json")


def _stripped(hint: Any) -> tuple[Any, str, bool]:
    """A type without its annotation and without None; what the annotation says; whether it may be None."""
    described = ""
    if get_origin(hint) is Annotated:
        described = "".join(m.description or "" for m in hint.__metadata__ if isinstance(m, msgspec.Meta))
        hint = get_args(hint)[0]
    if get_origin(hint) in (Union, UnionType):
        rest = [part for part in get_args(hint) if part is not NoneType]
        if len(rest) < len(get_args(hint)):
            return _stripped(rest[0])[0] if len(rest) == 1 else None, described, True
    return hint, described, False


def _element(hint: Any) -> type[msgspec.Struct] | None:
    """What a list of structs is made of; None for any other field."""
    if get_origin(hint) is not tuple:
        return None
    part = get_args(hint)[0]
    return part if isinstance(part, type) and issubclass(part, msgspec.Struct) else None


def _getter(path: str, may_lack: bool) -> Callable[[Row], Any]:
    if not may_lack:
        return attrgetter(f"element.{path}")
    names = path.split(".")

    def get(row: Row) -> Any:
        value = row.element
        for name in names:
            if value is None:
                return None
            value = getattr(value, name)
        return value

    return get


def _item(get: Callable[[Row], Any], place: int) -> Callable[[Row], Any]:
    def item(row: Row) -> Any:
        values = get(row)
        return None if values is None else values[place]

    return item


def _as_json(get: Callable[[Row], Any]) -> Callable[[Row], str | None]:
    def text(row: Row) -> str | None:
        value = get(row)
        return None if value is None else msgspec.json.encode(value).decode()

    return text


def _unit(name: str) -> str:
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")


def _aligned(label: str, kind: type[Message], *arrays: str, optional: str = "") -> tuple[Column, ...]:
    """The columns of elements that are a label and then the numbers of a row of each array."""
    element = attrgetter("element")
    names = [(part, array == optional) for array in arrays for part in PARTS[kind, array]]
    numbers = (
        Column(name, "float32", _item(element, place), _unit(name), optional=lacking)
        for place, (name, lacking) in enumerate(names, 1)
    )
    return Column(label, "text", _item(element, 0)), *numbers


def _robots(truth: Truth) -> Iterator[tuple[Any, ...]]:
    arrays = zip(
        unpack_floats(truth.poses, 3).tolist(),
        unpack_floats(truth.velocities, 2).tolist(),
        unpack_floats(truth.clearances).tolist(),
        strict=False,
    )
    sideways = unpack_floats(truth.sideways).tolist()
    for place, (robot, (pose, velocity, clearance)) in enumerate(zip(truth.robots, arrays, strict=False)):
        yield robot, *pose, *velocity, clearance, sideways[place] if place < len(sideways) else None


def _triangles(state: FormationState) -> Iterator[tuple[Any, ...]]:
    triples = zip(state.chain, state.chain[1:], state.chain[2:], strict=False)
    for robots, errors in zip(triples, unpack_floats(state.errors, 6).tolist(), strict=False):
        yield "|".join(robots), *errors


def _places(state: FormationState) -> Iterator[tuple[Any, ...]]:
    for robot, point in zip(state.chain, unpack_floats(state.points, 2).tolist(), strict=False):
        yield robot, *point


_ALIGNED: Mapping[type[Message], dict[str, Form]] = {
    Truth: {
        "robots": Form(
            _aligned("robot", Truth, "poses", "velocities", "clearances", "sideways", optional="sideways"),
            _robots,
        )
    },
    FormationState: {
        "triangles": Form(_aligned("robots", FormationState, "errors"), _triangles),
        "chain": Form(_aligned("robot", FormationState, "points"), _places),
    },
}
"""What is spread over arrays of one length, a row for each place in them."""
