"""What every benchmark gives: rows of a table, and how they are timed and shown."""

import gc
import math
import time
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from rich.console import Console
from rich.table import Table

WIDTH = 100
"""Columns of the table."""

RATE_HZ = 20.0
"""Of odometry and drives."""


class Budget(NamedTuple):
    """What a row may cost, or has to reach."""

    limit: float
    of: Literal["ours", "ratio"]
    sense: Literal["at most", "at least"] = "at most"


class Row(NamedTuple):
    """One comparison of a benchmark."""

    name: str
    ours: float
    """In `unit`."""
    unit: str
    against: str
    """What the reference is, and where there is none, why."""
    reference: float | None = None
    """In `unit`."""
    budget: Budget | None = None

    @property
    def ratio(self) -> float | None:
        """Ours over the reference."""
        return None if self.reference is None else self.ours / self.reference

    @property
    def met(self) -> bool | None:
        """Whether the budget is kept; None where there is none, or nothing to hold it against."""
        if self.budget is None:
            return None
        figure = self.ours if self.budget.of == "ours" else self.ratio
        if figure is None:
            return None
        return figure <= self.budget.limit if self.budget.sense == "at most" else figure >= self.budget.limit


class Stopwatch:
    """User and system time of this process, all threads, while in the block."""

    seconds = 0.0

    def __enter__(self) -> "Stopwatch":
        gc.collect()
        self._begin = time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.process_time() - self._begin


def cpu_s(action: Callable[[], object]) -> float:
    """User and system time of one call, s."""
    with Stopwatch() as watch:
        action()
    return watch.seconds


def cpu_us(action: Callable[[], object], least_s: float = 0.02) -> float:
    """User and system time of one call, us, averaged over as many as take about `least_s`; no collections."""
    gc.disable()
    try:
        calls = 1
        while (spent := _spent(action, calls)) < 0.5 * least_s:
            calls = max(2 * calls, math.ceil(calls * least_s / max(spent, 1e-6)))
    finally:
        gc.enable()
    return 1e6 * spent / calls


def _spent(action: Callable[[], object], calls: int) -> float:
    begin = time.process_time()
    for _ in range(calls):
        action()
    return time.process_time() - begin


def best_of(
    ours: Callable[[], float], reference: Callable[[], float], rounds: int, best: Callable[..., float] = min
) -> tuple[float, float]:
    """The best figures of both, measured in turns, so that both see the same machine."""
    figures = [(ours(), reference()) for _ in range(rounds)]
    return best(a for a, _ in figures), best(b for _, b in figures)


def quantile(values: Sequence[float], share: float) -> float:
    """The value below which this share of the others lies: 0.5 for the median."""
    ranked = sorted(values)
    return ranked[min(int(share * len(ranked)), len(ranked) - 1)]


_COLUMNS = (
    ("", 25),
    ("ours", 13),
    ("against", 23),
    ("reference", 11),
    ("ratio", 7),
    ("budget", 11),
    ("met", 3),
)
"""Headings and widths."""
_LEFT = ("", "against", "met")


def show(title: str, rows: Sequence[Row]) -> None:
    """Print the table of one benchmark."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1, 0, 0))
    for heading, width in _COLUMNS:
        justify: Literal["left", "right"] = "left" if heading in _LEFT else "right"
        table.add_column(heading, justify=justify, width=width, overflow="fold")
    for row in rows:
        table.add_row(*cells(row))
    console = Console(width=WIDTH, highlight=False)
    console.print(table)
    console.print()


def cells(row: Row) -> tuple[str, ...]:
    """A row as text: name, ours, against, reference, ratio, budget, met."""
    reference = "" if row.reference is None else f"{figure(row.reference)} {row.unit}"
    ratio = "" if row.ratio is None else figure(row.ratio)
    met = {None: "", True: "[green]yes[/]", False: "[red]NO[/]"}[row.met]
    return row.name, f"{figure(row.ours)} {row.unit}", row.against, reference, ratio, _budget(row), met


def _budget(row: Row) -> str:
    if row.budget is None:
        return ""
    unit = f" {row.unit}" if row.budget.of == "ours" else "x"
    return f"{'<=' if row.budget.sense == 'at most' else '>='} {row.budget.limit:g}{unit}"


def figure(value: float) -> str:
    """A number with three digits that count, thousands parted."""
    if not math.isfinite(value) or value == 0:
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(digits, 5)}f}"
