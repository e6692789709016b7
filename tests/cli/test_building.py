"""Scattered robots build a formation before the task begins: whole runs with agents, lasers and guards."""

from pathlib import Path

import numpy as np
import pytest

import maniple
from maniple.core.messages import FormationState
from maniple.core.scenario.types import Formation, Line, Planning, Robot, Scenario, Shape
from maniple.core.streams import stream
from maniple.recording import read

APART_M = 1.1
"""Least distance between two robots at the start."""


def scattered(n: int, seed: int) -> Scenario:
    """Robots anywhere in a square, any heading, that are to be a column and go on a metre."""
    rng = stream(seed, f"build/{n}")
    half = 0.65 * np.sqrt(n) + 0.5
    points: list[tuple[float, float]] = []
    while len(points) < n:
        x, y = rng.uniform(-2.0 * half, 2.0 * half, 2).tolist()
        if all(np.hypot(x - a, y - b) > APART_M for a, b in points):
            points.append((x, y))
    robots = tuple(
        Robot(id=f"r{k + 1}", pose=(x, y, float(rng.uniform(-np.pi, np.pi))))
        for k, (x, y) in enumerate(points)
    )
    return Scenario(
        name="build",
        robots=robots,
        formation=Formation(shape=Shape(kind="column", spacing_m=1.5)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1, settle_s=5.0),
        planning=Planning(method="optimal", build="straight"),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "seed"), [*((6, seed) for seed in range(8)), *((12, seed) for seed in range(4))]
)
def test_scattered_robots_build_the_formation_without_a_collision(tmp_path: Path, n: int, seed: int) -> None:
    log = tmp_path / "run.mcap"
    result = maniple.run(scattered(n, seed), virtual=True, log=log, duration_s=200.0)
    assert result.completed
    assert result.collisions == 0
    assert result.final_error.position_m is not None
    assert result.final_error.position_m < 0.1
    phases = [state.phase for _, state in read(log).decoded(FormationState)]
    assert list(dict.fromkeys(phases)) == ["waiting", "forming", "running", "done"]
    assert all(
        state.task_time_s == 0.0 for _, state in read(log).decoded(FormationState) if state.phase == "forming"
    )
