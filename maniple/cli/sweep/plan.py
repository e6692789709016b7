"""What a sweep is going to run: every combination checked, every run with an identity of its own."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from maniple.cli.extensions import require_layers
from maniple.cli.loading import completed, table_of
from maniple.cli.sweep.grid import MOST_RUNS, Axis, SweepFile, axes_of, combinations, read_sweep, seeds_of
from maniple.cli.sweep.rows import columns
from maniple.cli.wall_clock import require_simulated
from maniple.control.delay_margin import delay_margin_s
from maniple.control.limits import age_limits
from maniple.core.errors import ScenarioError
from maniple.core.scenario.fields import shown
from maniple.core.scenario.parse import scenario_of, to_json, with_overrides
from maniple.core.scenario.types import Guard, Scenario
from maniple.core.version import __version__
from maniple.report.sweep_types import Plot

OWN_COLUMNS = {"seed", "tolerated_delay_s", "delay_margin_s", "error", "overrides"}
"""Of the results, beside axes and figures."""


class Job(NamedTuple):
    """One run of a sweep."""

    id: str
    """Of the resolved scenario, the duration and the version of maniple: equal runs have equal ones."""
    values: tuple[Any, ...]
    """Of each axis."""
    seed: int
    overrides: tuple[str, ...]
    """What makes the scenario file this run, as `--set` takes it."""
    scenario_json: bytes
    """The resolved scenario."""
    tolerated_delay_s: float
    """Delay of the network, there and back together, that the loop tolerates by the rule of thumb."""
    delay_margin_s: float | None
    """And linearised."""


class Plan(NamedTuple):
    """A sweep, ready to run."""

    sweep: SweepFile
    scenario: Path
    """The scenario file."""
    axes: tuple[Axis, ...]
    jobs: tuple[Job, ...]
    """In the order of the grid, the seeds of a combination together."""


def plan_of(path: Path) -> Plan:
    """The sweep that a file describes.

    Raises:
        ScenarioError: the file is not valid, or a run of it would be refused; says which and why.
    """
    sweep = read_sweep(path)
    axes, seeds = axes_of(sweep.grid), seeds_of(sweep)
    _require_columns(path, axes)
    base = path.parent / sweep.scenario
    count = len(seeds)
    for axis in axes:
        count *= len(axis.levels)
    if count > MOST_RUNS:
        raise ScenarioError(f"{path}: grid: makes {count} runs; must be at most {MOST_RUNS}")
    try:
        table = with_overrides(table_of(base), sweep.set)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    jobs: list[Job] = []
    refused: list[str] = []
    for values, overrides in _combinations(path, axes, table):
        try:
            jobs += _jobs(sweep, table, base.parent, values, overrides, seeds)
        except ScenarioError as error:
            refused.append(f"{_where(axes, values)}: {error}")
    if refused:
        of = count // len(seeds)
        raise ScenarioError(f"{path}: {len(refused)} of {of} combinations can't run; the first, {refused[0]}")
    for index, plot in enumerate(sweep.plots):
        _require_drawable(f"{path}: plots[{index}]", plot, axes)
    return Plan(sweep, base, axes, tuple(jobs))


def tolerated_delay_s(scenario: Scenario) -> float:
    """Delay of the network, both ways together, that every robot of a resolved scenario tolerates by the rule
    of thumb: the age that a guard without limits of its own allows, without what sampling adds."""
    free = replace(scenario, guard=Guard())
    return min(age_limits(free, robot)[1] for robot in scenario.robots) - sampling_s(scenario)


def network_margin_s(scenario: Scenario) -> float | None:
    """The same by the linearised loop; None with robots for which there is none."""
    margins = [delay_margin_s(scenario, robot) for robot in scenario.robots]
    known = [margin for margin in margins if margin is not None]
    return min(known) - sampling_s(scenario) if len(known) == len(margins) else None


def sampling_s(scenario: Scenario) -> float:
    """What sampling adds to the age of data on average: a measurement waits half a period for the next tick
    of the control, a command is held for half a period and waits half a period for the drive."""
    rates = scenario.rates
    return 0.5 / rates.motion_hz + 0.5 / rates.control_hz + 0.5 / rates.drive_hz


def _combinations(
    path: Path, axes: Sequence[Axis], table: Mapping[str, Any]
) -> Iterator[tuple[tuple[Any, ...], tuple[str, ...]]]:
    try:
        yield from combinations(axes, table)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: grid: {error}") from None


def _jobs(
    sweep: SweepFile,
    table: Mapping[str, Any],
    folder: Path,
    values: tuple[Any, ...],
    overrides: tuple[str, ...],
    seeds: Sequence[int],
) -> list[Job]:
    """The runs of a combination, one for each seed."""
    changed = with_overrides(table, overrides)
    jobs = []
    for seed in seeds:
        scenario = completed(scenario_of({**changed, "seed": seed}), folder)
        if seed == seeds[0]:
            require_simulated(scenario, f"{sweep.scenario}: a sweep runs in virtual time")
            require_layers(scenario)
        data = to_json(scenario)
        identity = b"\0".join((data, repr(sweep.duration_s).encode(), __version__.encode()))
        name = hashlib.blake2b(identity, digest_size=8).hexdigest()
        delays = tolerated_delay_s(scenario), network_margin_s(scenario)
        jobs.append(Job(name, values, seed, (*sweep.set, *overrides), data, *delays))
    return jobs


def _where(axes: Sequence[Axis], values: Sequence[Any]) -> str:
    return ", ".join(f"{axis.name} = {shown(value)}" for axis, value in zip(axes, values, strict=True))


def _require_columns(path: Path, axes: Sequence[Axis]) -> None:
    """Refuse an axis that is called as a figure of the results is, but for a number of robots.

    Raises:
        ScenarioError: names the axis.
    """
    taken = {column.name for column in columns()} | OWN_COLUMNS
    for axis in axes:
        counts = axis.name == "robots" and all(isinstance(level.value, int) for level in axis.levels)
        if axis.name in taken and not counts:
            raise ScenarioError(
                f"{path}: grid.{axis.name}: is the name of a column of the results; must have another, as in "
                f"NAME = {{ keys = [{axis.name!r}], values = [...] }}"
            )


def _require_drawable(where: str, plot: Plot, axes: Sequence[Axis]) -> None:
    """Refuse a plot of what is not there.

    Raises:
        ScenarioError: which field, and what would be valid.
    """
    by_name = {axis.name: axis for axis in axes}
    for field, name in (("x", plot.x), ("series", plot.series), ("facets", plot.facets)):
        if name not in by_name and (name or field == "x"):
            raise ScenarioError(f"{where}.{field} = {name!r}: must be an axis: {', '.join(by_name)}")
    if not all(_is_number(level.value) for level in by_name[plot.x].levels):
        raise ScenarioError(f"{where}.x = {plot.x!r}: must be an axis whose values are numbers")
    least = min(level.value for level in by_name[plot.x].levels)
    if plot.log_x and least <= 0:
        raise ScenarioError(f"{where}.log_x: {plot.x} = {least}: has no place on a logarithmic scale")
    drawable = [column.name for column in columns() if column.kind in ("float", "int", "bool")]
    if plot.y not in drawable:
        raise ScenarioError(f"{where}.y = {plot.y!r}: must be one of {', '.join(drawable)}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
