"""Small scenes to run, and what their recordings say."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from maniple.core.geometry import Floats
from maniple.core.messages import Truth, unpack_floats
from maniple.core.scenario.types import Scenario
from maniple.core.time import to_seconds
from maniple.recording.reader import read

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "scenarios" / "paper-simulation-1.toml"

ERRORS = ["position_m", "orientation_rad", "distance_m", "angle_rad"]

SMALL = """
name = "small"
task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15, settle_s = 10.0 }
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
guard.clearance = false
"""


def write(folder: Path, text: str = SMALL, name: str = "small.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def platoon(robots: int, **changes: Any) -> Scenario:
    """A chain of triangles in two columns, that travels 2 m; not resolved.

    Without the clamp, which forbids to reverse blindly what was overshot at the end."""
    table: dict[str, Any] = {
        "name": f"platoon-{robots}",
        "task": {"kind": "line", "start": [0, 0], "end": [2, 0], "speed_mps": 0.1, "settle_s": 40.0},
        "formation": {"points": [[-1.2 * i, 0.9 * (-1) ** i] for i in range(robots)]},
        "robots": [{"id": f"r{i + 1}"} for i in range(robots)],
        "guard": {"clearance": False},
    }
    return msgspec.convert(table | changes, Scenario)


def wired(scenario: Scenario, **fields: dict[str, Any]) -> Scenario:
    """The same with other fields of some robots, by id: another driver, for instance."""
    robots = tuple(msgspec.structs.replace(robot, **fields.get(robot.id, {})) for robot in scenario.robots)
    return msgspec.structs.replace(scenario, robots=robots)


def truths(log: Path | str) -> list[Truth]:
    return [message for _, message in read(log).decoded(Truth)]


def poses(log: Path | str) -> Floats:
    """Of all robots at all times, shape (k, n, 3)."""
    return np.array([unpack_floats(truth.poses, 3) for truth in truths(log)])


def speeds(truth: Truth) -> Floats:
    """What moves how fast: |u| + |w| of every robot, shape (n,)."""
    return np.asarray(np.abs(unpack_floats(truth.velocities, 2)).sum(axis=1))


def span_s(log: Path | str) -> float:
    """From the first ground truth to the last."""
    found = truths(log)
    return to_seconds(found[-1].stamp_ns - found[0].stamp_ns)


def assert_small_errors(errors: Any, limit: float = 0.02) -> None:
    values = [getattr(errors, name) for name in ERRORS]
    assert all(value is not None and value <= limit for value in values), errors


def start(*arguments: object, packages: Sequence[Path] = (), **options: Any) -> subprocess.Popen[str]:
    """The command, in a process of its own that finds these folders' packages too."""
    return subprocess.Popen(
        [sys.executable, "-m", "maniple", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, *packages)))},
        **options,
    )
