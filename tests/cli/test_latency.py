"""0.4 m/s with control points 0.2 m ahead, over networks that are late and lose much: who bears what."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maniple
from maniple.cli.loading import load
from maniple.control.limits import age_limits
from maniple.core.messages import FormationState, unpack_floats
from maniple.recording.reader import read
from tests.cli.scenes import ROOT, assert_small_errors, truths

FOLDER = ROOT / "scenarios"
HOSTS = pytest.mark.parametrize(
    "host",
    [pytest.param({"virtual": True}, id="virtual"), pytest.param({"speed": 2.0}, id="processes")],
)


@pytest.mark.slow
@HOSTS
@pytest.mark.parametrize("name", ["latency-kinematics", "latency-central-mild"])
def test_the_platoon_gets_there(tmp_path: Path, name: str, host: dict[str, Any]) -> None:
    result = maniple.run(FOLDER / f"{name}.toml", log=tmp_path / "run.mcap", **host)
    assert result.completed
    assert result.collisions == 0
    assert_small_errors(result.final_error, 0.05)


@pytest.mark.slow
@HOSTS
def test_all_central_it_holds_and_says_why(tmp_path: Path, host: dict[str, Any]) -> None:
    path = FOLDER / "latency-central.toml"
    result = maniple.run(path, log=tmp_path / "run.mcap", duration_s=30.0, **host)
    assert not result.completed
    assert result.collisions == 0
    moved = [unpack_floats(truth.velocities, 2) for truth in truths(tmp_path / "run.mcap")]
    assert np.abs(moved).max() < 1e-3
    states = [state for _, state in read(tmp_path / "run.mcap").decoded(FormationState)]
    assert {state.task_time_s for state in states} == {0.0}
    held = [state for state in states if state.stamp_ns > states[-1].stamp_ns - 10 * 10**9]
    assert all(set(state.waits_for) == {f"r{k}" for k in range(1, 7)} for state in held)
    assert all("s old" in state.reason for state in held)
    assert len({state.reason for state in held}) <= 3


def test_the_scenes_are_as_fast_as_they_say_and_their_limits_follow() -> None:
    for name, stop_s in (("kinematics", 6.28), ("central", 0.52), ("central-mild", 0.52)):
        scenario = load(FOLDER / f"latency-{name}.toml")
        assert age_limits(scenario, scenario.robots[0])[1] == pytest.approx(stop_s, abs=0.01)
        assert {robot.control_point_m for robot in scenario.robots} == {0.2}
