"""The recorder as a process, over Zenoh: thirty robots at 20 Hz with scans, and a burst of ten times that."""

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec

from benchmarks.round_trip import ROOT, process, router
from benchmarks.round_trip_peers import PREFIX
from maniple.cli.loading import completed
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.recording.reader import Recorded, read
from maniple.transport.zenoh import ZenohSession

ROBOTS, SOURCES = 30, 3
"""So many robots in so many processes."""
CALM_S, BURST_S = 4.0, 5.0
QUICK_ROBOTS, QUICK_CALM_S, QUICK_BURST_S = 3, 0.5, 0.5
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_WAIT_S = 60.0


class Load(NamedTuple):
    """What became of it."""

    sent: int
    lost: int
    """By sequence number."""
    cpu_s: float
    """Of the recorder, from the first message to the end."""
    most_mb: float
    """Memory of the recorder at most."""
    said: str
    """By the recorder, on standard error."""
    messages: list[Recorded]


class _Source(msgspec.Struct):
    sent: dict[str, int]
    late_s: float


def measure(viz: bool, quick: bool = False) -> Load:
    """Run it once: calm, burst, calm."""
    robots = [f"r{number}" for number in range(1, (QUICK_ROBOTS if quick else ROBOTS) + 1)]
    calm_s, burst_s = (QUICK_CALM_S, QUICK_BURST_S) if quick else (CALM_S, BURST_S)
    spans = [str(span_s) for span_s in (calm_s, burst_s, calm_s / 2.0)]
    with tempfile.TemporaryDirectory() as folder, router() as endpoint:
        scene, log = Path(folder) / "scene.json", Path(folder) / "a.mcap"
        scene.write_bytes(to_json(_scenario(robots)))
        options = ["--scenario", str(scene), "--connect", endpoint, "--log", str(log)]
        if not viz:
            options.append("--no-viz")
        with subprocess.Popen(
            [sys.executable, "-m", "maniple", "recorder", *options],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        ) as recorder:
            with ZenohSession.client(endpoint, PREFIX) as session:
                _await(lambda: session.lives("recorder") != ())
            begin_s = _cpu_s(recorder.pid)
            sent = _say(endpoint, robots, spans)
            _await(lambda: _at_rest(recorder.pid))
            cpu_s, most_mb = _cpu_s(recorder.pid) - begin_s, _most_mb(recorder.pid)
            recorder.terminate()
            _, said = recorder.communicate(timeout=_WAIT_S)
        messages = list(read(log).messages())
    got = Counter(message.topic for message in messages)
    lost = sum(count - got[topic] for topic, count in sent.items())
    return Load(sent.total(), lost, cpu_s, most_mb, said, messages)


def _say(endpoint: str, robots: list[str], spans: list[str]) -> Counter[str]:
    """Have the sources say it all; how many messages of each topic that was."""
    sent: Counter[str] = Counter()
    parts = [robots[number::SOURCES] for number in range(SOURCES)]
    commands = [
        [sys.executable, "-m", "benchmarks.recorder_source", endpoint, PREFIX, ",".join(part), *spans]
        for part in parts
    ]
    with process(commands[0]) as a, process(commands[1]) as b, process(commands[2]) as c:
        for source in (a, b, c):
            assert source.stdout is not None
            source.stdout.readline()
        for source in (a, b, c):
            assert source.stdin is not None
            source.stdin.write(b"go\n")
            source.stdin.flush()
        for source in (a, b, c):
            assert source.stdout is not None
            sent.update(msgspec.json.decode(source.stdout.readline(), type=_Source).sent)
    return sent


def _scenario(robots: list[str]) -> Scenario:
    table = {
        "name": "load",
        "network": {"prefix": PREFIX},
        "task": {"kind": "line", "start": [0, 0], "end": [2, 0], "speed_mps": 0.1},
        "formation": {"points": [[-1.2 * i, 0.9 * (-1) ** i] for i in range(len(robots))]},
        "robots": [{"id": robot} for robot in robots],
        "guard": {"clearance": False},
    }
    return completed(msgspec.convert(table, Scenario))


def _await(what: Callable[[], bool]) -> None:
    until = time.monotonic() + _WAIT_S
    while not what():
        if time.monotonic() > until:
            raise RuntimeError("the recorder did not come up, or did not come to rest")
        time.sleep(0.1)


def _at_rest(pid: int) -> bool:
    """Whether a process does next to nothing for a moment."""
    begin_s = _cpu_s(pid)
    time.sleep(0.5)
    return _cpu_s(pid) - begin_s < 0.05


def _cpu_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S


def _most_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3
