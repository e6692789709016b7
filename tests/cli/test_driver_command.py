"""`maniple driver list` and `check`, with the guide's robot on paper, which needs no time to pass."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import maniple
from maniple.cli import driver_command, extensions
from maniple.cli.loading import load
from maniple.cli.main import main
from maniple.cli.program import app
from maniple.core.errors import MissingExtraError
from maniple.core.time import SECOND, Duration, Time
from robot_agent.drivers import conformance
from robot_agent.drivers.conformance import PROPERTIES, WallRig
from tests.cli.scenes import start, write
from tests.cli.test_extensions import block, install
from tests.transport.test_zenoh import free_port

PROJECT = """
[project]
name = "paper-robots"
version = "1.0"
[project.entry-points."maniple.drivers"]
paper = "paper_robot:PaperRobot"
runaway = "runaway:Runaway"
lost = "nowhere:Nothing"
shy = "runaway:Shy"
"""

RUNAWAY = """
import sys
from paper_robot import PaperRobot

class Runaway(PaperRobot):
    def stop(self, now):
        pass

    def write(self, drive, now):
        return super().write(drive, now) if drive.active else self._velocity

class Shy(PaperRobot):
    def read(self, now):
        print("read", file=sys.stderr, flush=True)
        return super().read(now)

    def take(self, step, now):
        print(step, self._velocity.u, file=sys.stderr, flush=True)
        super().take(step, now)
"""


class Hurried(WallRig):
    """Time passes at once."""

    def __init__(self) -> None:
        self._now = SECOND

    def now(self) -> Time:
        return self._now

    def wait(self, duration: Duration) -> None:
        self._now += duration


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The guide's package and scenario, and drivers that are worse."""
    install(tmp_path, monkeypatch, PROJECT, paper_robot=block("paper_robot.py"), runaway=RUNAWAY)
    about = next(tmp_path.glob("*.dist-info")) / "METADATA"
    about.write_text(about.read_text() + "Requires-Dist: numpy>=1\nRequires-Dist: no-such-thing (>2)\n")
    monkeypatch.setattr(conformance, "WallRig", Hurried)
    return write(tmp_path, block("on-paper.toml"), "on-paper.toml")


