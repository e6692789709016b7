"""Vehicles as processes with a MAVLink port: a presented robot, and a real rover where there is one."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from maniple.core import codec, topics
from maniple.core.messages import Truth
from maniple.transport.zenoh import ZenohSession
from tests.ardurover import ardurover
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

POSE = (3.0, -2.0, 0.5)
SCENARIO = """
name = "shown"
formation.points = [[0.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]]
task = {{ kind = "line", start = [0.0, 0.0], end = [5.0, 0.0], speed_mps = 0.1 }}

[[robots]]
id = "r1"
driver = "mavlink"
presents = "mavlink"
pose = [3.0, -2.0, 0.5]
mavlink = {{ connection = "tcp:127.0.0.1:{port}", origin = [47.3977, 8.5456, 488.0] }}

[[robots]]
id = "r2"

[[robots]]
id = "r3"
"""


Peer = tuple[int, list[Truth]]
"""The port of a vehicle, and the ground truth as it comes: of a presented robot only."""


@contextmanager
def real(folder: Path) -> Iterator[Peer]:
    with ardurover(folder) as port:
        yield port, []


@contextmanager
def presented(tmp_path: Path) -> Iterator[Peer]:
    port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
    scenario = tmp_path / "shown.toml"
    scenario.write_text(SCENARIO.format(port=port))
    truths: list[Truth] = []

    def heard(topic: str, data: bytes) -> None:
        truth = codec.decode(topic, data)
        assert isinstance(truth, Truth)
        truths.append(truth)

    with ExitStack() as stack:

        def start(*arguments: str) -> None:
            command = [sys.executable, "-m", "maniple", *arguments, "--scenario", str(scenario)]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            stack.callback(lambda: process.wait(20.0) == 0 or pytest.fail(f"{arguments} failed"))
            stack.callback(process.terminate)

        start("router", "--listen", endpoint)
        start("simulator", "--connect", endpoint)
        start("vehicle", "r1", "--connect", endpoint)
        with ZenohSession.client(endpoint, "maniple", 20.0) as ear:
            ear.subscribe(topics.TRUTH, heard)
            eventually(lambda: ear.lives("r1-vehicle") and truths)
            yield port, truths
