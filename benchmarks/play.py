"""`maniple log play --as-fast-as-possible` of six robots against real time: two processes over loopback.

The time is that of the receiver, from its first message to its last. One receiver counts what it hears, with
a checksum over all bytes in the order of their arrival; the other is a recorder.
"""

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from benchmarks.common import Budget, Row, show
from benchmarks.play_listener import Heard, checksum
from benchmarks.round_trip import ROOT, free_port, process
from maniple.cli.api import run
from maniple.core.time import to_seconds
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession

TITLE = "Play as fast as possible, times real time"
BUDGET = Budget(50, "ratio", "at least")
LOST = Budget(0, "ours")

SCENE = ROOT / "scenarios" / "paper-simulation-1.toml"
QUICK_S = 5.0
"""Of the scene."""
_WITHIN_S = 60.0


def rows(quick: bool = False) -> list[Row]:
    """For each receiver how fast it went, and how many messages it missed or had in another order."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "six.mcap"
        run(SCENE, virtual=True, duration_s=QUICK_S if quick else None, log=log)
        recorded_s = _span_s(log)
        count = sum(1 for _ in read(log).messages())
        found: list[Row] = []
        for name, (wall_s, missed) in (
            ("counting", _to_listener(log, count)),
            ("recorder", _to_recorder(log, Path(folder) / "again.mcap")),
        ):
            found += [
                Row(name, recorded_s / wall_s, "s/s", "real time", 1.0, BUDGET),
                Row(f"{name}: missed", missed, "missed", "nothing missed", None, LOST),
            ]
    return found


def _to_listener(log: Path, count: int) -> tuple[float, int]:
    """Wall time, s, and how many messages were missed; all where one was not the same."""
    with _player(log) as (_, endpoint, session):
        asked = [sys.executable, "-m", "benchmarks.play_listener", endpoint, read(log).prefix, str(count)]
        with process(asked) as listener:
            assert listener.stdout is not None
            listener.stdout.readline()
            session.ask("play/resume")
            heard = msgspec.json.decode(listener.stdout.readline(), type=Heard)
    expected = 0
    for message in read(log).messages():
        expected = checksum(message.topic, message.data, expected)
    same = heard.messages != count or heard.checksum == expected
    return heard.wall_s, count - heard.messages if same else count


def _to_recorder(log: Path, again: Path) -> tuple[float, int]:
    """The same."""
    with _player(log) as (player, endpoint, session):
        asked = ["recorder", "--scenario", str(SCENE), "--connect", endpoint, "--log", str(again)]
        with process([sys.executable, "-m", "maniple", *asked]) as recorder:
            _await(lambda: session.lives("recorder"))
            session.ask("play/resume")
            player.communicate(timeout=_WITHIN_S)
            recorder.send_signal(signal.SIGINT)
            recorder.communicate(timeout=_WITHIN_S)
    sent = [(message.topic, message.data) for message in read(log).messages()]
    got = [(message.topic, message.data) for message in read(again).messages()]
    return _span_s(again), 0 if got == sent else max(len(sent) - len(got), 1)


@contextmanager
def _player(log: Path) -> Iterator[tuple["subprocess.Popen[bytes]", str, ZenohSession]]:
    """A play that waits to be told to go on, where it is, and a session there."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = ["log", "play", str(log), "--listen", endpoint, "--as-fast-as-possible", "--paused"]
    with (
        process([sys.executable, "-m", "maniple", *command]) as player,
        ZenohSession.client(endpoint, read(log).prefix, _WITHIN_S) as session,
    ):
        _await(lambda: session.lives("router"))
        yield player, endpoint, session


def _await(what: Callable[[], object]) -> None:
    until = time.monotonic() + _WITHIN_S
    while not what():
        if time.monotonic() > until:
            raise RuntimeError("a process did not start")
        time.sleep(0.02)


def _span_s(log: Path) -> float:
    recording = read(log)
    return to_seconds(recording.end_ns - recording.start_ns)


if __name__ == "__main__":
    show(TITLE, rows())
