"""The same robots, lidars and obstacles in ir-sim (PyPI: ir-sim), where it is installed."""

import contextlib
import importlib.util
import io
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from maniple.core.scenario.types import Circle, Obstacle, PoseXY, RangeFinder, Wall

IS_HERE = importlib.util.find_spec("irsim") is not None
MISSING = "ir-sim: not installed"
STEP_S = 0.1
"""Motion and lidar."""


class Body(NamedTuple):
    """Outline of a robot, m."""

    length: float
    width: float


def environment(
    poses: Iterable[PoseXY],
    body: Body,
    sensor: RangeFinder,
    obstacles: Iterable[Obstacle],
    extent: tuple[float, float],
    folder: Path,
) -> Any:
    """An ir-sim environment without display: differential robots, circles and walls, in the middle of a
    world of `extent` (m, m)."""
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        import irsim

        file = folder / "world.yaml"
        world = {
            "width": extent[0],
            "height": extent[1],
            "offset": [-0.5 * extent[0], -0.5 * extent[1]],
            "step_time": STEP_S,
        }
        plan = {
            "world": world,
            "robot": [_robots(poses, body, sensor)],
            "obstacle": [_obstacle(one) for one in obstacles],
        }
        file.write_text(json.dumps(plan))  # JSON is YAML
        return irsim.make(str(file), headless=True, log_level="ERROR")


def _robots(poses: Iterable[PoseXY], body: Body, sensor: RangeFinder) -> dict[str, Any]:
    states = [list(pose) for pose in poses]
    lidar = {
        "name": "lidar2d",
        "range_max": sensor.range_max_m,
        "angle_range": math.pi,
        "number": sensor.beams,
        "noise": sensor.sigma_m > 0,
        "std": sensor.sigma_m,
    }
    return {
        "number": len(states),
        "kinematics": {"name": "diff"},
        "shape": {"name": "rectangle", "length": body.length, "width": body.width},
        "distribution": {"name": "manual"},
        "state": states,
        "sensors": [lidar],
    }


def _obstacle(obstacle: Obstacle) -> dict[str, Any]:
    if isinstance(obstacle, Circle):
        shape: dict[str, Any] = {"name": "circle", "radius": obstacle.radius_m}
        return {"shape": shape, "state": [*obstacle.centre, 0.0]}
    assert isinstance(obstacle, Wall), "only circles and walls are compared"
    shape = {"name": "linestring", "vertices": [list(obstacle.start), list(obstacle.end)]}
    return {"shape": shape, "state": [0.0, 0.0, 0.0]}
