"""A sweep file: a scenario, lists of values for its fields, seeds, and what to plot."""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from msgspec import Meta

from maniple.cli.loading import table_of
from maniple.core.errors import ScenarioError
from maniple.core.scenario.fields import shown
from maniple.core.scenario.parse import parameters_of, with_overrides
from maniple.core.scenario.types import Name, Parameters, PositiveSeconds
from maniple.report.sweep_types import Plot

Seed = Annotated[int, Meta(ge=0, le=2**53)]

MOST_RUNS = 1_000_000
"""In a sweep."""


class SweepFile(Parameters, frozen=True, kw_only=True):
    """What a sweep file says."""

    name: Name
    """What the folder of its results is called."""
    description: str = ""
    """For people."""
    scenario: str
    """Scenario file, relative to this one."""
    set: tuple[str, ...] = ()
    """Changes of the scenario that hold for all runs, as `--set` takes them."""
    duration_s: PositiveSeconds | None = None
    """Each run ends after this much simulated time, done or not; by default as `maniple run` ends it."""
    seeds: float | tuple[Seed, ...] = 1.0
    """Each combination runs with each of these seeds; a number stands for 1 to that."""
    grid: dict[str, Any]
    """Axes; see `axes_of`."""
    plots: tuple[Plot, ...] = ()
    """Pictures of the results."""


class Level(NamedTuple):
    """One value of an axis."""

    value: Any
    """What its column holds: a number, text, or true or false."""
    settings: tuple[tuple[str, Any], ...]
    """(key, value) to replace in the scenario, in order. Keys are as in `--set`, and `*` stands for every
    entry of a list; `robots` may be a number."""


class Axis(NamedTuple):
    """One dimension of the grid."""

    name: str
    levels: tuple[Level, ...]


class Combination(NamedTuple):
    """One point of the grid."""

    values: tuple[Any, ...]
    """Of each axis."""
    overrides: tuple[str, ...]
    """What makes the scenario this one, as `--set` takes it."""


def read_sweep(path: Path) -> SweepFile:
    """The sweep in a TOML file.

    Raises:
        ScenarioError: names the file, and what is wrong with it.
    """
    data = table_of(path)
    try:
        sweep = parameters_of(SweepFile, data)
        seeds_of(sweep)
        axes_of(sweep.grid)
    except ScenarioError as error:
        raise ScenarioError("\n".join(f"{path}: {line}" for line in str(error).splitlines())) from None
    return sweep


def seeds_of(sweep: SweepFile) -> tuple[int, ...]:
    """The seeds of a sweep.

    Raises:
        ScenarioError: not a whole number from 1 on, none, or one that is there twice.
    """
    seeds = sweep.seeds
    if isinstance(seeds, float):
        if not (seeds.is_integer() and 1 <= seeds <= MOST_RUNS):
            raise ScenarioError(f"seeds = {seeds:g}: must be a whole number >= 1, or a list of seeds")
        return tuple(range(1, int(seeds) + 1))
    if not seeds or len(set(seeds)) < len(seeds):
        raise ScenarioError(f"seeds = {shown(list(seeds))}: must be at least one, each once")
    return seeds


def axes_of(grid: Mapping[str, Any]) -> tuple[Axis, ...]:
    """The axes of a grid, in the order of the file. Each is one of

    - `KEY = [values]`, KEY a field of the scenario as `--set` names it;
    - `NAME = { keys = [KEYS], values = [values] }`: the same value for several fields;
    - `NAME = { points = { LABEL = ["KEY=VALUE", ...], ... } }`: fields that change together.

    Raises:
        ScenarioError: an axis that is none of these, is empty, or has a value twice.
    """
    axes = tuple(_axes(grid, ""))
    if not axes:
        raise ScenarioError("grid: is empty; must have a list of values for at least one field")
    names = [axis.name for axis in axes]
    for axis in axes:
        values = [json.dumps(level.value) for level in axis.levels]
        if names.count(axis.name) > 1:
            raise ScenarioError(f"grid.{axis.name}: is there twice; must be once")
        if not values or len(set(values)) < len(values):
            raise ScenarioError(f"grid.{axis.name}: must have at least one value, each once")
    return axes


def combinations(axes: Sequence[Axis], table: Mapping[str, Any]) -> Iterator[Combination]:
    """Every point of the grid over the scenario `table`; the last axis varies fastest.

    Raises:
        ScenarioError: a key leads nowhere.
    """
    for levels in product(*(axis.levels for axis in axes)):
        overrides: list[str] = []
        changed: Mapping[str, Any] = table
        for key, value in (setting for level in levels for setting in level.settings):
            added = list(_overrides(changed, key, value))
            changed = with_overrides(changed, added)
            overrides += added
        yield Combination(tuple(level.value for level in levels), tuple(overrides))


