"""`docs/scenario.md` and the JSON Schema, both made from the parameter types and their docstrings."""

import ast
import inspect as python
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from typing import Any, get_type_hints

import msgspec
from msgspec import inspect

from maniple.core.scenario import fields, types
from maniple.core.scenario.types import Point, PoseXY, Scenario

UNITS = {
    "_per_s": "1/s",
    "_radps2": "rad/s²",
    "_mps2": "m/s²",
    "_radps": "rad/s",
    "_mps": "m/s",
    "_rad": "rad",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
}
"""Units by the suffix of a field's name, longest first."""


def markdown() -> str:
    """The text of `docs/scenario.md`."""
    intro = (files("maniple.cli") / "scenario_intro.md").read_text(encoding="utf-8")
    first: dict[type, str] = {}
    sections = [
        "\n".join(_section(path, kind))
        for path, kind in _tables("", fields.type_of(Scenario))
        if first.setdefault(kind.cls, path) == path  # what can be at two places is described once
    ]
    return intro.rstrip() + "\n\n" + "\n\n".join(sections) + "\n"


def schema() -> dict[str, Any]:
    """The JSON Schema of a scenario file, with what the docstrings say of each field."""
    document: dict[str, Any] = msgspec.json.schema(Scenario)
    for name, definition in document["$defs"].items():
        said = field_texts().get(name, {})
        for field, entry in definition.get("properties", {}).items():
            if field in said:
                entry["description"] = said[field]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "maniple scenario",
        **document,
    }


@cache
def field_texts() -> dict[str, dict[str, str]]:
    """What the docstring below each field says, by type and field, as one line."""
    texts: dict[str, dict[str, str]] = {}
    for statement in ast.parse(python.getsource(types)).body:
        if not isinstance(statement, ast.ClassDef):
            continue
        texts[statement.name] = {
            field.target.id: _one_line(text.value.value)
            for field, text in zip(statement.body, statement.body[1:], strict=False)
            if isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        }
    return texts


def unit(kind: type, name: str) -> str:
    """The unit of a field, by its name's suffix or its type; empty where it has none."""
    hint = get_type_hints(kind)[name]
    if hint in (PoseXY, PoseXY | None, tuple[PoseXY, ...]):
        return "m, m, rad"
    if hint in (Point, tuple[Point, ...]) or name == "size":
        return "m"
    return next((text for suffix, text in UNITS.items() if name.endswith(suffix)), "")


def _tables(path: str, kind: inspect.StructType) -> Iterator[tuple[str, inspect.StructType]]:
    """Every table of a file under its path, as a TOML header names it: parents before children."""
    yield path, kind
    for field in kind.fields:
        here = fields.joined(path.strip("[]"), field.name)
        for child in _structs(field.type):
            inner = _inner_path(here, fields.plain(field.type))
            yield from _tables(inner, child)


def _structs(kind: inspect.Type) -> Iterator[inspect.StructType]:
    match fields.plain(kind):
        case inspect.StructType() as struct:
            yield struct
        case inspect.VarTupleType(item_type=item):
            yield from _structs(item)
        case inspect.DictType(value_type=value):
            yield from _structs(value)
        case inspect.UnionType(types=kinds):
            for one in kinds:
                yield from _structs(one)


def _inner_path(path: str, kind: inspect.Type) -> str:
    if isinstance(kind, inspect.VarTupleType):
        return f"[[{path}]]"
    return f"[{path}.NAME]" if isinstance(kind, inspect.DictType) else f"[{path}]"


def _section(path: str, kind: inspect.StructType) -> Iterator[str]:
    """The heading, what the type is for, and a row for each field."""
    tag = f' with `{kind.tag_field} = "{kind.tag}"`' if kind.tag_field else ""
    yield f"## `{path}`{tag}" if path else "## Top level"
    yield ""
    yield _one_line(python.getdoc(kind.cls) or "")
    yield ""
    yield "| field | type | unit | default | meaning |"
    yield "|---|---|---|---|---|"
    for field in kind.fields:
        said = field_texts()[kind.cls.__name__][field.name]
        expected = fields.expected(fields.literals(kind, field.name))
        cells = (f"`{field.name}`", expected, unit(kind.cls, field.name), _default(field), said)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(field: inspect.Field) -> str:
    if field.required:
        return "**required**"
    value = field.default
    if isinstance(value, msgspec.Struct):
        own = {one.name: one.default for one in fields.type_of(type(value)).fields}
        given = msgspec.structs.asdict(value)
        if given == own:
            return "as below"
        return f"`{_toml(given)}`"
    if value is None or value is msgspec.NODEFAULT or value == ():
        return "none"
    return f"`{msgspec.json.encode(value).decode()}`"


def _toml(value: object) -> str:
    """An inline table, list or scalar; what TOML can't say, that there is nothing, is left out."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        pairs = [f"{name} = {_toml(one)}" for name, one in value.items() if one is not None]
        return "{ " + ", ".join(pairs) + " }" if pairs else "{}"
    return msgspec.json.encode(value).decode()


def _one_line(text: str) -> str:
    return " ".join(text.split())
