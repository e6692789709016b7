import csv
import json
from base64 import b64decode
from pathlib import Path

import numpy as np
import pandas
import pytest

from maniple.core import codec, messages
from maniple.recording.export_csv import export_csv
from maniple.recording.reader import Recording, read
from maniple.recording.table import table
from tests.recording.faulty import faulty_run
from tests.recording.traffic import Sent, record


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return faulty_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def folder(run: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tables") / "out"
    export_csv(run, out)
    return out


def test_numbers_read_back_as_they_were(run: Recording, folder: Path) -> None:
    decoded = [message for _, message in run.decoded(messages.Odometry)]
    lines = _read(folder / "robot-odometry.csv")
    frame = pandas.read_csv(folder / "robot-odometry.csv")
    for name in ("x_m", "y_m", "psi_rad", "u_mps", "w_radps"):
        expected = [getattr(message, name) for message in decoded]
        assert [float(line[name]) for line in lines] == expected
        assert frame[name].tolist() == expected
    assert [int(line["stamp_ns"]) for line in lines] == [message.stamp_ns for message in decoded]
    assert [line["applied.seq"] for line in lines] == [
        str(message.applied.seq) if message.applied else "" for message in decoded
    ]
    assert [json.loads(line["ticks"]) for line in lines] == [list(message.ticks) for message in decoded]


def test_arrays_read_back_as_they_were(run: Recording, folder: Path) -> None:
    scans = [message for record, message in run.decoded(messages.Scan) if record.topic.startswith("hw/")]
    lines = _read(folder / "hw-scan.csv")
    for message, line in zip(scans, lines, strict=True):
        assert np.array(json.loads(line["ranges"]), dtype="<f4").tobytes() == message.ranges
    truths = [message for _, message in run.decoded(messages.Truth)]
    for truth, line in zip(truths, _read(folder / "sim-truth.csv"), strict=True):
        assert np.array(json.loads(line["poses"]), dtype="<f4").tobytes() == truth.poses
    rows = _read(folder / "sim-truth.robots.csv")
    poses = np.frombuffer(b"".join(truth.poses for truth in truths), dtype="<f4").reshape(-1, 3)
    assert np.array_equal(np.array([row["x_m"] for row in rows], dtype=np.float32), poses[:, 0])
    assert {row["v_mps"] for row in rows} == {""}


def test_bytes_and_booleans(run: Recording, folder: Path) -> None:
    calls = table(run, "journal/*", "calls")
    lines = _read(folder / "journal.calls.csv")
    assert [b64decode(line["data"]) or None for line in lines] == [data or None for data in calls["data"]]
    assert any(line["data"] for line in lines)
    frame = pandas.read_csv(folder / "hw-drive.csv")
    assert frame["active"].dtype == bool
    assert frame["active"].tolist() == table(run, "hw/*/drive")["active"].tolist()


def test_text_of_any_kind(tmp_path: Path) -> None:
    text = 'a "quoted", and\nbroken line; ünïcödé'
    data = codec.encode(messages.EmergencyStop(source="operator", incarnation=1, stopped=True, reason=text))
    export_csv(read(record(tmp_path / "a.mcap", [Sent("platoon/stop", data, 1, 1, 0)])), tmp_path / "out")
    [line] = _read(tmp_path / "out" / "platoon-stop.csv")
    assert line["reason"] == text
    assert line["stopped"] == "true"
    assert pandas.read_csv(tmp_path / "out" / "platoon-stop.csv")["reason"].tolist() == [text]


def test_every_table_has_its_rows(folder: Path) -> None:
    listed = json.loads((folder / "tables.json").read_bytes())["tables"]
    for entry in listed:
        with (folder / entry["file"]).open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        assert head == [column["name"] for column in entry["columns"]]
        assert len(rows) == entry["rows"]


def _read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
