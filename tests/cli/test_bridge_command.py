"""`maniple bridge ros2` as people run it: a recording is played, ROS 2 sees it."""

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from maniple.cli.program import app
from maniple.core.errors import ArgumentError, MissingExtraError, RunError, ScenarioError
from maniple.transport.ros2 import Network, RosSession
from tests.cli.scenes import write
from tests.recording.viz.pictures import recorded
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

MANIPLE = [sys.executable, "-m", "maniple"]


def bridge(*options: str) -> Result:
    return CliRunner().invoke(app, ["bridge", "ros2", *options])


@pytest.mark.slow
def test_it_shows_a_platoon_until_it_is_asked_to_end() -> None:
    log, endpoint = recorded(), f"tcp/127.0.0.1:{free_port()}"
    scene = log.with_name("drawn.toml")
    heard: list[Any] = []
    with subprocess.Popen(
        [*MANIPLE, "log", "play", str(log), "--listen", endpoint, "--loop"], stderr=subprocess.PIPE, text=True
    ) as play:
        assert play.stderr is not None
        assert "plays" in play.stderr.readline()
        command: Sequence[str] = [*MANIPLE, "bridge", "ros2", str(scene), "--connect", endpoint, "--json"]
        options = ["--domain-id", "3", "--namespace", "/fleet", "--set", "guard.margin_m=0.07"]
        with subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            with RosSession.open(endpoint, "viewer", network=Network(domain_id=3)) as ros:
                ros.subscribe("/fleet/r1/pose", "geometry_msgs/msg/PoseStamped", lambda m, _: heard.append(m))
                eventually(lambda: len(heard) > 30, DEADLINE_S)  # more than a second: a status, too
            process.send_signal(signal.SIGTERM)
            out, said = process.communicate(timeout=DEADLINE_S)
        play.send_signal(signal.SIGINT)
        play.wait(DEADLINE_S)
    assert process.returncode == 0
    assert said.splitlines() == [
        f"publishes the platoon at {endpoint} on {endpoint} (rmw_zenoh, domain 3) under /fleet"
    ]
    found = json.loads(out)
    assert found["told"] == sum(found["topics"].values()) > 0
    assert found["topics"]["/fleet/r1/pose"] >= len(heard)
    assert (found["namespace"], found["domain_id"], found["refused"]) == ("/fleet", 3, {})


def test_mistakes_are_told(tmp_path: Path) -> None:
    scene, nobody = str(write(tmp_path)), f"tcp/127.0.0.1:{free_port()}"
    quick = ["--connect", nobody, "--timeout", "0.2"]
    assert isinstance(bridge(str(tmp_path / "none.toml"), *quick).exception, ScenarioError)
    assert isinstance(bridge(scene, *quick, "--namespace", "a-b").exception, ArgumentError)
    failure = bridge(scene, *quick).exception
    assert isinstance(failure, RunError)
    assert nobody in str(failure)
    for options, word in (
        (["--router", "localhost"], "an endpoint looks like"),
        (["--connect", "localhost"], "an endpoint looks like"),
        (["--domain-id", "233"], "domain-id"),
        (["--layout", "dds"], "ros2dds"),
    ):
        result = bridge(scene, *quick, *options)
        assert result.exit_code == 2
        assert word in result.output


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    failure = bridge(str(write(tmp_path))).exception
    assert isinstance(failure, MissingExtraError)
    assert "pip install 'maniple[ros2]'" in str(failure)
