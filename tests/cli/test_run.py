"""Whole runs in virtual time, from Python and from the command line."""

import json
import os
import re
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader

import maniple
from maniple.cli import main as program
from maniple.cli.recording_options import RecordingOptions
from maniple.core.errors import ArgumentError, RecordingError, ScenarioError
from maniple.core.messages import Command
from maniple.core.scenario.types import Scenario
from maniple.recording.export_foxglove import export_foxglove
from maniple.recording.reader import read
from tests.cli.scenes import (
    ERRORS,
    PAPER,
    ROOT,
    SMALL,
    assert_small_errors,
    platoon,
    poses,
    span_s,
    speeds,
    start,
    truths,
    write,
)
from tests.waiting import eventually

FIELDS = [
    "scenario",
    "mode",
    "seed",
    "robots",
    "duration_s",
    "wall_s",
    "real_time_factor",
    "completed",
    "collisions",
    "min_clearance_m",
    "final_error",
    "peak_error",
    "estimated_final_error",
    "messages",
    "command_age_ms",
    "log",
    "lost_robots",
    "odometry_drift_m",
    "without_truth",
    "unrecorded",
    "logs",
    "restarts",
    "interrupted",
]


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


Maniple = Callable[..., Outcome]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Maniple:
    """The command, in this process."""

    def call(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["maniple", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            program.main()
        status = ended.value.code
        assert isinstance(status, int)
        return Outcome(status, *capsys.readouterr())

    return call


@pytest.fixture
def small(tmp_path: Path) -> Path:
    return write(tmp_path)


def run_virtual(scenario: Scenario | Path, folder: Path, **options: Any) -> maniple.Result:
    return maniple.run(scenario, virtual=True, log=folder / "run.mcap", **options)


def test_the_paper_scene(tmp_path: Path) -> None:
    """Six robots, five obstacles, the printed gains; at least three are pushed aside."""
    result = run_virtual(PAPER, tmp_path)
    assert result.ok
    assert result.completed
    assert result.collisions == 0
    assert result.min_clearance_m is not None
    assert result.min_clearance_m > 0
    assert_small_errors(result.final_error)
    assert_small_errors(result.estimated_final_error)
    assert result.peak_error.position_m is not None
    assert result.peak_error.position_m > 0.1
    assert (result.messages.lost_other, result.messages.refused) == (0, 0)
    assert result.duration_s == pytest.approx(165.0, abs=1.0)
    y = poses(result.log)[..., 1]
    aside = np.abs(y - y[0]).max(axis=0)
    assert (aside > 0.15).sum() >= 3
    assert (speeds(truths(result.log)[-1]) < 1e-3).all()


def test_the_command_prints_one_object_with_every_field(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with start("run", small, "--virtual", "--json", "--seed", 7, "--log", log) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert out.count("\n") == 1
    found = json.loads(out)
    assert list(found) == FIELDS
    for name in ("final_error", "peak_error", "estimated_final_error"):
        assert list(found[name]) == ERRORS
    assert list(found["messages"]) == ["sent", "delivered", "lost_injected", "lost_other", "refused"]
    assert list(found["command_age_ms"]) == ["p50", "p99"]
    assert (found["scenario"], found["mode"], found["seed"], found["robots"]) == ("small", "virtual", 7, 3)
    assert found["real_time_factor"] == pytest.approx(found["duration_s"] / found["wall_s"], rel=0.01)
    assert found["duration_s"] == pytest.approx(20.0, abs=1.0)
    assert found["log"] == str(log)
    assert found["logs"] == [str(log)]
    recording = read(log)
    assert recording.complete
    assert recording.scenario.seed == 7
    assert recording.metadata["mode"] == "virtual"


def test_python_and_the_command_do_the_same(small: Path, tmp_path: Path, command: Maniple) -> None:
    log = tmp_path / "b.mcap"
    outcome = command("run", small, "--virtual", "--json", "--log", log, "--set", "controller.kappa=0.3")
    assert outcome.status == 0
    result = run_virtual(small, tmp_path, overrides=["controller.kappa=0.3"])
    timing = {"wall_s": 0.0, "real_time_factor": 0.0, "log": "", "logs": []}
    assert json.loads(outcome.out) | timing == msgspec.to_builtins(result) | timing
    assert log.read_bytes() == Path(result.log).read_bytes()


def test_the_summary_for_people(small: Path, tmp_path: Path, command: Maniple) -> None:
    outcome = command("run", small, "--virtual", "--log", tmp_path / "a.mcap")
    assert outcome.status == 0
    for text in ("completed", "final error", "command age", "0 injected", str(tmp_path / "a.mcap")):
        assert text in outcome.out


def test_a_seed_decides_everything(small: Path, tmp_path: Path) -> None:
    overrides = ["faults=[{loss=0.2, latency_s=0.05, jitter_s=0.04}]", "start.scatter_m=0.1"]
    logs = {}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        log = tmp_path / f"{name}.mcap"
        maniple.run(small, virtual=True, log=log, seed=seed, duration_s=8, overrides=overrides)
        logs[name] = log
    assert logs["a"].read_bytes() == logs["b"].read_bytes()
    said = {name: [record.data for record in read(log).messages()] for name, log in logs.items()}
    assert said["a"] == said["b"]
    assert said["a"] != said["c"]


def test_a_recording_tells_no_path_and_no_time(small: Path, tmp_path: Path) -> None:
    """Neither in what it says of itself nor in a message, decompressed; the host's name not as a word."""
    log = Path(run_virtual(small, tmp_path, duration_s=1).log)
    with log.open("rb") as file:
        reader = make_reader(file)
        said = [message.data for _, _, message in reader.iter_messages()]
        said += [attachment.data for attachment in reader.iter_attachments()]
        said += [repr(entry).encode() for entry in reader.iter_metadata()]
    host = re.compile(rb"\b" + re.escape(os.uname().nodename.encode()) + rb"\b")
    for data in said:
        assert str(tmp_path).encode() not in data
        assert str(ROOT).encode() not in data
        assert not host.search(data)


def test_the_end_comes_by_duration(small: Path, tmp_path: Path, command: Maniple) -> None:
    log = tmp_path / "a.mcap"
    outcome = command("run", small, "--virtual", "--json", "--duration", 3, "--log", log)
    assert outcome.status == 1
    found = json.loads(outcome.out)
    assert found["completed"] is False
    assert found["interrupted"] is False
    assert found["duration_s"] == pytest.approx(3.0, abs=0.2)
    assert read(log).complete


def test_what_cannot_die_in_virtual_time_is_told(small: Path, tmp_path: Path) -> None:
    told: list[str] = []
    fates = ["crashes=[{node='r1', at_s=9}, {node='router', at_s=1}]"]
    fates.append("freezes=[{node='recorder', at_s=1, for_s=1}]")
    run_virtual(small, tmp_path, duration_s=0.5, overrides=fates, on_notice=told.append)
    assert [text.partition(";")[0] for text in told] == [
        "crashes[1] does nothing: there is no router in virtual time",
        "freezes[0] does nothing: there is no recorder in virtual time",
    ]


def test_an_existing_recording_is_left_alone(small: Path, tmp_path: Path, command: Maniple) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"precious")
    for mode in (["--virtual"], []):
        outcome = command("run", small, *mode, "--log", log)
        assert outcome.status == 2
        assert "exists already" in outcome.err
    assert log.read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--speed", "0"], "speed = 0: must be from 0.01 to 1000"),
        (["--speed", "-1"], "speed = -1: must be from 0.01"),
        (["--speed", "nan"], "speed = nan: must be from 0.01"),
        (["--speed", "1e9"], "speed = 1e+09: must be from 0.01 to 1000"),
        (["--virtual", "--speed", "2"], "virtual time goes as fast as it can"),
        (["--virtual", "--duration", "0"], "duration = 0 s: must be above 0"),
        (["--virtual", "--duration", "inf"], "duration = inf s: must be above 0"),
        (["--virtual", "--duration", "nan"], "duration = nan s: must be above 0"),
        (["--virtual", "--seed", "-1"], "seed = -1"),
        (["--virtual", "--set", "controller.kapa=1"], "controller.kapa: unknown field; valid: kappa"),
        (["--virtual", "--set", "controller.kappa"], "controller.kappa"),
        (["--virtual", "--set", "controller.kappa=fast"], "kappa"),
        (["--virtual", "--log", "nowhere/a.mcap"], "nowhere is not a directory"),
        (["--log", "nowhere/a.mcap"], "nowhere is not a directory"),
        (["--virtual", "--log", "x" * 300], "File name too long"),
    ],
)
def test_bad_input_is_one_message(
    small: Path, command: Maniple, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(small.parent)
    outcome = command("run", small, *arguments)
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert message in outcome.err
    assert "Traceback" not in outcome.err
    assert not (small.parent / "logs").exists()


@pytest.mark.parametrize("name", ["missing.toml", "folder", "a.mcap"])
def test_no_scenario_there(tmp_path: Path, command: Maniple, name: str) -> None:
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "folder").mkdir()
    outcome = command("run", tmp_path / name, "--virtual")
    assert outcome.status == 2
    assert outcome.err.startswith("error: ")
    assert name in outcome.err


