"""`maniple log keep`, `pause` and `resume`, as an operator types them, with real recorders."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from maniple.core.scenario.parse import to_json
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.recorder import RecorderHost
from maniple.host.router import RouterHost
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.recording.rolling import Ring, RollingWriter
from maniple.recording.split import PartsWriter
from maniple.recording.writer import RecordingWriter
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import start
from tests.host.nodes import scenario_with
from tests.host.test_latched import message
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

TOPIC = "robot/r1/odometry"


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "test") as session:
        RouterHost(session, Anchor.here(), grace_s=0.0).start()
        yield address


@contextmanager
def recorder(endpoint: str, folder: Path, rolling: bool) -> Iterator[RecorderHost]:
    """A recorder in a thread of its own."""
    scenario, numbers = scenario_with(), count(1)

    def begin(_: object) -> RecordingWriter:
        path = folder / f"{next(numbers)}.mcap"
        return RecordingWriter(path, to_json(scenario), {"mode": "realtime"}, prefix="test")

    writer = RollingWriter(begin, Ring(60 * SECOND)) if rolling else PartsWriter(begin)
    with closing(writer), ZenohSession.client(endpoint, "test") as session:
        host = RecorderHost(writer, Anchor.here(), [session], scenario)
        thread = Thread(target=host.run)
        thread.start()
        try:
            with ZenohSession.client(endpoint, "test") as other:
                eventually(lambda: other.lives("recorder"))
            yield host
        finally:
            host.stop()
            thread.join(DEADLINE_S)


class Console:
    """`maniple log ...` on one network, and a node there."""

    def __init__(self, endpoint: str, stack: ExitStack) -> None:
        self._endpoint = endpoint
        self._session = stack.enter_context(ZenohSession.client(endpoint, "test"))
        self._seq = count()

    def hear(self, messages: int) -> None:
        for _ in range(messages):
            self._session.put(TOPIC, message(next(self._seq)))
        self._session.settle()

    def run(self, *arguments: object) -> tuple[int, str, str]:
        with start("log", *arguments, "--connect", self._endpoint, "--prefix", "test") as process:
            out, err = process.communicate(timeout=60)
        return process.returncode, out, err

    def status(self) -> dict[str, Any]:
        with start("status", "--connect", self._endpoint, "--prefix", "test", "--json") as process:
            out, _ = process.communicate(timeout=60)
        found: dict[str, Any] = json.loads(out)
        return found

    def asked(self, *arguments: object) -> tuple[int, dict[str, Any]]:
        status, out, err = self.run(*arguments, "--json")
        assert err == ""
        found: dict[str, Any] = json.loads(out)
        return status, found


@pytest.fixture
def console(endpoint: str) -> Iterator[Console]:
    with ExitStack() as stack:
        yield Console(endpoint, stack)


@pytest.mark.slow
def test_paused_and_resumed(endpoint: str, console: Console, tmp_path: Path) -> None:
    with recorder(endpoint, tmp_path, rolling=False):
        console.hear(3)
        status, found = console.asked("pause", "--reason", "lunch")
        assert (status, found["ok"], found["order"]) == (0, True, "pause")
        (one,) = found["recorders"]
        assert (one["state"], one["reason"]) == ("paused", "lunch")
        status, out, _ = console.run("pause")
        assert (status, "it is paused already" in out) == (1, True)
        (told,) = console.status()["recorders"]
        assert (told["state"], told["reason"], told["file"]) == ("paused", "lunch", str(tmp_path / "1.mcap"))
        console.hear(4)
        status, out, _ = console.run("resume")
        assert status == 0
        assert "4 messages in" in out
        console.hear(2)
        assert console.run("resume")[0] == 1
        status, out, _ = console.run("keep")
        assert (status, "--keep-last" in out) == (1, True)
    recording = read(tmp_path / "1.mcap")
    assert [entry.sequence for entry in recording.messages() if entry.topic == TOPIC] == [0, 1, 2, 7, 8]
    info = describe(recording)
    assert (info.missing, info.left_out) == (0, 4)
    assert any("paused: lunch" in text for text in info.absences)


def test_kept_twice(endpoint: str, console: Console, tmp_path: Path) -> None:
    with recorder(endpoint, tmp_path, rolling=True):
        console.hear(3)
        status, found = console.asked("keep", "--reason", "a bump")
        assert status == 0
        (one,) = found["recorders"]
        assert (one["messages"], one["file"]) == (3, str(tmp_path / "1.mcap"))
        console.hear(2)
        status, found = console.asked("keep", "--after", 3600)
        assert found["recorders"][0]["state"] == "keeping"
        console.hear(2)
    counts = [
        sum(entry.topic == TOPIC for entry in read(path).messages()) for path in sorted(tmp_path.iterdir())
    ]
    assert counts == [3, 7]


@pytest.mark.slow
def test_one_that_keeps_beside_one_that_records_everything(
    endpoint: str, console: Console, tmp_path: Path
) -> None:
    folders = [tmp_path / name for name in ("all", "last")]
    for folder in folders:
        folder.mkdir()
    with recorder(endpoint, folders[0], rolling=False), recorder(endpoint, folders[1], rolling=True):
        console.hear(3)
        status, found = console.asked("keep")
    assert (status, found["ok"]) == (0, True)
    assert sorted((one["ok"], one["meant"]) for one in found["recorders"]) == [(False, False), (True, True)]


def test_no_recorder(console: Console) -> None:
    for command in ("keep", "pause", "resume"):
        status, out, err = console.run(command)
        assert (status, out) == (1, "")
        assert "no recorder is there" in err
        assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("keep", "--after", "-1"), "--after -1: must be from 0"),
        (("keep", "--after", "nan"), "--after nan: must be"),
        (("keep", "--timeout", "0"), "--timeout"),
        (("pause", "--connect", "nowhere"), "an endpoint looks like"),
    ],
)
def test_bad_input(arguments: tuple[str, ...], problem: str) -> None:
    with start("log", *arguments) as process:
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert problem in err
