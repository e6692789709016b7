"""Layers of other packages: the very text of docs/extending.md, put where packages are found."""

import json
import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

import maniple
from maniple.cli.extensions import installed, parts_of, require_layers
from maniple.cli.loading import load
from maniple.cli.program import app
from maniple.control.avoidance import Impedances
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.messages import FormationState, Status
from maniple.core.scenario.types import Avoidance, Compensation, Scenario
from maniple.recording.reader import read
from tests.cli.scenes import ROOT, poses, write

GUIDE = (ROOT / "docs" / "extending.md").read_text()


def block(file: str) -> str:
    """The code block that follows the name of a file."""
    found = re.search(rf"`{re.escape(file)}`.*?```\w+\n(.*?)```", GUIDE, re.DOTALL)
    assert found is not None
    return found[1]


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, project: str, **modules: str) -> None:
    """What an installer leaves of a package: its modules, its name and its entry points."""
    table = tomllib.loads(project)["project"]
    about = folder / f"{table['name'].replace('-', '_')}-{table['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {table['name']}\nVersion: {table['version']}\n"
    )
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in table["entry-points"].items()
    ]
    (about / "entry_points.txt").write_text("\n".join(groups))
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(folder)


@pytest.fixture
def wall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The guide's scenario, with its package installed."""
    install(tmp_path, monkeypatch, block("pyproject.toml"), slow_down=block("slow_down.py"))
    return write(tmp_path, block("towards-a-wall.toml"), "towards-a-wall.toml")


def test_the_guides_example_is_about_thirty_lines() -> None:
    assert len([line for line in block("slow_down.py").splitlines() if line.strip()]) <= 30


def test_the_guides_example_is_found_and_keeps_what_it_has_to(wall: Path) -> None:
    assert ("avoidance", "slow-down", "maniple-slow-down 1.0", "slow_down:SlowDown") in installed()
    listed = CliRunner().invoke(app, ["layer", "list"])
    assert "slow-down" in listed.output
    checked = CliRunner().invoke(
        app, ["layer", "check", "avoidance", "slow-down", "--option", "stop_m=0.6", "--json"]
    )
    assert checked.exit_code == 0, checked.output
    said = json.loads(checked.output)
    assert said["holds"]
    assert len(said["findings"]) > 5
    with_scenario = ["layer", "check", "avoidance", "slow-down", "--scenario", str(wall)]
    assert CliRunner().invoke(app, with_scenario).exit_code == 0


def test_the_guides_example_stops_in_front_of_the_wall(wall: Path, tmp_path: Path) -> None:
    logs = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for log in logs[:2]:
        assert maniple.run(wall, virtual=True, duration_s=20.0, log=log).collisions == 0
    assert logs[0].read_bytes() == logs[1].read_bytes()
    stopped = poses(logs[0])[-1, 0, 0]
    assert 2.0 < stopped < 2.5, "0.6 m before the wall at 3 m, from the middle of the axle"
    recorded = msgspec.json.decode(read(logs[0]).scenario_json, type=Scenario)
    assert recorded.avoidance == Avoidance(law="slow-down", options={"stop_m": 0.6})
    left_out = ["avoidance.enabled=false"]
    hit = maniple.run(wall, virtual=True, duration_s=20.0, log=logs[2], overrides=left_out)
    assert hit.collisions, "nothing stops them without the layer"


def test_options_that_can_not_be_used_are_refused_once_by_the_check() -> None:
    result = CliRunner().invoke(app, ["layer", "check", "avoidance", "impedance", "--option", "x=1"])
    assert isinstance(result.exception, ArgumentError)
    assert str(result.exception) == "avoidance impedance refuses its parameters: options x: it takes none"


def test_options_that_can_not_be_used_are_refused_before_anything_moves(wall: Path, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"stop_m = 7.0: must be > 0 and < d_max_m"):
        maniple.run(wall, virtual=True, log=tmp_path / "x.mcap", overrides=["avoidance.options.stop_m=7.0"])
    assert not (tmp_path / "x.mcap").exists()


USERS = """
[project]
name = "users"
version = "0.1"
[project.entry-points."maniple.avoidance"]
clock = "users_layers:Clock"
impedance = "users_layers:Clock"
missing = "users_layers:Missing"
moody = "users_layers:Moody"
twice = "users_layers:Moody"
[project.entry-points."maniple.formation_laws"]
no-number = "users_layers:Nan"
half = "users_layers:Half"
[project.entry-points."maniple.planners"]
reverse = "users_layers:reverse"
all-first = "users_layers:all_first"
[project.entry-points."maniple.compensation"]
none = "users_layers:Through"
[project.entry-points."maniple.kinematics"]
mine = "users_layers:Mine"
"""

OTHERS = """
[project]
name = "others"
version = "0.2"
[project.entry-points."maniple.avoidance"]
twice = "users_layers:Clock"
"""

LAYERS = """
import random
from time import monotonic

import numpy as np

from maniple.control.kinematics import Differential


class Clock:
    def __init__(self, parameters, model): ...
    def step(self, wanted, returns, dt_s):
        return wanted._replace(u=wanted.u + 0.0 * monotonic() + 0.0 * random.random())

class Moody:
    def __init__(self, parameters, model):
        self.steps = 0
    def step(self, wanted, returns, dt_s):
        self.steps += 1
        if self.steps > 40:
            raise RuntimeError("enough")
        return wanted

class Nan:
    def __init__(self, parameters): ...
    def rates(self, desired_rates, errors, dt_s):
        return np.full_like(errors, np.nan)

class Half:
    def __init__(self, parameters): ...
    def rates(self, desired_rates, errors, dt_s):
        return desired_rates + 0.5 * errors

def reverse(positions, places):
    return range(len(places))[::-1]

def all_first(positions, places):
    return [0] * len(places)

class Through:
    parameters = (1.0, 2.0)
    def __init__(self, parameters, model): ...
    def step(self, desired, measured, free, dt_s):
        return desired

class Mine(Differential):
    def __init__(self, model, control_point_m):
        super().__init__(control_point_m)
"""

