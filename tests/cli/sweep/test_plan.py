import math
from pathlib import Path

import pytest

from maniple.cli.loading import load
from maniple.cli.sweep.plan import network_margin_s, plan_of, tolerated_delay_s
from maniple.control.delay_margin import delay_margin_s
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.parse import json_data, scenario_of
from tests.cli.sweep.files import GRID, write_sweep

SHAPED = """
name = "shaped"
task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15, settle_s = 10.0 }
formation.shape = { kind = "wedge", spacing_m = 1.5 }
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
"""


def test_every_run_is_the_scenario_that_its_overrides_make(tmp_path: Path) -> None:
    plan = plan_of(write_sweep(tmp_path))
    assert len(plan.jobs) == 8
    assert [(job.values, job.seed) for job in plan.jobs][:3] == [
        (("drive", 0.0), 5),
        (("drive", 0.0), 3),
        (("drive", 0.4), 5),
    ]
    for job in plan.jobs:
        scenario = load(tmp_path / "small.toml", job.overrides, job.seed)
        assert scenario_of(json_data(job.scenario_json)) == scenario
    assert len({job.id for job in plan.jobs}) == 8


def test_equal_runs_have_equal_identities_whatever_they_are_called(tmp_path: Path) -> None:
    before = plan_of(write_sweep(tmp_path))
    renamed = GRID.replace("loss = {", "share = {").replace('x = "loss"', 'x = "share"')
    assert [job.id for job in plan_of(write_sweep(tmp_path, renamed)).jobs] == [job.id for job in before.jobs]
    longer = plan_of(write_sweep(tmp_path, GRID.replace("duration_s = 4", "duration_s = 5")))
    assert not {job.id for job in longer.jobs} & {job.id for job in before.jobs}


def test_hardware_is_not_swept(tmp_path: Path) -> None:
    text = 'name = "n"\nscenario = "small.toml"\ngrid.controller.kappa = [0.2, 0.3]\n'
    text += 'set = ["robots.r2.driver=ros2"]'
    with pytest.raises(
        ArgumentError, match=r"a sweep runs in virtual time: drivers .* of r2 \(driver = 'ros2'\)"
    ):
        plan_of(write_sweep(tmp_path, text, SHAPED))


def test_platoons_of_any_size_have_their_places(tmp_path: Path) -> None:
    text = 'name = "n"\nscenario = "small.toml"\ngrid.robots = [3, 6, 12]'
    jobs = plan_of(write_sweep(tmp_path, text, SHAPED)).jobs
    found = [scenario_of(json_data(job.scenario_json)) for job in jobs]
    assert [len(one.robots) for one in found] == [3, 6, 12]
    assert [len(one.formation.points) for one in found] == [3, 6, 12]


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ("faults.0.loss = [0.5, 1.5, 2]", "2 of 3 combinations can't run; the first, faults.0.loss = 1.5: "),
        ("faults.0.loss = [0.5, 1.5, 2]", "faults[0].loss = 1.5: must be a finite number >= 0 and <= 1"),
        ("faults.0.losss = [0.5]", "faults[0].losss: unknown field"),
        ("faults.4.loss = [0.5]", "override of faults.4: must be an index from 0 to 1"),
        ("robots = [2]", "robots: there are 2; must be at least 3"),
        ("task.speed_mps = [0.2, 9.0]", "task.speed_mps = 9"),
        ("controller.law = ['nonsense']", "controller.law = 'nonsense'"),
        ("seed = [1, 2]", "grid.seed: "),
        ("completed = [1, 2]", "grid.completed: "),
    ],
)
def test_a_combination_that_cannot_run_is_refused(tmp_path: Path, grid: str, message: str) -> None:
    text = f'name = "n"\nscenario = "small.toml"\nset = ["faults=[{{}}]"]\n[grid]\n{grid}'
    path = write_sweep(tmp_path, text, SHAPED)
    with pytest.raises(ScenarioError) as raised:
        plan_of(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('x = "loss"', 'x = "los"'), "plots[0].x = 'los': must be an axis: placement.robot_from, loss"),
        (('x = "loss"', 'x = "placement.robot_from"'), "must be an axis whose values are numbers"),
        (('series = "', 'facets = "x'), "plots[0].facets = 'xplacement.robot_from': must be an axis"),
        (
            ("peak_error_distance_m", "error"),
            "plots[0].y = 'error': must be one of robots,",
        ),
        (
            ("[[plots]]", "[[plots]]\nlog_x = true"),
            "plots[0].log_x: loss = 0.0: has no place",
        ),
        (("small.toml", "no.toml"), "no.toml: can't be read"),
        (("faults=[{}]", "faults"), "override 'faults': must be key=value"),
    ],
)
def test_what_can_be_neither_drawn_nor_read_is_refused(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    with pytest.raises(ScenarioError) as raised:
        plan_of(write_sweep(tmp_path, GRID.replace(*change)))
    assert message in str(raised.value)


def test_the_predicted_delay(tmp_path: Path) -> None:
    """(pi/2)(a/v) less the drive's lag with the inverse kinematics in the centre, 0.8 pi/(2 kappa) with it on
    the robot; less half a period each of odometry, control and drive; whatever the guard's own limits are."""
    scene = write_sweep(tmp_path, GRID, SHAPED).with_name("small.toml")
    sampling = 0.5 * (0.05 + 0.1 + 0.05)
    for extra in ([], ["guard.stop_after_s=100"]):
        central = load(scene, ["task.speed_mps=0.4", "placement.robot_from=drive", *extra])
        lag = 0.2604 / 0.9965
        assert tolerated_delay_s(central) == pytest.approx(math.pi / 2 * 0.2 / 0.4 - lag - sampling)
        onboard = load(scene, ["placement.robot_from=kinematics", *extra])
        assert tolerated_delay_s(onboard) == pytest.approx(0.8 * math.pi / (2 * 0.25) - sampling)
        margin = delay_margin_s(onboard, onboard.robots[0])
        assert margin is not None
        assert network_margin_s(onboard) == pytest.approx(margin - sampling)
    assert network_margin_s(load(scene, ["robots.0.model=robotino"])) is None
