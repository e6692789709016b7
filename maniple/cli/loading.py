"""Scenario files and catalogues, read and checked."""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeVar

from msgspec.structs import replace

from maniple.cli.way_file import with_files
from maniple.core.errors import ScenarioError
from maniple.core.scenario.check import require_valid
from maniple.core.scenario.parse import json_data, parameters_of, scenario_of, toml_data, with_overrides
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.types import Parameters, RangeFinder, RobotModel, Scenario

LARGEST_FILE = 16 * 2**20
"""Bytes; nothing larger is taken for a scenario."""

P = TypeVar("P", bound=Parameters)


def load(path: Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """The scenario in a TOML file, or in a `.json` one, with overrides applied, resolved and valid.

    Raises:
        ScenarioError: names the file and what is wrong with it.
    """
    return loads(_read(path), overrides, seed, form=_form(path), source=str(path), folder=path.parent)


def table_of(path: Path) -> dict[str, Any]:
    """What a TOML file, or a `.json` one, decodes to.

    Raises:
        ScenarioError: names the file and what is wrong with it.
    """
    data = _read(path)
    try:
        return _table(data, _form(path))
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None


def loads(
    data: bytes,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    *,
    form: Literal["toml", "json"] = "toml",
    source: str = "scenario",
    folder: Path = Path(),
) -> Scenario:
    """The scenario in bytes, as `load` gives it; `source` is what messages call them, and files it names are
    relative to `folder`."""
    try:
        table = with_overrides(_table(data, form), overrides)
        if seed is not None:
            table["seed"] = seed
        return completed(scenario_of(table), folder)
    except ScenarioError as error:
        lines = str(error).splitlines()
        raise ScenarioError("\n".join(f"{source}: {line}" for line in lines)) from None


def completed(scenario: Scenario, folder: Path = Path()) -> Scenario:
    """The scenario with the files it names, relative to `folder`, resolved with the catalogues and checked.

    Raises:
        ScenarioError: a file can't be read, it can't be resolved, or it is not valid.
    """
    resolved = resolve(
        replace(scenario, task=with_files(scenario.task, folder)), robot_models(), range_finders()
    )
    require_valid(resolved)
    return resolved


def robot_models() -> Mapping[str, RobotModel]:
    """The catalogue of robots, by name."""
    return _catalogue("robots", RobotModel)


def range_finders() -> Mapping[str, RangeFinder]:
    """The catalogue of range finders, by name."""
    return _catalogue("sensors", RangeFinder)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(f"{path}: can't be read: {reason}") from None


def _form(path: Path) -> Literal["toml", "json"]:
    return "json" if path.suffix.lower() == ".json" else "toml"


def _table(data: bytes, form: Literal["toml", "json"]) -> dict[str, Any]:
    if len(data) > LARGEST_FILE:
        raise ScenarioError(f"larger than {LARGEST_FILE >> 20} MiB: not a scenario")
    return json_data(data) if form == "json" else toml_data(data)


@cache
def _catalogue(folder: str, kind: type[P]) -> Mapping[str, P]:
    entries = (files("maniple.cli") / "catalogue" / folder).iterdir()
    return {
        entry.name.removesuffix(".toml"): parameters_of(kind, toml_data(entry.read_bytes()))
        for entry in sorted(entries, key=lambda entry: entry.name)
        if entry.name.endswith(".toml")
    }