def test_python_raises_what_the_command_prints(tmp_path: Path, small: Path) -> None:
    with pytest.raises(ArgumentError, match="speed = 0"):
        maniple.run(small, speed=0)
    with pytest.raises(ScenarioError, match="can't be read"):
        maniple.run(tmp_path / "missing.toml", virtual=True)
    with pytest.raises(ScenarioError, match="overrides are for scenario files"):
        maniple.run(platoon(3), virtual=True, overrides=["seed=2"])
    with pytest.raises(ScenarioError, match="seed"):
        maniple.run(platoon(3), virtual=True, seed=-1)
    with pytest.raises(RecordingError, match="exists already"):
        maniple.run(small, virtual=True, log=small)


def test_recordings_land_in_logs(small: Path, command: Maniple, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small.parent)
    found = []
    for _ in range(2):
        outcome = command("run", small, "--virtual", "--json", "--duration", 0.5)
        found.append(Path(json.loads(outcome.out)["log"]))
    assert found[0] != found[1]
    for log in found:
        assert log.parent == Path("logs")
        assert log.name.startswith("small-virtual-")
        assert read(log).complete


def test_logs_can_not_be_made(small: Path, command: Maniple, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small.parent)
    Path("logs").write_text("a file")
    outcome = command("run", small, "--virtual")
    assert outcome.status == 2
    assert outcome.err.startswith("error: can't create")


