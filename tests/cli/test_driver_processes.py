"""Drivers as real processes: the very text of docs/extending.md, put where packages are found."""

import json
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

import maniple
from maniple.cli.extensions import drivers_of, installed, require_layers
from maniple.cli.loading import load
from maniple.core import codec, topics
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.messages import Drive, Motion
from maniple.host.joining import clock_of
from maniple.host.stamper import Stamper
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import start, write
from tests.cli.test_extensions import block, install
from tests.cli.test_node_processes import Processes, ended
from tests.cli.test_realtime import Run, running
from tests.waiting import eventually

PROJECT = """
[project]
name = "paper-robots"
version = "1.0"
[project.entry-points."maniple.drivers"]
paper = "paper_robot:PaperRobot"
choosy = "choosy_robot:ChoosyRobot"
stuck = "stuck_robot:StuckRobot"
"""

CHOOSY = """
class ChoosyRobot:
    def __init__(self, scenario, robot, endpoint=""):
        raise ValueError("no such colour")
"""

STUCK = """
import time
from paper_robot import PaperRobot

class StuckRobot(PaperRobot):
    def take(self, step, now):
        if step == "configure":
            time.sleep(1000)
        super().take(step, now)
"""

MARGIN_S = 0.3
"""Beyond what the watchdog allows, for a machine that is busy."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The guide's package and scenario."""
    modules = {"paper_robot": block("paper_robot.py"), "choosy_robot": CHOOSY, "stuck_robot": STUCK}
    install(tmp_path, monkeypatch, PROJECT, **modules)
    write(tmp_path, block("on-paper.toml") + "preflight.enabled = false\n", "on-paper.toml")
    return tmp_path


def test_the_guides_driver_is_found_and_only_what_is_named_is_imported(folder: Path) -> None:
    assert ("driver", "paper", "paper-robots 1.0", "paper_robot:PaperRobot") in installed(["driver"])
    scenario = load(folder / "on-paper.toml")
    assert "paper" in drivers_of(scenario)
    assert "choosy" not in drivers_of(scenario)
    assert "paper" not in drivers_of(scenario, scenario.robots[:2])
    require_layers(scenario)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "robots.r3.driver=magic",
            "robots.r3.driver = 'magic': no such driver is installed; "
            "there are choosy, mavlink, paper, ros2, simulator, stuck",
        ),
        ("robots.r3.scans=magic", "robots.r3.scans = 'magic': no such driver is installed"),
        ("robots.r3.options.u_max_mps=7.0", "robots.r3.options.u_max_mps = 7.0: must be > 0 and <= 2"),
        (
            "robots.r3.driver=choosy",
            "robots.r3: the driver 'choosy' refuses its parameters: ValueError: no such colour",
        ),
    ],
)
def test_a_driver_that_can_not_be_is_refused_before_anything_starts(
    folder: Path, override: str, message: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        maniple.run(folder / "on-paper.toml", overrides=[override], log=folder / "a.mcap")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("how", "told"), [({"virtual": True}, "virtual time"), ({"speed": 2.0}, "speed = 2")]
)
def test_what_does_not_go_by_the_wall_clock_is_refused(folder: Path, how: dict[str, Any], told: str) -> None:
    with pytest.raises(ArgumentError) as caught:
        maniple.run(folder / "on-paper.toml", log=folder / "a.mcap", **how)
    assert str(caught.value) == (
        f"{told}: drivers of their own go by the wall clock, at its speed: of r3 (driver = 'paper'); "
        "run it as it is, or simulate these robots: --set robots.r3.driver=simulator"
    )
    overrides = ["robots.r3.driver=simulator", "robots.r3.options={}"]
    simulated = maniple.run(
        folder / "on-paper.toml", virtual=True, overrides=overrides, duration_s=1.0, log=folder / "b.mcap"
    )
    assert simulated.robots == 3


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("r9",), "robot 'r9' is not in the scenario; robots are r1, r2, r3"),
        (("r1",), "robots.r1.driver = 'simulator': the simulator is no process of its own"),
        (("r3", "--scans"), "robots.r3.scans = '': no driver of its own brings its scans"),
        (
            ("r3", "--anchor", "1:2:2.0"),
            "r3-driver: the run goes at 2 times the wall clock; hardware goes at 1",
        ),
    ],
)
def test_driver_run_says_what_it_can_not_run(folder: Path, arguments: tuple[str, ...], told: str) -> None:
    with routed(folder) as (platoon, _):
        process = driver(platoon, folder, *arguments)
        status, err = ended(process)
    assert status == 2
    assert told in err
    assert "Traceback" not in err


@contextmanager
def routed(folder: Path) -> Iterator[tuple[Processes, ZenohSession]]:
    """A router of the guide's scenario, and a session on it."""
    with ExitStack() as stack:
        platoon = Processes(folder, (folder / "on-paper.toml").read_text(), stack)
        platoon.start("router")
        yield platoon, platoon.session()


