"""Ways from files of comma-separated values: columns t_s, x_m, y_m and, if the formation turns, psi_rad."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

from msgspec.structs import replace

from maniple.core.errors import ScenarioError
from maniple.core.scenario.check_task import LEAST_STEP_S, MOST_SAMPLES
from maniple.core.scenario.types import Csv, Samples, Sequence, Task
from maniple.core.scenario.ways import directions

LARGEST_FILE = 4 * 2**20
"""Bytes; nothing larger is taken for a way."""

REQUIRED = ("t_s", "x_m", "y_m")
COLUMNS = (*REQUIRED, "psi_rad")


def with_files(task: Task, folder: Path) -> Task:
    """The task with the ways that are in files, relative to `folder`, as samples.

    Raises:
        ScenarioError: a file can't be read or is no way: which task, which file, which line.
    """
    if isinstance(task, Sequence):
        return replace(
            task,
            tasks=tuple(
                _loaded(f"task.tasks[{index}]", leg, folder) if isinstance(leg, Csv) else leg
                for index, leg in enumerate(task.tasks)
            ),
        )
    return _loaded("task", task, folder) if isinstance(task, Csv) else task


def samples_of(data: bytes, settle_s: float = 0.0) -> Samples:
    """The way in the bytes of a file; without headings the formation faces along it.

    Raises:
        ScenarioError: which line is wrong, and what it must be.
    """
    rows = list(_rows(data))
    if len(rows) < 2:
        raise ScenarioError(f"has {len(rows)} samples; must be at least 2")
    times = tuple(row["t_s"] for row in rows)
    points = [(row["x_m"], row["y_m"]) for row in rows]
    turns = "psi_rad" in rows[0]
    headings = [row["psi_rad"] for row in rows] if turns else directions(times, points)
    poses = tuple((x, y, psi) for (x, y), psi in zip(points, headings, strict=True))
    return Samples(times_s=times, poses=poses, settle_s=settle_s)


def _loaded(path: str, leg: Csv, folder: Path) -> Samples:
    try:
        with (folder / leg.file).open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
        return samples_of(data, leg.settle_s)
    except ScenarioError as error:
        what = str(error)
    except (OSError, ValueError) as error:
        what = f"can't be read: {getattr(error, 'strerror', None) or error}"
    raise ScenarioError(f"{path}.file = {leg.file!r}: {what}")


def _rows(data: bytes) -> Iterator[dict[str, float]]:
    """The lines below the header, each a number by column."""
    reader = csv.reader(_text(data).splitlines(), strict=True)
    columns: list[str] = []
    count, before = 0, 0.0
    try:
        for cells in filter(None, reader):
            if not columns:
                columns = _columns(cells)
                continue
            line = f"line {reader.line_num}"
            row = _row(columns, cells, line)
            time, count = row["t_s"], count + 1
            if count > MOST_SAMPLES:
                raise ScenarioError(f"has more than {MOST_SAMPLES} samples")
            if count == 1 and time != 0.0:
                raise ScenarioError(f"{line}: t_s = {time}: must be 0 in the first line")
            if count > 1 and time - before < LEAST_STEP_S:
                raise ScenarioError(f"{line}: t_s = {time}: must be at least {LEAST_STEP_S} s after {before}")
            before = time
            yield row
    except csv.Error as error:
        raise ScenarioError(f"line {reader.line_num}: not comma-separated values: {error}") from None


def _text(data: bytes) -> str:
    if len(data) > LARGEST_FILE:
        raise ScenarioError(f"is larger than {LARGEST_FILE >> 20} MiB: not a way")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"line {line}: byte {error.start} of the file is not UTF-8 text") from None


def _columns(cells: list[str]) -> list[str]:
    columns = [cell.strip() for cell in cells]
    known = sorted(columns) in (sorted(REQUIRED), sorted(COLUMNS))
    if not known:
        raise ScenarioError(
            f"has the columns {', '.join(columns)}; must be {', '.join(REQUIRED)} [, psi_rad]"
        )
    return columns


def _row(columns: list[str], cells: list[str], line: str) -> dict[str, float]:
    if len(cells) != len(columns):
        raise ScenarioError(f"{line}: has {len(cells)} values; must be {len(columns)}, one a column")
    row = {}
    for name, cell in zip(columns, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ScenarioError(f"{line}: {name} = {cell.strip()!r}: must be a finite number")
        row[name] = value
    return row