@pytest.mark.parametrize("contact", ["r1|obstacle 0", "r2|r3"])
def test_a_contact_is_counted_and_fails_the_run(tmp_path: Path, command: Maniple, contact: str) -> None:
    """With all that protects it off, a robot drives into what stands before it."""
    blind = "[avoidance]\nenabled = false\n"
    wall = '[[world.obstacles]]\nkind = "wall"\nstart = [1.6, -0.3]\nend = [1.6, 0.3]\n'
    path = write(tmp_path, SMALL + blind + wall)
    if contact == "r2|r3":  # they swap sides to lead the triangle to where r1 is
        robots = 'robots = [{ id = "r1", pose = [-1.5, 0.8, 0] }, { id = "r2" }, { id = "r3" }]'
        before = 'robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]'
        path = write(tmp_path, SMALL.replace(before, robots) + blind)
    log = tmp_path / "a.mcap"
    outcome = command("run", path, "--virtual", "--json", "--log", log)
    assert outcome.status == 1
    found = json.loads(outcome.out)
    assert found["collisions"] >= 1
    assert found["min_clearance_m"] <= 0
    assert found["completed"] is True
    touched = {found for truth in truths(log) for found in truth.contacts}
    assert touched == {contact}


@pytest.mark.parametrize("robots", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (10, 50, 100))])
def test_scattered_starts_converge(tmp_path: Path, robots: int) -> None:
    result = run_virtual(platoon(robots, start={"scatter_m": 0.5}), tmp_path)
    assert result.ok
    assert result.peak_error.position_m is not None
    assert result.peak_error.position_m > 0.1
    assert_small_errors(result.final_error)


@pytest.mark.parametrize("layer", ["kinematics", "avoidance", "compensation", "drive"])
def test_the_layers_run_where_the_scenario_says(small: Path, tmp_path: Path, layer: str) -> None:
    obstacle = 'world.obstacles=[{kind="circle", centre=[0.7, 1.25], radius_m=0.1}]'
    result = run_virtual(
        small, tmp_path, overrides=[f"placement.robot_from={layer}", "task.settle_s=40", obstacle]
    )
    assert result.ok, result
    assert_small_errors(result.final_error)
    sent = {message.layer for _, message in read(result.log).decoded(Command)}
    assert sent == {layer}


@pytest.mark.parametrize("layer", ["kinematics", "drive"])
def test_a_bad_network(tmp_path: Path, layer: str) -> None:
    """30 % loss and 100 +- 50 ms on every link: what is sent is delivered, lost on purpose, or refused
    because a later one was faster."""
    fault = {"loss": 0.3, "latency_s": 0.1, "jitter_s": 0.05}
    scenario = platoon(3, faults=[fault], start={"scatter_m": 0.3}, placement={"robot_from": layer})
    result = run_virtual(scenario, tmp_path)
    assert result.ok, result
    assert_small_errors(result.final_error, 0.03)
    counts = result.messages
    assert counts.lost_injected / counts.sent == pytest.approx(0.3, abs=0.02)
    assert counts.lost_other == 0
    on_the_way = counts.sent - counts.delivered - counts.lost_injected - counts.refused
    assert 0 <= on_the_way <= 40
    assert result.command_age_ms.p50 is not None
    assert result.command_age_ms.p50 > 200


def test_a_run_in_parts_is_the_same_run(small: Path, tmp_path: Path) -> None:
    whole = run_virtual(small, tmp_path)
    (tmp_path / "parts").mkdir()
    parts = run_virtual(small, tmp_path / "parts", recording=RecordingOptions(split_s=5.0))
    assert len(parts.logs) > 3
    assert parts.logs[1] == str(tmp_path / "parts" / "run-2.mcap")
    recording = read(parts.log)
    assert [str(path) for path in recording.paths] == parts.logs
    assert list(recording.messages()) == list(read(whole.log).messages())
    assert parts.final_error == whole.final_error


