"""One example of every kind of platoon that is not in formation, and of what looks strange, as pictures."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.evidence.platoons import DT_S, Case, Platoons, headings, places, starts
from benchmarks.evidence.study import CATEGORIES, RISE, Study
from maniple.core.geometry import Floats

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, for the eyes of all."""
SHOWN_S = {"mirrored, at rest": 80.0, "mirrored, moving": 120.0, "under way": 400.0, "thrown apart": 400.0}
SINGULAR_S = 40.0


class Example(NamedTuple):
    """A start of a case, and what it is an example of."""

    title: str
    case: Case
    start: int
    duration_s: float


class History(NamedTuple):
    """One platoon over time."""

    time_s: Floats
    positions: Floats
    """(t, n, 2) in m."""
    energy: Floats
    """V of each triangle, (t, n - 2)."""


def draw(found: Study, folder: Path) -> list[Path]:
    """Write evidence-*.png into `folder`; returns what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    return [_picture(example, folder) for example in examples(found)]


def examples(found: Study) -> Iterator[Example]:
    """Of every category the first start of the smallest platoon of ideal points, by the signed angle where it
    has one; and of the smallest platoon whose first V rose in any start, the one in which it rose most."""
    ideal = [case for case in found.outcomes if not case.pioneers]
    for kind in CATEGORIES:
        for case in sorted(ideal, key=lambda case: not case.signed):
            outcome = found.outcomes[case]
            if kind in outcome.category:
                title = f"{kind} (n = {case.n}, {case.variant})"
                yield Example(title, case, outcome.category.index(kind), SHOWN_S.get(kind, 120.0))
                break
    for case in map(Case, found.extent.sizes):
        rises = found.outcomes[case].rise[:, 0]
        if rises.max() > RISE:
            title = f"near singular (n = {case.n}, {case.variant})"
            yield Example(title, case, int(rises.argmax()), SINGULAR_S)
            return


def history(example: Example) -> History:
    """The example once more, from its start."""
    case, start = example.case, example.start
    platoons = Platoons(case, starts(case, start + 1)[start:], headings(case, start + 1)[start:])
    positions, energy = [], []
    steps = round(example.duration_s / DT_S)
    for _ in range(steps):
        positions.append(platoons.positions[0])
        energy.append(0.5 * (platoons.step(platoons.desired()).errors[0] ** 2).sum(axis=-1))
    times = np.arange(steps, dtype=np.float64) * DT_S
    return History(times, np.array(positions), np.array(energy))


def _picture(example: Example, folder: Path) -> Path:
    from matplotlib.figure import Figure

    seen = history(example)
    figure = Figure(figsize=(7.2, 3.4), dpi=150, layout="constrained")
    figure.suptitle(example.title, fontsize=9)
    floor, curves = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    _paths(floor, seen, places(example.case.n))
    _energies(curves, seen)
    name = example.title.partition(" (")[0].replace(",", "").replace(" ", "-")
    path = folder / f"evidence-{name}.png"
    figure.savefig(path, metadata={"Software": None})
    return path


def _paths(axes: Any, seen: History, where: Floats) -> None:
    n = len(where)
    for k in range(n):
        x, y = seen.positions[:, k].T
        axes.plot(x, y, color=COLOURS[k % len(COLOURS)], lw=0.8, alpha=0.8)
        axes.plot(x[0], y[0], ".", color=COLOURS[k % len(COLOURS)], ms=4)
    for corners, style in ((where, "--"), (seen.positions[-1], "-")):
        for j in range(n - 2):
            axes.plot(*corners[[j, j + 1, j + 2, j]].T, style, color="0.45", lw=0.7)
    if n <= 10:
        for k, (x, y) in enumerate(seen.positions[-1]):
            axes.annotate(f"R{k + 1}", (x, y), (3, 3), textcoords="offset points", fontsize=7)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (m)", fontsize=8)
    axes.set_ylabel("y (m)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_title("dots: starts; dashed: desired; grey: end", fontsize=7)


def _energies(axes: Any, seen: History) -> None:
    triangles = seen.energy.shape[1]
    for j in range(triangles):
        label = f"triangle {j + 1}" if j < len(COLOURS) and triangles <= len(COLOURS) else None
        colour = COLOURS[j % len(COLOURS)]
        axes.semilogy(seen.time_s, np.maximum(seen.energy[:, j], 1e-12), color=colour, lw=0.9, label=label)
    if triangles <= len(COLOURS):
        axes.legend(fontsize=7, frameon=False)
    axes.set_xlabel("t (s)", fontsize=8)
    axes.set_ylabel("V (m², rad²)", fontsize=8)
    axes.tick_params(labelsize=7)
