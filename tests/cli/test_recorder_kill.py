"""What is left of a recording when its recorder, a real process, is killed, told to end, or has no disk."""

import json
import os
import random
import resource
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from maniple.core import topics
from maniple.host.clock import Anchor
from maniple.host.router import RouterHost
from maniple.recording.reader import Recording, read
from maniple.recording.tally import GAPS_NAME
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import platoon, start
from tests.host.test_latched import message
from tests.recording.npm_reader import check, install
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

ROBOTS = tuple(f"r{number}" for number in range(1, 7))
STEP_S = 0.01
"""Six robots at 100 Hz: 600 messages a second."""
MOST_LOST_S = 0.5


class Source:
    """Says the odometries of six robots until it is closed; knows when it said what."""

    def __init__(self, endpoint: str) -> None:
        self._session = ZenohSession.client(endpoint, "maniple")
        self._over = threading.Event()
        self.said: list[float] = []
        """When, wall time, by sequence number."""
        self._thread = threading.Thread(target=self._say)
        self._thread.start()

    def _say(self) -> None:
        due = time.monotonic()
        while not self._over.wait(max(due - time.monotonic(), 0.0)):
            seq = len(self.said)
            self.said.append(time.time())
            for robot in ROBOTS:
                self._session.put(topics.odometry(robot), message(seq, source=robot))
            due += STEP_S

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._session.close()


class Stage:
    """A router, a source, and recorders of it."""

    def __init__(self, folder: Path, endpoint: str, stack: ExitStack) -> None:
        self.folder = folder
        self.endpoint = endpoint
        self.session = stack.enter_context(ZenohSession.client(endpoint, "maniple"))
        self.source = Source(endpoint)
        stack.callback(self.source.close)
        self._stack = stack
        self._scenario = folder / "scene.json"
        self._scenario.write_text(_scene())

    def recorder(self, name: str, *options: object, **process: Any) -> tuple[subprocess.Popen[str], Path]:
        """A recorder that has begun to write."""
        log = self.folder / f"{name}.mcap"
        arguments = ("--scenario", self._scenario, "--connect", self.endpoint, "--log", log, *options)
        recorder = start("recorder", *arguments, **process)
        self._stack.callback(recorder.communicate)
        self._stack.callback(recorder.kill)
        return recorder, log


def _scene() -> str:
    import msgspec

    return msgspec.json.encode(platoon(len(ROBOTS))).decode()


@contextmanager
def stage_in(folder: Path) -> Iterator[Stage]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as stack:
        session = stack.enter_context(ZenohSession.router(endpoint, "maniple"))
        RouterHost(session, Anchor.here(), grace_s=0.0).start()
        yield Stage(folder, endpoint, stack)


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with stage_in(tmp_path) as made:
        yield made


def messages_in(log: Path) -> int:
    return len(list(read(log).messages())) if log.exists() and log.stat().st_size else 0


def seqs(recording: Recording, robot: str) -> list[int]:
    topic = topics.odometry(robot)
    return [record.sequence for record in recording.messages(lambda name: name == topic)]


