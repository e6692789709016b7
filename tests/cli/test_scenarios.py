"""The scenarios that come with the project: each is valid, and does what it promises in both hosts."""

from pathlib import Path
from typing import Any

import pytest

import maniple
from maniple.cli.loading import load

FOLDER = Path(__file__).parents[2] / "scenarios"
ALL = sorted(path.stem for path in FOLDER.glob("*.toml"))
SIMULATIONS = ("paper-simulation-1", "paper-simulation-2")
EXPERIMENTS = ("paper-experiment-1", "paper-experiment-2")


@pytest.mark.parametrize("name", ALL)
def test_every_scenario_is_valid_and_called_as_its_file(name: str) -> None:
    assert load(FOLDER / f"{name}.toml").name == name


def assert_the_paper_holds(name: str, result: Any) -> None:
    """Errors only while obstacles are near, then towards zero; no collision."""
    assert result.completed
    assert result.collisions == 0
    near, after = result.peak_error, result.final_error
    if name in SIMULATIONS:
        assert max(after.position_m, after.distance_m) <= 0.02
        assert max(after.orientation_rad, after.angle_rad) <= 0.02
    else:
        seen = result.estimated_final_error
        assert max(seen.position_m, seen.distance_m) <= 0.05
        assert max(seen.orientation_rad, seen.angle_rad) <= 0.05
        assert after.position_m <= seen.position_m + (result.odometry_drift_m or 0.0) + 0.01
    assert near.distance_m is not None
    assert near.distance_m > 0.15


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SIMULATIONS, *EXPERIMENTS])
def test_the_papers_results_in_virtual_time(tmp_path: Path, name: str) -> None:
    result = maniple.run(FOLDER / f"{name}.toml", virtual=True, log=tmp_path / "run.mcap")
    assert_the_paper_holds(name, result)


@pytest.mark.slow
@pytest.mark.parametrize("name", [SIMULATIONS[1], *EXPERIMENTS])
def test_the_papers_results_as_processes(tmp_path: Path, name: str) -> None:
    result = maniple.run(FOLDER / f"{name}.toml", speed=3.0, log=tmp_path / "run.mcap")
    assert_the_paper_holds(name, result)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in ALL if not name.startswith(("paper-", "latency-", "hardware-"))]
)
def test_the_others_complete_without_a_collision(tmp_path: Path, name: str) -> None:
    result = maniple.run(FOLDER / f"{name}.toml", virtual=True, log=tmp_path / "run.mcap")
    assert result.completed
    assert result.collisions == 0
    assert (result.final_error.position_m or 0.0) <= 0.1


@pytest.mark.slow
def test_a_lost_robot_is_taken_in_again(tmp_path: Path) -> None:
    result = maniple.run(FOLDER / "lost-robot.toml", virtual=True, log=tmp_path / "run.mcap")
    assert result.lost_robots == ["r4"]
    assert (result.odometry_drift_m or 0.0) < 0.01
