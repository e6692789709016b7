"""`maniple log diff`."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from maniple.cli.log.group import app
from maniple.core.errors import ArgumentError, RecordingError
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter
from tests.report.recordings import filtered, recorded


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = [tmp_path_factory.mktemp(name) for name in "ab"]
    return recorded(folders[0]), recorded(folders[1], "controller.kappa=0.25000001")


def diff(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["diff", *map(str, arguments)])


def realtime(source: Path, target: Path, later_ns: int = 0) -> Path:
    """The same recording, as if by the wall clock."""
    recording = read(source)
    metadata = {**recording.metadata, "mode": "realtime"}
    metadata.pop("prefix")
    with RecordingWriter(target, recording.scenario_json, metadata, prefix=recording.prefix) as writer:
        for record in recording.messages():
            writer.write(*record._replace(log_time_ns=record.log_time_ns + later_ns))
    return target


def test_a_run_is_the_same_as_itself(runs: tuple[Path, Path]) -> None:
    result = diff(runs[0], runs[0])
    assert result.exit_code == 0
    assert f"the same: {sum(1 for _ in read(runs[0]).messages())} messages identical" in result.stdout
    assert "outcome" not in result.stdout


def test_a_gain_that_is_a_little_different_is_found(runs: tuple[Path, Path]) -> None:
    result = diff(*runs)
    assert result.exit_code == 1
    assert "controller.kappa      0.25  0.25000001" in result.stdout
    assert "robot/*/command:values is beyond 0" in result.stdout
    assert "they differ on" in result.stdout


def test_tolerances_by_option_and_file(runs: tuple[Path, Path], tmp_path: Path) -> None:
    loose = ["--ignore", "journal/**", "--tolerance", "0.01", "--tolerance", "**:ticks=20"]
    assert diff(*runs, *loose).exit_code == 0
    file = tmp_path / "t.toml"
    file.write_text('default = 0.01\nignore = ["journal/**", "other/*"]\n[tolerances]\n"**:ticks" = 20\n')
    assert diff(*runs, "--tolerances", file).exit_code == 0
    assert "within the tolerances" in diff(*runs, "--tolerances", file).stdout
    strict = diff(*runs, "--tolerances", file, "--tolerance", "robot/*/command:values=0")
    assert strict.exit_code == 1
    assert "they differ on 4 of" in strict.stdout


def test_as_json(runs: tuple[Path, Path]) -> None:
    found = json.loads(diff(*runs, "--json").stdout)
    assert (found["by"], found["same"]) == ("message", False)
    assert found["scenario"][0]["field"] == "controller.kappa"
    by_topic = {topic["topic"]: topic for topic in found["messages"]}
    values = next(field for field in by_topic["robot/r1/command"]["fields"] if field["field"] == "values")
    assert 0 < values["largest"]["difference"] < 0.01
    assert any(row["name"] == "robot/r1/pose" and row["largest"] > 0 for row in found["series"])


def test_only_some_topics_and_times(runs: tuple[Path, Path]) -> None:
    result = diff(*runs, "--topic", "robot/*/command", "--until", "2", "--json")
    found = json.loads(result.stdout)["messages"]
    assert [topic["topic"] for topic in found] == [f"robot/r{i}/command" for i in range(1, 5)]
    assert all(topic["a"] == topic["b"] <= 20 for topic in found)


def test_missing_messages_are_told(runs: tuple[Path, Path], tmp_path: Path) -> None:
    short = filtered(
        runs[0], tmp_path / "s.mcap", lambda r: not (r.topic == "robot/r2/command" and r.sequence in (7, 9))
    )
    result = diff(runs[0], short)
    assert result.exit_code == 1
    assert "robot/*/command only in A, the first: robot/r2/command of controller, seq 7" in result.stdout
    assert "they differ on 1 of" in result.stdout


def test_realtime_runs_are_compared_by_time(runs: tuple[Path, Path], tmp_path: Path) -> None:
    other = realtime(runs[1], tmp_path / "r.mcap", later_ns=3_600_000_000_000)
    result = diff(runs[0], other, "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout)
    assert found["by"] == "time"
    assert found["messages"] == []
    assert {"field": "mode", "a": "virtual", "b": "realtime"} in found["made"]
    assert diff(runs[0], other, "--tolerance", "0.01").exit_code == 0
    told = diff(runs[0], other, "--tolerance", "0.01", "--tolerance", "robot/r3/pose:x_m=1e-12").stdout
    assert "they differ in 1 of" in told


@pytest.mark.slow
def test_pictures(runs: tuple[Path, Path], tmp_path: Path) -> None:
    result = diff(*runs, "--plot", tmp_path / "p", "--json")
    pictures = json.loads(result.stdout)["pictures"]
    assert len(pictures) == 8
    assert all(Path(picture).stat().st_size > 1000 for picture in pictures)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--tolerance", "x"], "must be a number"),
        (["--tolerance", "nothing/*:x=1"], "there is .*formation/state"),
        (["--ignore", "robot/r1/pose"], "there is .*robot/r1/command"),
        (["--topic", "nothing"], "no topic of"),
        (["--by", "time", "--topic", "sim/truth"], "--topic chooses messages"),
        (["--by", "time", "--until", "3"], "--until chooses messages"),
        (["--by", "time", "--ignore", "sim/truth"], "there is .*outcome, robot/r1/clearance"),
        (["--tolerances", "none.toml"], "none.toml: can't be read"),
        (["--plot", __file__], "not a folder"),
    ],
)
def test_bad_input_is_one_message(runs: tuple[Path, Path], arguments: list[str], told: str) -> None:
    result = diff(*runs, *arguments)
    assert isinstance(result.exception, ArgumentError)
    assert re.search(told, str(result.exception))
    assert result.stdout == ""


def test_files_that_are_no_recordings(runs: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no")
    for pair in ((runs[0], tmp_path / "x.mcap"), (tmp_path / "none.mcap", runs[0])):
        result = diff(*pair)
        assert isinstance(result.exception, RecordingError)
    assert diff(runs[0]).exit_code == 2


def test_nothing_is_not_the_same_as_nothing(tmp_path: Path, runs: tuple[Path, Path]) -> None:
    recording = read(runs[0])
    empty = tmp_path / "empty.mcap"
    with RecordingWriter(empty, recording.scenario_json, dict(recording.metadata), prefix="maniple"):
        pass
    result = diff(empty, empty)
    assert isinstance(result.exception, ArgumentError)
    assert "there is nothing to compare" in str(result.exception)
    assert diff(runs[0], empty).exit_code == 1