def run(*arguments: object, status: int = 0) -> str:
    result = CliRunner().invoke(app, ["driver", *map(str, arguments)])
    assert result.exit_code == status, (result.output, result.exception)
    return result.stdout


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    monkeypatch.setattr("sys.argv", ["maniple", "driver", "check", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_what_is_there_is_listed_with_what_it_needs_and_can(scene: Path) -> None:
    found: dict[str, dict[str, Any]] = {
        one["name"]: one for one in json.loads(run("list", "--json"))["drivers"]
    }
    assert list(found)[:3] == ["simulator", "mavlink", "ros2"]
    assert all(found[name]["usable"] for name in ("simulator", "mavlink", "ros2"))
    assert found["mavlink"]["dependencies"].keys() == {"pymavlink", "pyserial"}
    assert found["ros2"]["capabilities"]["u_max_mps"] == 0.75
    paper = found["paper"]
    assert (paper["package"], paper["value"]) == ("paper-robots 1.0", "paper_robot:PaperRobot")
    assert paper["capabilities"]["u_max_mps"] == 0.5
    assert paper["dependencies"]["no-such-thing"] is None
    assert paper["dependencies"]["numpy"]
    assert not paper["usable"]
    assert "nowhere:Nothing can't be imported" in found["lost"]["note"]
    text = run("list")
    assert "no-such-thing (missing)" in text
    assert "0.5 m/s, 1.7 rad/s, backwards, motion 20 Hz, no scans, a frame of its own" in text


def test_without_a_scenario_only_what_it_needs_is_looked_at(scene: Path) -> None:
    assert run("check", "mavlink").startswith("mavlink: needs pymavlink ")
    assert "no-such-thing (missing)" in run("check", "paper", status=1)
    assert json.loads(run("check", "ros2", "--json"))["ok"]


def test_what_is_not_installed_is_asked_for_before_any_process_is_started(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def there(distribution: str) -> str | None:
        return None if distribution in {"pymavlink", "xxhash", "pyserial"} else "1.0"

    monkeypatch.setattr(extensions, "version_of", there)
    monkeypatch.setattr(driver_command, "version_of", there)
    assert run("check", "mavlink", status=1) == (
        "mavlink: needs pymavlink (missing), pyserial (missing); pip install 'maniple[mavlink]'\n"
    )
    mavlink = ["robots.r2.driver=mavlink", "robots.r2.presents=mavlink"]
    with pytest.raises(MissingExtraError, match=r"robots\.r2\.driver = 'mavlink' \(pymavlink\) .*\[mavl"):
        maniple.run(scene, overrides=mavlink, log=tmp_path / "x.mcap")
    with pytest.raises(MissingExtraError, match=r"robots\.r3\.scans = 'ros2' \(xxhash\) .*maniple\[ros2"):
        maniple.run(scene, overrides=["robots.r3.scans=ros2"], log=tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()


def test_a_cable_needs_more_than_a_network(monkeypatch: pytest.MonkeyPatch, scene: Path) -> None:
    monkeypatch.setattr(extensions, "version_of", lambda one: None if one == "pyserial" else "1.0")
    driven = ["robots.r2.driver=mavlink", "robots.r2.mavlink.connection="]
    extensions.require_extras(load(scene, [driven[0], driven[1] + "udpin:0.0.0.0:14599"]))
    with pytest.raises(MissingExtraError, match=r"\(pyserial\)"):
        extensions.require_extras(load(scene, [driven[0], driven[1] + "serial:/dev/ttyUSB0:57600"]))


def test_a_dry_run(scene: Path) -> None:
    text = run("check", "paper", "--scenario", scene)
    assert "paper: 10 of 10 properties hold, 12 were not tried\n" in text
    assert "pose" in text
    assert "--     stands when it is stopped (it would move the vehicle)\n" in text
    found = json.loads(run("check", "paper", "--scenario", scene, "--json"))
    assert (found["ok"], found["robot"], found["live"], found["missing"]) == (True, "r3", False, [])
    assert found["look"]["state"] == "configured"
    assert found["look"]["motion"]["pose"] == [0.0, 0.0, 0.0]
    assert found["look"]["motion_hz"] == pytest.approx(20.0, rel=0.05)
    assert [one["name"] for one in found["findings"]][: len(PROPERTIES)] == [one.name for one in PROPERTIES]


def test_a_live_run(scene: Path) -> None:
    options = ("--scenario", scene, "--live", "--yes-it-may-move")
    assert "paper: 18 of 18 properties hold, 4 were not tried\n" in run("check", "paper", *options)
    told = run("check", "runaway", *options, "--set", "robots.2.driver=runaway", status=1)
    assert "FAIL   stands when it is stopped\n       stopped it still moves after 2 s: u = " in told
    assert "ok     drives where it is told" in told


def test_a_vehicle_that_is_not_there(scene: Path) -> None:
    where = f"tcp:127.0.0.1:{free_port()}"
    robot = f'{{ id = "r3", driver = "mavlink", mavlink.connection = "{where}" }}'
    other = scene.with_name("rover.toml")
    other.write_text(
        "".join(robot if '"r3"' in line else line for line in scene.read_text().splitlines(True))
    )
    found = json.loads(run("check", "mavlink", "--scenario", other, "--patience", 1, "--json", status=1))
    assert (found["ok"], found["findings"], found["look"]["state"]) == (False, [], "closed")
    assert found["missing"][0].startswith("controllable: after 1 s it is closed, and should be configured: ")
    assert "no heartbeat of system 1" in found["missing"][0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulator"], "NAME 'simulator': is no driver of its own but a node"),
        (["nothing"], "NAME = 'nothing': no such driver is installed; there are "),
        (["lost"], "NAME = 'lost': nowhere:Nothing can't be imported"),
        (["paper", "--live"], "--live drives the vehicle, up to 2 m at a time"),
        (["paper", "--live", "--yes-it-may-move"], "--live: needs --scenario"),
        (["paper", "--robot", "r3"], "--robot: needs --scenario"),
        (["paper", "--set", "seed=1"], "--set: needs --scenario"),
        (
            ["paper", "--scenario", "SCENE", "--robot", "r1"],
            "--robot 'r1': must be one with the driver paper: r3",
        ),
        (["ros2", "--scenario", "SCENE"], "NAME 'ros2': no robot of this scenario has it as robots.driver"),
        (["paper", "--scenario", "none.toml"], "none.toml: can't be read"),
        (
            ["paper", "--scenario", "SCENE", "--set", "robots.2.options.u_max_mps=9"],
            "robots.r3.options.u_max_mps = 9: must be > 0 and <= 2",
        ),
    ],
)
def test_bad_input_is_one_message(
    scene: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    told = refused(monkeypatch, capsys, *(str(scene) if one == "SCENE" else one for one in arguments))
    assert message in told
    assert told.count("\n") == 1


def test_what_a_preflight_check_would_miss(scene: Path) -> None:
    seen = conformance.Look("configured", "a pilot has it", 1.0, 20.0, 0.0, None, {})
    scenario = load(scene)
    robot = scenario.robots[2]
    missing = list(driver_command._missing(scenario, robot, "paper", seen))
    assert missing == ["localised: it does not say how it moves"]
    guarded = load(scene, ["guard.clearance=true"])
    missing = list(driver_command._missing(guarded, robot, "paper", seen))
    assert missing[1] == "sees: no ranges have come, and its own layers go by them"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_that_is_interrupted_leaves_its_vehicle_standing(scene: Path, number: signal.Signals) -> None:
    options = ("--scenario", scene, "--set", "robots.2.driver=shy")
    with start("driver", "check", "shy", *options, packages=[scene.parent]) as process:
        assert process.stderr is not None
        heard = [process.stderr.readline()]
        while "read" not in heard[-1]:
            assert heard[-1], heard
            heard.append(process.stderr.readline())
        process.send_signal(number)
        _, rest = process.communicate(timeout=60)
    assert process.returncode == 130
    assert rest.splitlines()[-1] != "Traceback"
    steps = [line for line in (*heard, *rest.splitlines()) if not line.startswith("read")]
    assert steps[-1].strip() == "close 0.0"