def toml_text(value: Any) -> str:
    """A value as `--set` takes it, on one line of TOML."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{json.dumps(key)} = {toml_text(entry)}" for key, entry in value.items())
        return "{" + inner + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _axes(table: Mapping[str, Any], path: str) -> Iterator[Axis]:
    for key, entry in table.items():
        here = f"{path}.{key}" if path else key
        if isinstance(entry, list):
            yield Axis(here, tuple(Level(_cell(value), ((here, value),)) for value in entry))
        elif not isinstance(entry, Mapping) or not entry:
            raise ScenarioError(f"grid.{here} = {shown(entry)}: must be a list of values")
        elif "keys" in entry or "values" in entry:
            yield _linked(here, entry)
        elif isinstance(entry.get("points"), Mapping):
            yield _labelled(here, entry)
        else:
            yield from _axes(entry, here)


def _linked(name: str, entry: Mapping[str, Any]) -> Axis:
    keys, values = entry.get("keys", []), entry.get("values")
    if set(entry) != {"keys", "values"} or not _texts(keys) or not isinstance(values, list):
        raise ScenarioError(
            f"grid.{name} = {shown(entry)}: must have keys, a list of fields, and values, and nothing else"
        )
    return Axis(name, tuple(Level(_cell(value), tuple((key, value) for key in keys)) for value in values))


def _labelled(name: str, entry: Mapping[str, Any]) -> Axis:
    if set(entry) != {"points"}:
        raise ScenarioError(f"grid.{name} = {shown(entry)}: must have points and nothing else")
    levels = []
    for label, texts in entry["points"].items():
        if not (texts == [] or _texts(texts)):
            raise ScenarioError(f'grid.{name}.points.{label} = {shown(texts)}: must be ["KEY=VALUE", ...]')
        levels.append(Level(label, tuple(_setting(f"grid.{name}.points.{label}", text) for text in texts)))
    return Axis(name, tuple(levels))


def _setting(where: str, text: str) -> tuple[str, Any]:
    """An override, with its value taken as TOML where it is."""
    key, equals, value = text.partition("=")
    try:
        if not (equals and key.strip()):
            raise ScenarioError("must be KEY=VALUE")
        return key.strip(), with_overrides({}, [f"value={value}"])["value"]
    except ScenarioError as error:
        raise ScenarioError(f"{where}: {text!r}: {error}") from None


def _texts(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, str) and one for one in value)


def _cell(value: Any) -> Any:
    """What a column holds of a value: lists and tables as text."""
    return toml_text(value) if isinstance(value, list | Mapping) else value


def _overrides(table: Mapping[str, Any], key: str, value: Any) -> Iterator[str]:
    if key == "robots" and isinstance(value, int) and not isinstance(value, bool):
        value = _platoon(table, value)
    for one in _keys(table, key.split(".")):
        yield f"{'.'.join(one)}={toml_text(value)}"


def _platoon(table: Mapping[str, Any], count: int) -> list[dict[str, Any]]:
    """So many robots, r1 and on, each like the first of the scenario."""
    robots = table.get("robots")
    first = robots[0] if isinstance(robots, list) and robots and isinstance(robots[0], Mapping) else {}
    like = {key: value for key, value in first.items() if key not in ("id", "pose")}
    return [{"id": f"r{number}", **like} for number in range(1, count + 1)]


def _keys(table: Any, parts: Sequence[str], done: Sequence[str] = ()) -> Iterator[Sequence[str]]:
    """The key with each `*` replaced by the index of every entry there."""
    if "*" not in parts:
        yield [*done, *parts]
        return
    head, rest = parts[0], parts[1:]
    if head != "*":
        yield from _keys(_within(table, head), rest, [*done, head])
        return
    if not isinstance(table, list) or not table:
        where = ".".join(done)
        raise ScenarioError(f"{'.'.join([*done, *parts])}: {where or 'the scenario'} has no entries for *")
    for index, entry in enumerate(table):
        yield from _keys(entry, rest, [*done, str(index)])


def _within(table: Any, key: str) -> Any:
    if isinstance(table, Mapping):
        return table.get(key)
    if isinstance(table, list):
        ids = [entry.get("id") for entry in table if isinstance(entry, Mapping)]
        index = ids.index(key) if key in ids else int(key) if key.isdecimal() else len(table)
        return table[index] if index < len(table) else None
    return None
