"""The clearance clamp through a whole platoon in virtual time: avoidance off, so that nothing else helps."""

from pathlib import Path

import pytest

import maniple
from tests.cli.scenes import PAPER, poses, write

WALL = '{kind="wall", start=[3, -3], end=[3, 3]}'
OBLIQUE = '{kind="wall", start=[3, -3], end=[4, 3]}'
AHEAD = '{kind="circle", centre=[3, 0.05], radius_m=0.02}'
ASIDE = '{kind="circle", centre=[3, 0.3], radius_m=0.1}'
CORRIDOR = '{kind="wall", start=[2, 0.45], end=[9, 0.45]}, {kind="wall", start=[2, -0.45], end=[9, -0.45]}'


def run_among(obstacles: str, folder: Path, model: str, speed: float, *overrides: str) -> maniple.Result:
    """Three robots without avoidance, sent along x at `speed` among obstacles."""
    scene = f"""
name = "clearance"
task = {{ kind = "line", start = [0, 0], end = [5, 0], speed_mps = {speed} }}
formation.points = [[0, 0], [-1.2, 0.8], [-1.2, -0.8]]
robots = [{", ".join(f'{{ id = "r{i}", model = "{model}" }}' for i in (1, 2, 3))}]
avoidance.enabled = false
world.obstacles = [{obstacles}]
"""
    return maniple.run(write(folder, scene), virtual=True, log=folder / "run.mcap", overrides=overrides)


@pytest.mark.parametrize("model", ["pioneer-3dx", "pioneer-3dx-bare"])
@pytest.mark.parametrize(
    ("obstacle", "speed", "overrides"),
    [
        (WALL, 0.4, []),
        (WALL, 0.7, []),
        (WALL, 0.74, []),
        (WALL, 0.7, ["guard.gamma_per_s=3"]),
        (WALL, 0.7, ["guard.gamma_per_s=1000", "controller.saturation=2"]),
        (WALL, 0.7, ["rates.scan_hz=2", "rates.motion_hz=4"]),
        (OBLIQUE, 0.7, []),
        (AHEAD, 0.7, []),
        (ASIDE, 0.7, []),
    ],
)
def test_no_robot_runs_into_what_it_sees(
    tmp_path: Path, model: str, obstacle: str, speed: float, overrides: list[str]
) -> None:
    result = run_among(obstacle, tmp_path, model, speed, *overrides)
    assert result.collisions == 0
    assert result.min_clearance_m is not None
    assert result.min_clearance_m > 0.04
    assert poses(result.log)[-1, 0, 0] > 2.2  # and went as far as it may


@pytest.mark.parametrize("model", ["pioneer-3dx", "pioneer-3dx-bare"])
def test_passes_between_walls(tmp_path: Path, model: str) -> None:
    """0.24 m beside the body, 0.07 m beyond the circle and the margin."""
    columns = "formation.points=[[0, 0], [-1.5, 0], [-3.5, 0.01]]"
    result = run_among(CORRIDOR, tmp_path, model, 0.2, columns, "task.settle_s=5")
    assert result.collisions == 0
    assert poses(result.log)[-1, 0, 0] > 4.5


@pytest.mark.slow
def test_the_paper_scene_with_the_clamp(tmp_path: Path) -> None:
    result = maniple.run(PAPER, virtual=True, log=tmp_path / "run.mcap", overrides=["guard.clearance=true"])
    assert result.completed
    assert result.collisions == 0
