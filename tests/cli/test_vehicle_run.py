"""`maniple vehicle`."""

import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from maniple.cli import node_commands
from maniple.core.errors import ScenarioError
from maniple.host.clock import Anchor
from maniple.host.ending import ask_to_end
from maniple.host.router import RouterHost
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import SMALL, start, write
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually


def scenario(folder: Path, port: int) -> Path:
    """The small scene, with `r1` presented."""
    link = f'mavlink = {{ connection = "tcp:127.0.0.1:{port}" }}'
    shown = f'{{ id = "r1", driver = "mavlink", presents = "mavlink", {link} }}'
    return write(folder, SMALL.replace('{ id = "r1" }', shown))


@pytest.fixture
def router(tmp_path: Path) -> Iterator[tuple[str, ZenohSession]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "maniple") as session:
        host = RouterHost(session, Anchor.here(), None, grace_s=0.0)
        host.start()
        thread = threading.Thread(target=host.run, args=(0.0,))
        thread.start()
        try:
            with ZenohSession.client(endpoint, "maniple") as ear:
                yield endpoint, ear
        finally:
            host.stop()
            thread.join(10.0)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, words = process.communicate(timeout=30.0)
    return process.returncode, words


def test_who_is_shown_as_nothing_is_refused(tmp_path: Path) -> None:
    path = scenario(tmp_path, 5799)
    for robot, words in (
        ("r2", "robots.r2.presents = 'nothing': it is shown as no vehicle; those that are: r1"),
        ("r9", "robot 'r9' is not in the scenario; robots are r1, r2, r3"),
    ):
        with pytest.raises(ScenarioError, match=words):
            node_commands.main(["vehicle", robot, "--scenario", str(path)])


@pytest.mark.slow
def test_a_taken_port_is_said_and_the_end_may_be_asked_for(
    tmp_path: Path, router: tuple[str, ZenohSession]
) -> None:
    endpoint, ear = router
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        path = scenario(tmp_path, port)
        with start("vehicle", "r1", "--scenario", path, "--connect", endpoint) as process:
            code, words = ended(process)
    assert code == 2
    assert words == f"error: tcpin:127.0.0.1:{port}: Address already in use\n"
    with start("vehicle", "r1", "--scenario", path, "--connect", endpoint) as process:
        eventually(lambda: ear.lives("r1-vehicle"))
        with start("vehicle", "r1", "--scenario", path, "--connect", endpoint) as second:
            code, words = ended(second)
            assert code == 2
            assert "r1-vehicle is running already" in words
        ask_to_end(ear, "r1-vehicle")  # its answer may be lost as it ends
        assert ended(process) == (0, "")
    assert not ear.lives("r1-vehicle")