def driver(platoon: Processes, folder: Path, *arguments: object) -> Any:
    return start(
        *("driver", "run", *arguments, "--scenario", platoon.scenario, "--connect", platoon.endpoint),
        packages=[folder],
    )


@pytest.mark.slow
def test_a_driver_by_hand_and_its_end(folder: Path) -> None:
    """One of a name; SIGTERM lets the robot stand; it does without what the other commands load."""
    with routed(folder) as (platoon, session):
        motions: list[Motion] = []
        session.subscribe(topics.motion("r3"), lambda topic, data: motions.append(codec.decode(topic, data)))  # type: ignore[arg-type]
        process = driver(platoon, folder, "r3")
        assert eventually(lambda: session.lives("r3-driver")) == (1,)
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        assert "pydantic" not in maps
        clock, stamper = clock_of(session), Stamper("r3", 1)

        def say() -> bool:
            order = Drive(u_mps=0.4, w_radps=0.0, active=True)
            session.put(topics.drive("r3"), stamper.stamp(topics.drive("r3"), order, clock.now()).data)
            return bool(motions) and motions[-1].twist[0] == 0.4

        eventually(say)
        status, err = ended(driver(platoon, folder, "r3", "--incarnation", 7))
        assert (status, "r3-driver is running already (incarnation 1)" in err) == (2, True)
        eventually(say)
        process.send_signal(signal.SIGTERM)
        assert ended(process) == (0, "")
        assert motions[-1].twist == (0.0, 0.0, 0.0)
        assert motions[-1].state == "active", "it was watched until it stood"
        eventually(lambda: session.lives("r3-driver") == ())


@pytest.mark.slow
def test_a_driver_that_does_not_return_takes_its_process_with_it(folder: Path) -> None:
    scene = (folder / "on-paper.toml").read_text().replace('driver = "paper"', 'driver = "stuck"')
    write(folder, scene, "on-paper.toml")
    with routed(folder) as (platoon, session):
        process = driver(platoon, folder, "r3")
        eventually(lambda: session.lives("r3-driver"))
        assert ended(process) == (1, "r3-driver: the driver has not returned for 5 s\n")
        eventually(lambda: session.lives("r3-driver") == ())


def speeds_of(log: Path, robot: str) -> list[tuple[float, float]]:
    """When by the recorder's clock, s, and how fast a robot was driven by its driver's account."""
    return [
        (record.log_time_ns / 1e9, message.twist[0])
        for record, message in read(log).decoded(Motion)
        if record.topic == topics.motion(robot)
    ]


@pytest.mark.slow
def test_a_run_in_which_agent_and_driver_are_killed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot stands within its watchdog, the others wait for it, both come back, the task is completed,
    and the recording proves the agent."""
    scene = folder / "on-paper.toml"
    with running(folder, scene, "--keep-alive", packages=[folder]) as run:
        eventually(lambda: "r3-driver" in run.children() and len(run.children()) == 8)
        with ZenohSession.client(run.option("--connect"), "maniple") as session:
            moves: list[bool] = []
            session.subscribe(
                topics.motion("r3"),
                lambda topic, data: moves.append(codec.decode(topic, data).twist[0] > 0.1),  # type: ignore[attr-defined]
            )
            for victim in ("r3", "r3-driver"):
                pid = run.children()[victim]
                eventually(lambda: moves and moves[-1])
                os.kill(pid, signal.SIGKILL)
                if victim == "r3":
                    eventually(lambda: not moves[-1])
                eventually(lambda pid=pid, victim=victim: run.children().get(victim, pid) != pid)  # type: ignore[misc]
                moves.clear()
            eventually(lambda: moves and moves[-1])
            with start("status", "--connect", run.option("--connect")) as shown:
                assert "router, driver of r3" in shown.communicate(timeout=60)[0]
        status, found, err = run.finish(200.0)
    assert status == 0, (found, err)
    assert found["restarts"] == {"r3": 1, "r3-driver": 1}
    assert "Traceback" not in err
    assert_stopped_in_time(run)
    with start("log", "verify", run.log, "--json", packages=[folder]) as verified:
        proof = json.loads(verified.communicate(timeout=200)[0])
    assert verified.returncode == 0, proof
    assert {life["node"] for life in proof["lives"]} == {"simulator", "controller", "r1", "r2", "r3"}
    assert not proof["problems"]


def assert_stopped_in_time(run: Run) -> None:
    """After the last order of the agent's first life, until the next life orders it to move."""
    orders = [
        (record.log_time_ns / 1e9, message)
        for record, message in read(run.log).decoded(Drive)
        if record.topic == topics.drive("r3")
    ]
    last = max(at for at, order in orders if order.incarnation == 1)
    again = min(at for at, order in orders if order.incarnation > 1 and order.u_mps)
    after = [(at, u) for at, u in speeds_of(run.log, "r3") if last + 0.3 + MARGIN_S < at < again]
    assert after
    assert {u for _, u in after} == {0.0}
    assert any(u > 0.1 for at, u in speeds_of(run.log, "r3") if at < last + 0.3)