def test_topics_may_be_left_out_of_a_virtual_recording(small: Path, tmp_path: Path) -> None:
    """The figures are made all the same, and what that means is told."""
    told: list[str] = []
    options = RecordingOptions(without=("sim/truth", "hw/**"), compression="none")
    result = run_virtual(small, tmp_path, recording=options, on_notice=told.append)
    assert result.completed
    assert result.min_clearance_m is not None
    names = {entry.topic for entry in read(result.log).messages()}
    assert "robot/r1/odometry" in names
    assert not any(name.startswith(("hw/", "sim/")) for name in names)
    (notice,) = told
    assert "not recorded, as asked" in notice


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--split-size", "1kB"), "split size: must be at least 1 MB"),
        (("--split-size", "many"), "--split-size: 'many' is no size"),
        (("--min-free", "9999TB"), "--min-free"),
        (("--compression", "lz4"), "--compression lz4: must be zstd or none"),
        (("--topic", "a//b"), "topic pattern 'a//b'"),
    ],
)
def test_how_it_is_recorded_is_checked_first(
    small: Path, tmp_path: Path, command: Maniple, options: tuple[str, ...], problem: str
) -> None:
    log = tmp_path / "a.mcap"
    status, out, err = command("run", small, "--virtual", "--log", log, *options)
    assert (status, out) == (2, "")
    assert problem in err
    assert not log.exists()


def test_a_run_of_processes_records_what_its_figures_are_made_of(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with pytest.raises(ArgumentError, match="sim/truth must be recorded"):
        maniple.run(small, log=log, recording=RecordingOptions(without=("sim/*",)))
    assert list(tmp_path.glob("*.mcap")) == []


def test_a_virtual_run_can_draw_for_viewers(small: Path, tmp_path: Path, command: Maniple) -> None:
    """The same messages as without, the same bytes again, and what an export derives from them."""
    logs = {name: tmp_path / f"{name}.mcap" for name in ("a", "b", "bare", "exported")}
    for name, options in (("a", ["--viz"]), ("b", ["--viz"]), ("bare", [])):
        assert command("run", small, "--virtual", "--log", logs[name], *options)[0] == 0
    assert logs["a"].read_bytes() == logs["b"].read_bytes()
    bare = read(logs["bare"])
    assert list(read(logs["a"]).messages()) == list(bare.messages())
    export_foxglove(bare, logs["exported"])
    drawn = {name: for_viewers(log) for name, log in logs.items()}
    assert drawn["a"] == drawn["exported"] != []
    assert drawn["bare"] == []


def for_viewers(log: Path) -> list[tuple[str, int, bytes]]:
    """What a file holds for viewers."""
    with log.open("rb") as file:
        found = [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(file).iter_messages()]
    return [one for one in found if one[0].startswith("/viz/")]


def test_progress_is_reported(tmp_path: Path) -> None:
    heard: list[Any] = []
    result = run_virtual(platoon(3), tmp_path, duration_s=5, on_progress=heard.append)
    assert heard[0].phase == "waiting"
    assert heard[-1].phase == "running"
    assert heard[-1].task_time_s == pytest.approx(result.duration_s, abs=0.8)
    assert any(progress.waits_for for progress in heard)
    assert heard[-1].waits_for == ()
    assert {robot.mode for robot in heard[-1].robots.values()} == {"tracking"}
    assert {robot.mode for robot in heard[0].robots.values()} != {"tracking"}


def test_ctrl_c_finishes_the_recording(tmp_path: Path) -> None:
    scene = write(tmp_path, SMALL.replace("end = [1.5, 0]", "end = [9e3, 0]"))
    log = tmp_path / "a.mcap"
    with start("run", scene, "--virtual", "--json", "--log", log) as process:
        eventually(lambda: log.exists() and log.stat().st_size > 300_000)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 130, err
    found = json.loads(out)
    assert found["interrupted"] is True
    assert found["completed"] is False
    assert "Traceback" not in err
    assert read(log).complete
    assert (speeds(truths(log)[-1]) < 1e-3).all()
    assert span_s(log) > 1.0


def test_a_full_disk_is_one_message_and_what_was_recorded_stays(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    limit = 400_000
    process = start(
        "run",
        write(tmp_path),
        "--virtual",
        "--log",
        log,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    with process:
        _, err = process.communicate(timeout=60)
    assert process.returncode in (1, 2)
    assert "error: can't write" in err
    assert "Traceback" not in err
    assert not read(log).complete
    assert span_s(log) > 1.0
