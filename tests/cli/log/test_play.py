"""`maniple log play` as a user runs it: processes of their own, a recorder that listens, a terminal."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from maniple.cli.api import run
from maniple.cli.log.group import app
from maniple.core.errors import ArgumentError, RecordingError, RunError, TransportError
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import ROOT, SMALL, start, write
from tests.recording.traffic import record, traffic
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

FAULTS = """
faults = [{ latency_s = 0.02, jitter_s = 0.06, loss = 0.2 }]
crashes = [{ node = "r2", at_s = 4.0, restart_after_s = 1.5 }]
freezes = [{ node = "r3", at_s = 7.0, for_s = 0.8 }]
"""


def pairs(*logs: Path) -> list[tuple[str, bytes]]:
    return [(message.topic, message.data) for log in logs for message in read(log).messages()]


def told(endpoint: str, *order: str) -> dict[str, Any]:
    """What a play answers to an order."""
    result = CliRunner().invoke(app, ["player", *order, "--connect", endpoint, "--json"])
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@contextlib.contextmanager
def process(*arguments: object) -> Iterator["subprocess.Popen[str]"]:
    """A command that is ended at the end."""
    child = start(*arguments)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


@contextlib.contextmanager
def play(log: Path, *options: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """A play on a router of its own, and where that is; on another port where somebody took the first."""
    for attempt in range(3):
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        with process("log", "play", log, "--listen", endpoint, *options) as player:
            assert player.stderr is not None
            line = player.stderr.readline()
            if "can't listen" in line and attempt < 2:
                continue
            assert line.startswith(f"plays {log} onto {endpoint}"), line
            eventually(partial(here, endpoint, "router"))
            yield player, endpoint
            return


def here(endpoint: str, node: str) -> bool:
    with ZenohSession.client(endpoint, "maniple") as session:
        return node in session.everyone()


def played_and_recorded(log: Path, scenario: Path, again: Path, *options: str) -> dict[str, Any]:
    """Play a recording to a recorder that makes `again`; what the play says in the end."""
    asked = ("recorder", "--scenario", scenario, "--log", again, "--connect")
    with (
        play(log, "--paused", "--json", *options) as (player, endpoint),
        process(*asked, endpoint) as recorder,
    ):
        eventually(lambda: here(endpoint, "recorder"))
        told(endpoint, "resume")
        out, problems = player.communicate(timeout=120)
        assert player.returncode == 0, problems
        recorder.send_signal(signal.SIGINT)
        _, problems = recorder.communicate(timeout=60)
        assert recorder.returncode == 0, problems
    found: dict[str, Any] = json.loads(out)
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("scene"), SMALL + FAULTS)


@pytest.fixture(scope="module")
def virtual(scene: Path) -> Path:
    """A virtual recording with losses, a restart and a freeze."""
    log = scene.with_name("virtual.mcap")
    run(scene, virtual=True, duration_s=10.0, log=log)
    return log


@pytest.mark.parametrize(
    "pace",
    [
        pytest.param(("--rate", "20"), marks=pytest.mark.slow, id="20x"),
        pytest.param(("--as-fast-as-possible",), id="fast"),
    ],
)
def test_what_is_played_is_recorded_again_byte_for_byte(
    virtual: Path, scene: Path, tmp_path: Path, pace: tuple[str, ...]
) -> None:
    again = tmp_path / "again.mcap"
    found = played_and_recorded(virtual, scene, again, *pace)
    assert pairs(again) == pairs(virtual)
    assert found["messages"] == len(pairs(virtual))
    assert found["interrupted"] is False
    lives = {
        (message.source, message.incarnation)
        for record in read(virtual).messages(lambda name: name.startswith("journal/"))
        if (message := record.message) is not None
    }
    assert ("r2", 2) in lives, "the recording holds a restart"


@pytest.mark.slow
@pytest.mark.parametrize(
    "pace", [(), ("--rate", "20"), ("--as-fast-as-possible",)], ids=["1x", "20x", "fast"]
)
def test_a_realtime_recording_too(tmp_path: Path, pace: tuple[str, ...]) -> None:
    scene = write(tmp_path, SMALL + FAULTS)
    log, again = tmp_path / "a.mcap", tmp_path / "again.mcap"
    run(scene, speed=3.0, duration_s=12.0, log=log, keep_alive=True)
    played_and_recorded(log, scene, again, *pace)
    assert pairs(again) == pairs(log)


@pytest.mark.slow
def test_status_shows_the_platoon_of_the_recording(virtual: Path) -> None:
    with play(virtual, "--rate", "0.3", "--from", "1") as (_, endpoint):
        eventually(lambda: here(endpoint, "controller") and here(endpoint, "r1"))
        asked = start("status", "--connect", endpoint, "--json")
        out, problems = asked.communicate(timeout=60)
    state = json.loads(out)
    assert [robot["id"] for robot in state["robots"]] == ["r1", "r2", "r3"], problems
    assert {"controller", "simulator", "router"} <= set(state["nodes"])


def test_an_interrupt_ends_it_with_what_was_played(virtual: Path) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        with play(virtual, "--json") as (player, endpoint):
            eventually(lambda: here(endpoint, "r1"))
            assert told(endpoint, "status")["rate"] == 1.0
            player.send_signal(number)
            out, problems = player.communicate(timeout=30)
            assert player.returncode == 130, problems
            found = json.loads(out)
            assert found["interrupted"] is True
            assert 0 < found["messages"] < len(pairs(virtual))
            assert found["lag_max_s"] >= 0.0


@pytest.mark.slow
def test_an_interrupt_while_a_listener_does_not_read(tmp_path: Path, virtual: Path) -> None:
    script = tmp_path / "deaf.py"
    script.write_text(
        "import sys, time\n"
        "from maniple.transport.zenoh import ZenohSession\n"
        "with ZenohSession.client(sys.argv[1], 'maniple') as session:\n"
        "    session.subscribe('**', lambda *_: time.sleep(3600))\n"
        "    session.settle()\n"
        "    print('listens', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    options = ("--as-fast-as-possible", "--loop", "--paused", "--json")
    with play(virtual, *options) as (player, endpoint):
        deaf = subprocess.Popen(
            [sys.executable, script, endpoint],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        try:
            assert deaf.stdout is not None
            assert deaf.stdout.readline() == "listens\n"
            told(endpoint, "resume")
            eventually(lambda: told(endpoint, "status")["messages"] > 1000)
            player.send_signal(signal.SIGINT)
            out, problems = player.communicate(timeout=30)
            assert player.returncode == 130, problems
            assert json.loads(out)["interrupted"] is True
        finally:
            deaf.kill()
            deaf.communicate()


@pytest.mark.slow
def test_keys_on_a_terminal(virtual: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ours, theirs = pty.openpty()
    player = subprocess.Popen(
        [sys.executable, "-m", "maniple", "log", "play", str(virtual), "--listen", endpoint, "--paused"],
        stdin=theirs,
        stderr=theirs,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm", "COLUMNS": "120"},
    )
    try:
        eventually(lambda: here(endpoint, "router"))
        os.write(ours, b"s.")
        eventually(lambda: told(endpoint, "status")["messages"] == 2)
        os.write(ours, b" ")
        eventually(lambda: not told(endpoint, "status")["paused"])
        os.write(ours, b" ")
        eventually(lambda: told(endpoint, "status")["paused"])
        os.write(ours, b"x\xffq")
        out, _ = player.communicate(timeout=30)
        assert player.returncode == 130
        assert "times its time" in out
        shown = os.read(ours, 1 << 20).decode(errors="replace")
        assert "space: pause" in shown
    finally:
        player.kill()
        player.wait()
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--rate", "2", "--as-fast-as-possible"), "--rate and --as-fast-as-possible exclude each other"),
        (("--rate", "0"), "--rate 0: must be from 0.01 to 1000"),
        (("--rate", "nan"), "--rate nan: must be from 0.01 to 1000"),
        (("--loop", "--times", "2"), "--loop and --times exclude each other"),
        (("--connect", "tcp/127.0.0.1:1", "--listen", "tcp/127.0.0.1:1"), "--connect and --listen exclude"),
        (("--topic", "robot/*/odometri"), "matches 'robot/*/odometri'"),
        (("--from", "99"), "ends after 1.950 s"),
    ],
)
def test_what_makes_no_sense_is_one_error(tmp_path: Path, options: tuple[str, ...], text: str) -> None:
    path = record(tmp_path / "a.mcap", traffic())
    result = CliRunner().invoke(app, ["play", str(path), *options])
    assert isinstance(result.exception, ArgumentError)
    assert text in str(result.exception)


def test_what_is_no_endpoint_and_no_prefix(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic())
    for option in ("--connect", "--listen"):
        result = CliRunner().invoke(app, ["play", str(path), option, "nonsense"])
        assert result.exit_code == 2
    result = CliRunner().invoke(app, ["play", str(path), "--prefix", "a/**"])
    assert "prefix" in str(result.exception)


def test_where_nothing_can_be_reached_or_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniple.cli.log.play.CONNECT_S", 0.3)
    path = record(tmp_path / "a.mcap", traffic())
    result = CliRunner().invoke(app, ["play", str(path), "--connect", "tcp/127.0.0.1:1"])
    assert isinstance(result.exception, RunError)
    result = CliRunner().invoke(app, ["play", str(tmp_path / "none.mcap")])
    assert isinstance(result.exception, RecordingError)
    with ZenohSession.router(endpoint := f"tcp/127.0.0.1:{free_port()}", "maniple"):
        result = CliRunner().invoke(app, ["play", str(path), "--listen", endpoint])
        assert isinstance(result.exception, TransportError)
        result = CliRunner().invoke(app, ["player", "pause", "--connect", endpoint])
        assert isinstance(result.exception, RunError)
        assert "no recording is played under the prefix maniple" in str(result.exception)


def test_only_a_step_has_a_count() -> None:
    result = CliRunner().invoke(app, ["player", "pause", "--count", "2"])
    assert isinstance(result.exception, ArgumentError)
    assert "--count is for step" in str(result.exception)