def ended(recorder: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = recorder.communicate(timeout=60)
    return recorder.returncode, err


@pytest.mark.slow
def test_a_kill_at_any_moment_costs_at_most_half_a_second(
    stage: Stage, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Fifty of them, five recorders at a time; what is left is whole, and recovered it opens everywhere."""
    checker = install(tmp_path_factory.mktemp("npm"))
    rng = random.Random(50)
    lost: list[float] = []
    logs: list[Path] = []
    for turn in range(10):
        recorders = [stage.recorder(f"{turn}-{number}") for number in range(5)]
        for _, log in recorders:
            eventually(lambda log=log: messages_in(log))  # type: ignore[misc]
        for recorder, log in recorders:
            at = time.monotonic() + rng.uniform(0.0, 0.6)
            eventually(lambda at=at: time.monotonic() >= at)  # type: ignore[misc]
            killed_at = time.time()
            recorder.kill()
            recorder.wait()
            recording = read(log)
            assert not recording.complete
            for robot in ROBOTS:
                found = seqs(recording, robot)
                assert found == list(range(found[0], found[-1] + 1))
                lost.append(killed_at - stage.source.said[found[-1]])
            logs.append(log)
    assert len(logs) == 50
    assert max(lost) <= MOST_LOST_S
    for log in logs:
        with start("log", "recover", log, "--json") as process:
            out, err = process.communicate(timeout=60)
        assert process.returncode == 0, err
        recovered = Path(json.loads(out)["out"])
        saved = list(read(recovered).messages())
        assert saved == list(read(log).messages())
        counts = check(checker, recovered)
        assert counts["streamed"] == counts["indexed"]
        ours = sum(count for key, count in counts["streamed"].items() if key.startswith("maniple/"))
        assert ours == len(saved)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_told_to_end_it_finishes_its_file(stage: Stage, number: signal.Signals) -> None:
    recorder, log = stage.recorder("a")
    eventually(lambda: messages_in(log))
    told_at = time.time()
    recorder.send_signal(number)
    status, err = ended(recorder)
    assert status == 0
    recording = read(log)
    assert recording.complete
    found = seqs(recording, "r1")
    assert stage.source.said[found[-1]] >= told_at - 0.1
    assert ("came late: " in err) == (found[0] > 0)
    gaps = recording.layouts[0].metadata[GAPS_NAME]
    own = json.loads(gaps[f"{topics.odometry('r1')} r1 1"])
    assert (own["missed_first"], own["recorded"]) == (found[0], len(found))
    assert own["missing"] == found[0]


@pytest.mark.slow
def test_a_recorder_that_comes_late_says_what_it_has_missed(stage: Stage) -> None:
    eventually(lambda: len(stage.source.said) > 50)
    recorder, log = stage.recorder("a")
    eventually(lambda: messages_in(log) > 600 * 3.5)
    recorder.send_signal(signal.SIGTERM)
    status, err = ended(recorder)
    assert status == 0
    first = seqs(read(log), "r1")[0]
    assert first > 50
    assert f"came late: the first {6 * first} messages are missing ({first} of r1, {first} of r2" in err


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--compression", "none", "--no-viz")])
def test_a_file_that_can_not_grow_ends_readable_with_a_message(
    stage: Stage, options: tuple[str, ...]
) -> None:
    """A limit on the size of files stands for the disk."""
    limit = 400_000
    recorder, log = stage.recorder(
        "a", *options, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    )
    status, err = ended(recorder)
    assert status == 1
    assert f"can't write {log}: File too large; what was recorded before can be read" in err
    assert "Traceback" not in err
    found = seqs(read(log), "r1")
    assert found == list(range(found[0], found[-1] + 1))
    assert len(found) > 100


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A file system of a few megabytes."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("there is no mount")
    if done.returncode:
        pytest.skip(f"no right to mount a file system: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
def test_it_ends_in_order_before_the_disk_is_full(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "2m") as disk, stage_in(tmp_path) as stage:
        stage.folder = disk
        recorder, log = stage.recorder("a", "--compression", "none", "--min-free", "1.2MB")
        status, err = ended(recorder)
        assert status == 1
        assert f"are free in {disk}; at 1.2 MB the recording ends" in err
        assert "error: the recording has ended: only" in err
        recording = read(log)
        assert recording.complete
        assert messages_in(log) > 500
        refused, other = stage.recorder("b", "--min-free", "2MB")
        status, err = ended(refused)
        assert status == 2
        assert "less than is to be left (--min-free): make room there" in err
        assert not other.exists()


@pytest.mark.slow
def test_a_disk_that_is_full_all_the_same(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "1m") as disk, stage_in(tmp_path) as stage:
        stage.folder = disk
        recorder, log = stage.recorder("a", "--compression", "none", "--min-free", "0")
        status, err = ended(recorder)
        assert status == 1
        assert f"can't write {log}: No space left on device; what was recorded before can be read" in err
        assert "Traceback" not in err
        assert messages_in(log) > 500


@pytest.mark.slow
def test_frozen_it_holds_up_nobody_and_goes_on(stage: Stage) -> None:
    """What is said meanwhile reaches others at once; what of it is missing then is known."""
    arrived: list[float] = []
    with ZenohSession.client(stage.endpoint, "maniple") as other:
        other.subscribe(topics.odometry("r1"), lambda *_: arrived.append(time.monotonic()))
        recorder, log = stage.recorder("a")
        eventually(lambda: messages_in(log))
        os.kill(recorder.pid, signal.SIGSTOP)
        until = time.monotonic() + 4.0
        eventually(lambda: time.monotonic() > until)
        gaps = [after - before for before, after in pairwise(arrived)]
        os.kill(recorder.pid, signal.SIGCONT)
        known = messages_in(log)
        eventually(lambda: messages_in(log) > known + 600)
        recorder.send_signal(signal.SIGTERM)
        status, err = ended(recorder)
    assert status == 0, err
    assert max(gaps) < 0.5
    recording = read(log)
    found = seqs(recording, "r1")
    missing = len(set(range(found[-1] + 1)) - set(found))
    own = json.loads(recording.layouts[0].metadata[GAPS_NAME][f"{topics.odometry('r1')} r1 1"])
    assert own["missing"] == missing
