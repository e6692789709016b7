"""Robots of several kinds in one platoon, their slipping wheels, and one that restarts, in virtual time."""

from pathlib import Path

import pytest
from msgspec.structs import replace

import maniple
from maniple.cli.loading import completed, load, robot_models
from maniple.core.messages import Odometry, Status, Truth, unpack_floats
from maniple.core.scenario.types import Crash, Line, Robot, Scenario, Start
from maniple.recording.reader import read
from tests.cli.scenes import ROOT, assert_small_errors, platoon

MIXED = ROOT / "scenarios" / "mixed-platoon.toml"
KINDS = [("pioneer-3dx", "sick-lms200"), ("robotino", "rplidar-a2"), ("f1tenth", "rplidar-a2")]


@pytest.mark.slow
def test_four_kinds_of_robots_follow_a_line_past_obstacles_behind_their_guards(tmp_path: Path) -> None:
    result = maniple.run(load(MIXED), virtual=True, log=tmp_path / "mixed.mcap")
    assert result.completed
    assert result.collisions == 0
    assert result.min_clearance_m is not None
    assert result.min_clearance_m > 0.05
    assert_small_errors(result.final_error, 0.04)  # who sees only ahead does not back what it overshot


def of_kinds() -> Scenario:
    """One robot of each kind and a 3-AT with sonars, for a short way without obstacles."""
    kinds = [*KINDS, ("pioneer-3at", "pioneer-3at-sonar")]
    robots = tuple(
        Robot(id=f"r{k}", model=model, sensor=sensor, control_point_m=0.3)
        for k, (model, sensor) in enumerate(kinds)
    )
    return replace(
        platoon(4),
        robots=robots,
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1, settle_s=35.0),
        start=Start(scatter_m=0.15, scatter_rad=0.5),
    )


def test_one_robot_of_each_kind_builds_the_formation_and_follows_a_line(tmp_path: Path) -> None:
    result = maniple.run(completed(of_kinds()), virtual=True, log=tmp_path / "kinds.mcap")
    assert result.completed
    assert result.collisions == 0
    assert_small_errors(result.final_error)
    truth = read(result.log).decoded(Truth)
    sideways = [unpack_floats(message.sideways) for _, message in truth]
    assert max(abs(v[1]) for v in sideways) > 0.01
    assert all((v[[0, 2, 3]] == 0.0).all() for v in sideways)
    counts = {m.source: len(m.ticks) for _, m in read(result.log).decoded(Odometry)}
    assert counts == {"r0": 2, "r1": 3, "r2": 2, "r3": 2}


def test_slip_is_the_same_for_the_same_seed_and_leads_odometry_astray(tmp_path: Path) -> None:
    slippery = {"pioneer-3dx": replace(robot_models()["pioneer-3dx"], slip_sigma=0.1)}
    scenario = completed(replace(platoon(3), models=slippery))
    logs = [tmp_path / name for name in ("first.mcap", "second.mcap", "other.mcap")]
    for log, seed in zip(logs, (1, 1, 2), strict=True):
        maniple.run(replace(scenario, seed=seed), virtual=True, duration_s=5.0, log=log)
    first, second, other = (log.read_bytes() for log in logs)
    assert first == second != other
    last = {m.source: m for _, m in read(logs[0]).decoded(Odometry)}
    [*_, (_, truth)] = read(logs[0]).decoded(Truth)
    errors = [
        abs(last[r].psi_rad - p[2]) for r, p in zip(truth.robots, unpack_floats(truth.poses, 3), strict=True)
    ]
    assert 0.003 < max(errors) < 0.3


@pytest.mark.parametrize("model", ["pioneer-3dx", "robotino", "f1tenth"])
def test_a_robot_that_restarts_goes_on_where_it_is(tmp_path: Path, model: str) -> None:
    robots = tuple(Robot(id=f"r{k}", model=model if k == 4 else "pioneer-3dx") for k in (1, 2, 3, 4))
    crash = Crash(node="r4", at_s=6.0, restart_after_s=6.0)
    scenario = completed(replace(platoon(4), robots=robots, crashes=(crash,)))
    result = maniple.run(scenario, virtual=True, duration_s=30.0, log=tmp_path / "restart.mcap")
    assert result.collisions == 0
    words = [m for _, m in read(result.log).decoded(Status) if m.source == "r4" and m.incarnation == 2]
    assert [m.localised for m in words[:2]] == [False, True]
    assert words[-2].mode == "tracking"
    frames = {m.frame_id for _, m in read(result.log).decoded(Odometry) if m.source == "r4"}
    assert frames == {"r4"}
    assert result.odometry_drift_m is not None
    assert result.odometry_drift_m < 1e-3
