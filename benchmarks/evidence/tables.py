"""What the study found, as Markdown tables."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from benchmarks.evidence.platoons import SEED, Case
from benchmarks.evidence.study import CATEGORIES, RISE, Bound, Circle, Outcome, Spread, Study, Trip

ROBOTS = (3, 4, 6, 10, 20, 30, 40, 50)
"""Of the chain, whose farthest distances are shown."""


def tables(found: Study) -> str:
    """All tables, each with a heading."""
    extent = found.extent
    parts = [
        f"Seed {SEED}, {extent.starts} starts a line, horizon {extent.horizon_s:g} s.",
        "### Convergence",
        _table(
            (
                "n",
                "variant",
                "in formation",
                "median time",
                "95 %",
                "fastest point told, median",
                "not in formation",
            ),
            (_convergence(case, outcome) for case, outcome in found.outcomes.items()),
        ),
        "### Starts near the places",
        _table(
            ("n", "off by up to", "in formation", "median time", "95 %", "fastest point told, median"),
            (_scattered(case, outcome) for case, outcome in found.scattered.items()),
        ),
        "### How far the robots of a chain get from their places, median",
        _table(
            ("n", "variant", *(f"R{k}" for k in ROBOTS)),
            (_far(c, outcome) for c, outcome in found.outcomes.items() if c.n == extent.sizes[-1]),
        ),
        "### V = q~'q~/2",
        _table(
            (
                "n",
                "first triangle: never rises",
                "of the others at 1 kHz: never",
                "later triangles: never rises",
                "nor while the robots before stand at their places",
            ),
            _lyapunov(found),
        ),
        "### The starts in which the first V rises: the law alone, and with the supervisor",
        _table(
            ("n", "starts", "smallest side or median", "fastest of R1 to R3 told", "at their places after"),
            _passes(found.passes),
        ),
        "### Ultimate bound",
        _table(
            (
                "n",
                "speed",
                "within the printed bound",
                "error / bound, median",
                "largest",
                "within the exact",
            ),
            (_bound(circle, each) for circle, each in found.bounds.items()),
        ),
        "### One robot pushed",
        _table(
            ("reference", *(f"R{k + 1}" for k in range(len(found.spread.formation)))), _spread(found.spread)
        ),
    ]
    return "\n\n".join(parts)


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _convergence(case: Case, outcome: Outcome) -> tuple[str, ...]:
    failed = [(outcome.category.count(kind), kind) for kind in CATEGORIES]
    why = ", ".join(f"{count} {kind}" for count, kind in failed if count)
    return str(case.n), case.variant, *_times(outcome), _speed(outcome), why


def _scattered(case: Case, outcome: Outcome) -> tuple[str, ...]:
    return str(case.n), f"{case.scatter_m:g} m", *_times(outcome), _speed(outcome)


def _times(outcome: Outcome) -> Iterator[str]:
    reached = outcome.time_s[np.isfinite(outcome.time_s)]
    yield f"{reached.size} of {outcome.time_s.size}"
    for share in (0.5, 0.95):
        yield f"{np.quantile(reached, share):.0f} s" if reached.size else ""


def _speed(outcome: Outcome) -> str:
    return f"{_two(np.median(outcome.fastest_mps))} m/s"


def _two(value: np.floating) -> str:
    """Two digits that count, without an exponent."""
    short = f"{value:.2g}"
    return f"{float(short):,.0f}" if "e+" in short else short


def _far(case: Case, outcome: Outcome) -> list[str]:
    medians = np.median(outcome.farthest_m, axis=0)
    cells = [f"{_two(medians[k - 1])} m" if k <= case.n else "" for k in ROBOTS]
    return [str(case.n), case.variant, *cells]


def _lyapunov(found: Study) -> Iterator[tuple[str, ...]]:
    for n, still in found.refined.items():
        outcome = found.outcomes[Case(n)]
        later, after = outcome.rise[:, 1:], outcome.settled_rise[:, 1:]
        after = after[after > -math.inf]
        kept = outcome.rise[:, 0] <= RISE
        risen = int((~kept).sum())
        fine = f"{risen - still} of {risen}" if risen else ""
        yield str(n), _share(kept), fine, _share(later <= RISE), _share(after <= RISE)


def _passes(passes: Mapping[int, Sequence[tuple[Trip, Trip]]]) -> Iterator[tuple[str, ...]]:
    for n, trips in passes.items():
        if trips:
            law, led = (np.median(np.array(each), axis=0) for each in zip(*trips, strict=True))
            cells = (
                f"{_two(law[k])} {unit}, {_two(led[k])} {unit}"
                for k, unit in ((0, "m"), (1, "m/s"), (2, "s"))
            )
            yield str(n), str(len(trips)), *cells


def _bound(circle: Circle, found: Bound) -> tuple[str, ...]:
    ratio = found.error / found.printed
    kept = (
        _share(ratio <= 1.0),
        f"{np.median(ratio):.2f}",
        f"{ratio.max():.2f}",
        _share(found.error <= found.exact),
    )
    return str(circle.n), f"{circle.speed_mps:g} m/s", *kept


def _share(kept: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> str:
    return f"{kept.sum()} of {kept.size}" if kept.size else ""


def _spread(spread: Spread) -> Iterator[list[str]]:
    for name, distances in zip(spread._fields, spread, strict=True):
        yield [name, *(f"{distance:.2f}" for distance in distances)]
