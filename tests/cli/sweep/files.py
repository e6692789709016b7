"""A small sweep in files, and how it is run."""

import subprocess
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from tests.cli.scenes import SMALL, start, write

GRID = """
name = "small-sweep"
scenario = "small.toml"
set = ["faults=[{}]", "start.scatter_m=0.1"]
duration_s = 4
seeds = [5, 3]

[grid]
placement.robot_from = ["drive", "kinematics"]
loss = { keys = ["faults.0.loss"], values = [0.0, 0.4] }

[[plots]]
name = "errors"
x = "loss"
y = "peak_error_distance_m"
series = "placement.robot_from"
"""


def write_sweep(folder: Path, text: str = GRID, scene: str = SMALL) -> Path:
    write(folder, scene)
    path = folder / "sweep.toml"
    path.write_text(text)
    return path


def begin(file: Path, out: Path, *options: object) -> subprocess.Popen[str]:
    """`maniple sweep` in a process of its own."""
    return start("sweep", file, "--out", out, *options)


def rows_of(out: Path) -> list[dict[str, Any]]:
    """The table of results."""
    found: list[dict[str, Any]] = pq.read_table(out / "results.parquet").to_pylist()
    return found
