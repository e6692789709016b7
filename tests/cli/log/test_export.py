import csv
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.log.group import app
from maniple.core.errors import ArgumentError, MissingExtraError, RecordingError
from tests.recording.faulty import faulty_run
from tests.recording.traffic import Sent, record, traffic
from tests.waiting import eventually


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_export_as_json(tmp_path: Path, format: str) -> None:
    path = record(tmp_path / "a.mcap", traffic(40))
    result = CliRunner().invoke(app, ["export", str(path), "--to", format, "--json"])
    assert result.exit_code == 0
    said = json.loads(result.stdout)
    assert said["out"] == str(tmp_path / f"a-{format}")
    assert [table["file"] for table in said["tables"]] == [f"hw-drive.{format}", f"hw-scan.{format}"]
    assert (tmp_path / f"a-{format}" / f"hw-scan.{format}").exists()


@pytest.mark.parametrize(("format", "ending"), [("foxglove", "-foxglove.mcap"), ("rerun", ".rrd")])
def test_files_for_viewers(tmp_path: Path, format: str, ending: str) -> None:
    path = faulty_run(tmp_path).path
    result = CliRunner().invoke(app, ["export", str(path), "--to", format, "--topic", "sim/*", "--json"])
    assert result.exit_code == 0
    said = json.loads(result.stdout)
    assert said["out"] == str(tmp_path / f"run{ending}")
    assert said["messages"] > 0
    assert (tmp_path / f"run{ending}").stat().st_size > 0
    again = CliRunner().invoke(app, ["export", str(path), "--to", format])
    assert isinstance(again.exception, ArgumentError)
    result = CliRunner().invoke(app, ["export", str(path), "--to", format, "--force"])
    assert f"for viewers: {tmp_path / f'run{ending}'}" in result.stdout


def test_a_bag(tmp_path: Path) -> None:
    path = faulty_run(tmp_path).path
    result = CliRunner().invoke(app, ["export", str(path), "--to", "rosbag2", "--topic", "sim/*"])
    assert result.exit_code == 0
    assert f"of ROS 2: {tmp_path / 'run-rosbag2'}" in result.stdout
    assert (tmp_path / "run-rosbag2" / "metadata.yaml").exists()


def test_export_for_people(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", [*traffic(40), Sent("hw/r1/drive", b"?", 1, 1, 1)])
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["export", str(path), "--to", "csv", "--out", str(out)])
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "note: hw/r1/drive: 1 left out, no valid messages of this topic",
        f"161 messages as 160 rows in 2 tables: {out}",
    ]


def test_only_some_of_it(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(40))
    options = ["--topic", "hw/*/drive", "--without", "hw/r2/*", "--from", "0.5", "--until", "1", "--json"]
    result = CliRunner().invoke(app, ["export", str(path), "--to", "csv", *options])
    assert [(table["file"], table["rows"]) for table in json.loads(result.stdout)["tables"]] == [
        ("hw-drive.csv", 10)
    ]
    with (tmp_path / "a-csv" / "hw-drive.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["t_s"]) for row in rows] == pytest.approx([0.5 + 0.05 * k for k in range(10)])


@pytest.mark.parametrize(
    ("options", "kind", "said"),
    [
        (["--to", "csv", "--out", "{folder}"], ArgumentError, "is not empty and holds no export"),
        (["--to", "csv", "--topic", "hw/*/x"], ArgumentError, "no topic of .* matches 'hw/\\*/x'"),
        (["--to", "csv", "--from", "100"], ArgumentError, "ends after"),
        (["--to", "csv", "--out", "/proc/nothing/out"], Exception, "/proc/nothing"),
    ],
)
def test_bad_options_are_one_error_for_main(
    tmp_path: Path, options: list[str], kind: type[Exception], said: str
) -> None:
    path = record(tmp_path / "a.mcap", traffic(4))
    given = [option.format(folder=tmp_path) for option in options]
    result = CliRunner().invoke(app, ["export", str(path), *given])
    assert isinstance(result.exception, kind)
    with pytest.raises(kind, match=said):
        raise result.exception
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


def test_a_format_is_needed_and_listed(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(4))
    assert CliRunner().invoke(app, ["export", str(path)]).exit_code == 2
    assert CliRunner().invoke(app, ["export", str(path), "--to", "xls"]).exit_code == 2


def test_no_recording(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["export", str(tmp_path / "no.mcap"), "--to", "csv"])
    assert isinstance(result.exception, RecordingError)


@pytest.mark.parametrize(
    ("format", "module", "extra"), [("parquet", "pyarrow", "export"), ("rerun", "rerun", "rerun")]
)
def test_the_missing_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str, module: str, extra: str
) -> None:
    path = record(tmp_path / "a.mcap", traffic(4))
    monkeypatch.setitem(sys.modules, module, None)
    result = CliRunner().invoke(app, ["export", str(path), "--to", format])
    assert isinstance(result.exception, MissingExtraError)
    assert f"pip install 'maniple[{extra}]'" in str(result.exception)
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_export_leaves_no_trace(tmp_path: Path, number: signal.Signals) -> None:
    path = record(tmp_path / "a.mcap", traffic(20_000), "none")
    command = [sys.executable, "-m", "maniple", "log", "export", str(path), "--to", "csv"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as export:
        eventually(lambda: len(list(tmp_path.iterdir())) > 1)
        export.send_signal(number)
        _, said = export.communicate(timeout=60)
    assert export.returncode == 130
    assert said == ""
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]
