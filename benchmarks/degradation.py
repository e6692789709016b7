"""`python -m benchmarks.degradation [--jobs N] [--out DIR] [--images DIR]`: all of docs/degradation.md.

Makes the sweeps `sweeps/degradation-*.toml`, those runs that are not in DIR yet, prints the table of what
each placement tolerates, and copies the pictures.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from maniple.cli.processes import environment

SWEEPS = Path(__file__).parents[1] / "sweeps"

NAMES = ("degradation-edge", "degradation-guarded", "degradation-speed", "degradation-compensation")

IN_SHAPE_M = 0.05
"""A platoon whose final shape error is less holds its formation."""

Row = Mapping[str, Any]


class Line(NamedTuple):
    """A line of the table: one placement and loss."""

    placement: str
    loss: float
    thumb_s: float
    """Predicted edge by the rule of thumb, latency each way."""
    linear_s: float
    """And of the linearised loop."""
    in_shape_s: float | None
    """Largest latency up to which every run ends in formation, the guard's age limits out of the way."""
    completed_s: float | None
    """And up to which every run completes its task, with the default guard."""


def held(rows: Sequence[Row], good: Callable[[Row], bool]) -> float | None:
    """The largest latency (s) up to which all rows are good; None if those of the smallest are not."""
    found = None
    for latency in sorted({row["latency_s"] for row in rows}):
        if not all(good(row) for row in rows if row["latency_s"] == latency):
            break
        found = latency
    return found


def in_shape(row: Row) -> bool:
    """Whether a run ended with the task done and the platoon in formation."""
    off = row["final_error_distance_m"]
    return bool(row["completed"]) and off is not None and off < IN_SHAPE_M


def lines(edge: Sequence[Row], guarded: Sequence[Row]) -> Iterator[Line]:
    """The table of what each placement tolerates, from the rows of two sweeps."""
    for placement, loss in dict.fromkeys((row["placement"], row["loss"]) for row in edge):
        free, kept = (
            [row for row in rows if (row["placement"], row["loss"]) == (placement, loss)]
            for rows in (edge, guarded)
        )
        yield Line(
            placement,
            loss,
            free[0]["tolerated_delay_s"] / 2.0,
            free[0]["delay_margin_s"] / 2.0,
            held(free, in_shape),
            held(kept, lambda row: bool(row["completed"]) and row["collisions"] == 0),
        )


def markdown(found: Sequence[Line]) -> str:
    """The table as Markdown."""
    heads = (
        "robot from",
        "loss",
        "rule of thumb",
        "linearised loop",
        "in formation up to",
        "default guard: completes up to",
    )
    cells = [heads, tuple("---" for _ in heads)]
    for line in found:
        times = (line.thumb_s, line.linear_s, line.in_shape_s, line.completed_s)
        cells.append((line.placement, f"{line.loss:.0%}", *map(_seconds, times)))
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def _seconds(time_s: float | None) -> str:
    return "never" if time_s is None else f"{time_s:.2f} s"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the sweeps, print the table, copy the pictures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.degradation")
    parser.add_argument("--jobs", type=int, help="runs at a time; one for each core by default")
    parser.add_argument("--out", type=Path, default=Path("logs"), help="folder of the sweeps' folders")
    parser.add_argument("--images", type=Path, metavar="DIR", help="copy the pictures there")
    asked = parser.parse_args(arguments)
    begin = time.perf_counter()
    tables: dict[str, list[Row]] = {}
    for name in NAMES:
        tables[name] = _made(name, asked.out, asked.jobs, asked.images)
    print(markdown(list(lines(tables[NAMES[0]], tables[NAMES[1]]))))
    runs = sum(map(len, tables.values()))
    print(f"{runs} runs, {time.perf_counter() - begin:.0f} s", file=sys.stderr)


def _made(name: str, out: Path, jobs: int | None, images: Path | None) -> list[Row]:
    """The rows of a sweep, made where they are missing."""
    import pyarrow.parquet as pq

    from maniple.cli.sweep.study import sweep

    console = Console(stderr=True)
    outcome = sweep(SWEEPS / f"{name}.toml", jobs, out / f"sweep-{name}", console=console)
    if outcome.table is None or outcome.failed:
        sys.exit(outcome.first_failure or "interrupted; the same command goes on")
    if images is not None:
        for picture in outcome.pictures:
            shutil.copy(picture, images)
    found: list[Row] = pq.read_table(outcome.table).to_pylist()
    return found


if __name__ == "__main__":
    environment()
    main()
