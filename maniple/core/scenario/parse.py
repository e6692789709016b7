"""Data, as TOML or JSON decodes to, into a `Scenario` and back."""

import copy
import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import msgspec

from maniple.core.errors import ScenarioError
from maniple.core.scenario import fields
from maniple.core.scenario.types import Parameters, Scenario

P = TypeVar("P", bound=Parameters)


def scenario_of(data: Mapping[str, Any]) -> Scenario:
    """The scenario that `data` describes.

    Raises:
        ScenarioError: a line for each thing that is wrong: path, value and what would be valid.
    """
    return parameters_of(Scenario, data)


def parameters_of(kind: type[P], data: Any) -> P:
    """The parameters of type `kind` that `data` describes; whole numbers become floats where floats belong.

    Raises:
        ScenarioError: as for `scenario_of`.
    """
    if found := list(fields.problems(fields.type_of(kind), data)):
        raise ScenarioError("\n".join(found))
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ScenarioError(str(error)) from None


def type_problems(scenario: Scenario) -> list[str]:
    """What `scenario_of` would refuse in a scenario built from Python, which checks nothing."""
    try:
        data = msgspec.to_builtins(scenario)
    except (TypeError, ValueError) as error:
        return [str(error)]
    return list(fields.problems(fields.type_of(Scenario), data))


def with_overrides(data: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of `data` with values replaced, each given as "key=value".

    A key is a dotted path; entries of a list are named by index from 0 or, for robots, by id. One past the
    last index appends. A value is written as in TOML, where a bare word is text.

    Raises:
        ScenarioError: an override without "=", a path that leads nowhere, or a value that is not TOML.
    """
    result: dict[str, Any] = copy.deepcopy(dict(data))
    for override in overrides:
        key, equals, text = override.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ScenarioError(f"override {override!r}: must be key=value, as in guard.clearance=false")
        _put(result, path, _value(override, text.strip()))
    return result


def to_json(scenario: Scenario) -> bytes:
    """The scenario as indented JSON; `scenario_of(json_data(...))` gives an equal one back."""
    return msgspec.json.format(msgspec.json.encode(scenario), indent=2)


def digest_of(scenario_json: bytes) -> str:
    """Which scenario it is: the SHA-256 of `to_json`, in hexadecimal."""
    return hashlib.sha256(scenario_json).hexdigest()


def short_digest(scenario: Scenario) -> str:
    """Its first 16 digits, as nodes tell each other which scenario they run."""
    return digest_of(to_json(scenario))[:16]


def json_data(data: bytes) -> dict[str, Any]:
    """The table in JSON bytes.

    Raises:
        ScenarioError: not JSON, or not a table.
    """
    try:
        return msgspec.json.decode(data, type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ScenarioError(f"not valid JSON: {error}") from None


def toml_data(data: bytes) -> dict[str, Any]:
    """The table in TOML bytes.

    Raises:
        ScenarioError: not UTF-8, or not TOML; with the line.
    """
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"not valid TOML: byte {error.start} (line {line}) is not UTF-8 text") from None
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"not valid TOML: {error}") from None


def _value(override: str, text: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError) as error:
        if text[:1] in ("[", "{", '"', "'"):
            raise ScenarioError(f"override {override!r}: the value is not TOML: {error}") from None
        return text
    if len(parsed) > 1:
        raise ScenarioError(f"override {override!r}: must be one value")
    return parsed["value"]


def _put(data: dict[str, Any], path: list[str], value: Any) -> None:
    """Replace what is at `path`, making the tables on the way that are not there yet."""
    here: Any = data
    for depth, key in enumerate(path):
        where = ".".join(path[:depth])
        last = depth == len(path) - 1
        fresh = value if last else ([] if path[depth + 1] == "0" else {})
        if isinstance(here, dict):
            here[key] = fresh if last or here.get(key) is None else here[key]
            here = here[key]
        elif isinstance(here, list):
            index = _index(here, key, where)
            if index == len(here):
                here.append(fresh)
            elif last:
                here[index] = value
            here = here[index]
        else:
            raise ScenarioError(f"override of {'.'.join(path)}: {where} has no parts, it is {here!r}")


def _index(entries: list[Any], key: str, where: str) -> int:
    """Where in a list the entry with this id or this index is."""
    ids = [entry.get("id") for entry in entries if isinstance(entry, dict)]
    if key in ids:
        return ids.index(key)
    if key.isdecimal() and int(key) <= len(entries):
        return int(key)
    valid = f"an index from 0 to {len(entries)}" + (f", or one of {', '.join(map(str, ids))}" if ids else "")
    raise ScenarioError(f"override of {where}.{key}: must be {valid}")