SCENE = """
name = "mine"
task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15 }
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
"""


@pytest.fixture
def users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install(tmp_path, monkeypatch, USERS, users_layers=LAYERS)
    install(tmp_path, monkeypatch, OTHERS)
    return write(tmp_path, SCENE)


def test_every_kind_can_be_replaced(users: Path, tmp_path: Path) -> None:
    log = tmp_path / "x.mcap"
    overrides = [
        "controller.law=half",
        "planning.method=reverse",
        "compensation.enabled=true",
        "compensation.law=none",
        "models.mine={length_m=0.5,width_m=0.4,wheel_radius_m=0.1,track_m=0.33,ticks_per_revolution=70000,"
        "u_max_mps=0.75,w_max_radps=1.7,u_accel_mps2=0.3,w_accel_radps2=1.7,brake_mps2=0.6,"
        "theta=[0.26,0.25,0.0,1.0,0.0,1.0],kinematics='mine'}",
        *(f"robots.r{k}.model=mine" for k in (1, 2, 3)),
    ]
    # The planner reverses the order, so robots 1 and 3 trade places: start them there.
    result = maniple.run(users, virtual=True, duration_s=4.0, log=log, overrides=overrides)
    assert result.duration_s > 3.0
    states = [message for _, message in read(log).decoded(FormationState)]
    assert states[-1].chain == ("r3", "r2", "r1")
    assert any(message.compensation == (1.0, 2.0) for _, message in read(log).decoded(Status))


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("controller.law=no-number", "the formation law failed: ValueError: gave rates that are not finite"),
        ("planning.method=all-first", "the planner failed: ValueError: gave [0, 0, 0]"),
    ],
)
def test_a_law_or_planner_that_fails_lets_all_stand_and_says_why(
    users: Path, tmp_path: Path, override: str, reason: str
) -> None:
    log = tmp_path / "x.mcap"
    result = maniple.run(users, virtual=True, duration_s=5.0, log=log, overrides=[override])
    assert not result.completed
    last = [message for _, message in read(log).decoded(FormationState)][-1]
    assert last.phase == "holding"
    assert reason in last.reason
    found = poses(log)
    assert np.abs(found[-1] - found[0]).max() < 0.01


@pytest.mark.parametrize("robot_from", ["kinematics", "drive"])
def test_a_robots_layer_that_fails_lets_it_stand_and_says_why(
    users: Path, tmp_path: Path, robot_from: str
) -> None:
    log = tmp_path / "x.mcap"
    overrides = ["avoidance.law=moody", f"placement.robot_from={robot_from}"]
    result = maniple.run(users, virtual=True, duration_s=10.0, log=log, overrides=overrides)
    assert not result.completed
    if robot_from == "drive":
        reasons = [message.reason for _, message in read(log).decoded(FormationState)]
    else:
        reasons = [m.reason for _, m in read(log).decoded(Status) if m.mode == "fault"]
    assert any("avoidance failed: RuntimeError: enough" in reason for reason in reasons)
    found = poses(log)
    assert np.abs(found[-1] - found[-10]).max() < 0.001


def test_a_layer_that_reads_a_clock_is_found_out(users: Path) -> None:
    checked = CliRunner().invoke(app, ["layer", "check", "avoidance", "clock", "--json"])
    assert checked.exit_code == 1
    failed = {
        one["name"]: one["counterexample"]
        for one in json.loads(checked.output)["findings"]
        if not one["holds"]
    }
    assert failed == {
        "draws nothing from a global random source": "it draws from a global random source",
        "reads no clock and no file": "it calls time.monotonic",
    }


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "avoidance.law=fast",
            "no such avoidance is installed; there are clock, impedance, missing, moody, twice",
        ),
        ("avoidance.law=missing", "users_layers:Missing can't be imported: AttributeError"),
        ("avoidance.law=twice", "installed more than once, by others 0.2, users 0.1"),
        ("controller.law=best", "no such formation-law is installed; there are half, no-number, paper"),
        ("planning.method=best", "no such planner is installed; there are all-first, final-reorganization"),
        ("avoidance.options.x=1", "avoidance: the law refuses its parameters: ValueError: options x"),
        (
            "avoidance.options.x=nan",
            "must be text, a finite number, true or false, or a list or table of such",
        ),
        ("avoidance.options.x=1979-05-27", "must be text, a finite number"),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(users: Path, override: str, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        require_layers(load(users, [override]))
    assert message in str(caught.value)


def test_the_name_of_a_built_in_layer_is_taken(users: Path) -> None:
    assert parts_of(load(users)).avoidance["impedance"] is Impedances
    assert [one.package for one in installed() if one.name == "impedance"] == ["maniple"]


def test_an_agent_needs_no_formation_law(users: Path) -> None:
    scenario = load(users, ["controller.law=best"])
    assert "paper" in parts_of(scenario, on_robot=True).formation_laws


def test_avoidance_and_compensation_can_be_left_out(tmp_path: Path) -> None:
    scene = write(tmp_path, SCENE)
    for number, (avoids, compensates) in enumerate([(False, False), (False, True), (True, False)]):
        scenario = msgspec.structs.replace(
            load(scene),
            avoidance=Avoidance(enabled=avoids),
            compensation=Compensation(enabled=compensates),
        )
        result = maniple.run(scenario, virtual=True, duration_s=3.0, log=tmp_path / f"{number}.mcap")
        assert result.collisions == 0
        assert result.duration_s > 2.0
