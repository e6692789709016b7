import sys
from pathlib import Path

import numpy as np
import pandas
import polars
import pyarrow.parquet as pq
import pytest

from maniple.core import messages
from maniple.core.errors import MissingExtraError
from maniple.recording.export_parquet import export_parquet
from maniple.recording.reader import Recording, read
from maniple.recording.table import table
from tests.recording.faulty import faulty_run
from tests.recording.traffic import record, traffic


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return faulty_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def folder(run: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tables") / "out"
    export_parquet(run, out)
    return out


def test_pandas_and_polars_read_the_values_of_the_messages(run: Recording, folder: Path) -> None:
    decoded = [(record, message) for record, message in run.decoded(messages.Odometry)]
    frame = pandas.read_parquet(folder / "robot-odometry.parquet")
    other = polars.read_parquet(folder / "robot-odometry.parquet")
    for name in ("x_m", "psi_rad", "u_mps", "seq", "stamp_ns", "frame_id", "source"):
        expected = [getattr(message, name) for _, message in decoded]
        assert frame[name].tolist() == expected
        assert other[name].to_list() == expected
    stamps = [message.applied and message.applied.stamp_ns for _, message in decoded]
    assert other["applied.stamp_ns"].to_list() == stamps
    assert None in stamps
    assert frame["robot"].tolist() == [record.topic.split("/")[1] for record, _ in decoded]
    assert [tuple(ticks) for ticks in frame["ticks"]] == [message.ticks for _, message in decoded]


def test_arrays_keep_their_shape(run: Recording, folder: Path) -> None:
    scans = [message for record, message in run.decoded(messages.Scan) if record.topic.startswith("hw/")]
    frame = pandas.read_parquet(folder / "hw-scan.parquet")
    other = polars.read_parquet(folder / "hw-scan.parquet")
    assert len(frame) == len(other) == len(scans) > 0
    for message, mine, others in zip(scans, frame["ranges"], other["ranges"], strict=True):
        assert mine.dtype == np.float32
        assert mine.tobytes() == others.to_numpy().tobytes() == message.ranges
    states = [message for _, message in run.decoded(messages.FormationState)]
    other = polars.read_parquet(folder / "formation-state.parquet")
    for state, errors in zip(states, other["errors"], strict=True):
        expected = messages.unpack_floats(state.errors, 6)
        assert np.array_equal(np.array(errors.to_list()).reshape(-1, 6), expected)


def test_every_table_is_that_of_the_recording(run: Recording, folder: Path) -> None:
    """Column for column, those of rows within messages too."""
    names = set()
    for path in folder.glob("*.parquet"):
        notes = pq.read_schema(path).metadata
        found = pq.read_table(path)
        expected = table(run, notes[b"maniple.topics"].decode(), notes[b"maniple.each"].decode())
        assert found.equals(expected.to_arrow())
        assert len(polars.read_parquet(path)) == expected.rows
        names.add(path.stem)
    assert {
        "sim-truth.robots",
        "formation-state.triangles",
        "journal.calls",
        "faults-decisions.decided",
    } <= names


def test_a_file_says_what_it_is(run: Recording, folder: Path) -> None:
    schema = pq.read_schema(folder / "sim-truth.parquet")
    assert schema.metadata[b"maniple.type"] == b"Truth"
    assert schema.metadata[b"maniple.scenario"] == run.scenario_json
    assert schema.field("poses").metadata == {b"columns": b"x_m, y_m, psi_rad"}
    assert schema.field("clearances").metadata[b"unit"] == b"m"
    assert schema.field("t_s").metadata == {b"unit": b"s"}


def test_rows_are_written_in_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniple.recording.table.BATCH_ROWS", 30)
    recording = read(record(tmp_path / "a.mcap", traffic(40)))
    export_parquet(recording, tmp_path / "out")
    file = pq.ParquetFile(tmp_path / "out" / "hw-drive.parquet")
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [30, 30, 20]
    assert file.read()["seq"].to_pylist() == [i // 2 for i in range(80)]


def test_the_same_recording_gives_the_same_bytes(run: Recording, folder: Path, tmp_path: Path) -> None:
    export_parquet(run, tmp_path / "again")
    for path in folder.glob("*.parquet"):
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_without_pyarrow(run: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'maniple\[export\]'"):
        export_parquet(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()
