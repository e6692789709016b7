import errno
import json
import tracemalloc
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from maniple.core.errors import ArgumentError, ManipleError, RecordingError
from maniple.core.time import MILLISECOND
from maniple.recording.columns import Cells, Form
from maniple.recording.export_csv import export_csv
from maniple.recording.export_tables import export_tables, told
from maniple.recording.reader import read
from maniple.recording.selection import Selection
from maniple.recording.writer import RecordingWriter, part
from tests.recording.traffic import METADATA, SCENARIO, Sent, drive, record, scan, traffic


def test_what_is_in_the_folder(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(40)))
    exported = export_csv(recording, tmp_path / "new" / "out")
    out = tmp_path / "new" / "out"
    assert exported.messages == 160
    assert [(table.file, table.topics, table.rows) for table in exported.tables] == [
        ("hw-drive.csv", "hw/*/drive", 80),
        ("hw-scan.csv", "hw/*/scan", 80),
    ]
    listed = json.loads((out / "tables.json").read_bytes())
    assert listed["recordings"] == [str(tmp_path / "a.mcap")]
    columns = {column["name"]: column for column in listed["tables"][1]["columns"]}
    assert columns["ranges"]["unit"] == "m"
    assert columns["beams"]["parts"] == ["x_m", "y_m", "direction_rad"]
    assert (out / "scenario.json").read_bytes() == recording.scenario_json
    assert "| hw-scan.csv | hw/*/scan | 80 |" in (out / "README.md").read_text()
    assert sorted(path.name for path in out.iterdir()) == [
        "README.md",
        "hw-drive.csv",
        "hw-scan.csv",
        "scenario.json",
        "tables.json",
    ]


def test_a_selection(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(40)))
    end = recording.start_ns + 500 * MILLISECOND
    exported = export_csv(recording, tmp_path / "out", Selection(None, end, ("hw/*/scan",)))
    assert [(table.file, table.rows) for table in exported.tables] == [("hw-scan.csv", 20)]
    assert not (tmp_path / "out" / "hw-drive.csv").exists()


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    sent = [*traffic(2), Sent("hw/r1/drive", b"?", 1, 1, 0), Sent("what/is/it", b"?", 1, 1, 0)]
    path = record(tmp_path / "a.mcap", sent)
    path.write_bytes(path.read_bytes()[:-9])
    exported = export_csv(read(path), tmp_path / "out")
    assert exported.unreadable == {"hw/r1/drive": 1}
    assert exported.unknown == {"what/is/it": 1}
    lines = [*told(exported.complete, exported.unreadable, exported.unknown)]
    assert [line.split(":")[0] for line in lines] == [
        "the recording was not finished",
        "hw/r1/drive",
        "what/is/it",
    ]
    assert all(line in (tmp_path / "out" / "README.md").read_text() for line in lines)


def test_all_parts_of_a_recording(tmp_path: Path) -> None:
    """And of both lives of a robot."""
    log = tmp_path / "a.mcap"
    sent = traffic(40)
    later = [
        message._replace(data=drive(0, incarnation=2))
        for message in sent[80:]
        if message.topic == "hw/r1/drive"
    ]
    for number, messages in ((1, sent[:80]), (2, later)):
        about = {**METADATA, "part": str(number)}
        with RecordingWriter(part(log, number), SCENARIO, about, prefix="maniple") as writer:
            for message in messages:
                writer.write(*message[:5])
    exported = export_csv(read(log), tmp_path / "out")
    assert exported.recordings == (str(log), str(part(log, 2)))
    assert exported.messages == 100
    lines = (tmp_path / "out" / "hw-drive.csv").read_text().splitlines()
    assert sum(line.split(",")[5] == "2" for line in lines) == 20


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(2)))
    out = tmp_path / "out"
    export_csv(recording, out)
    (out / "of-mine.txt").write_text("x")
    with pytest.raises(ArgumentError, match="holds an export; another --out, or --force"):
        export_csv(recording, out)
    export_csv(recording, out, force=True)
    assert not (out / "of-mine.txt").exists()
    other = tmp_path / "other"
    other.mkdir()
    export_csv(recording, other)
    for name, said in [("a.mcap", "is not a folder"), (".", "is not empty and holds no export")]:
        with pytest.raises(ArgumentError, match=said):
            export_csv(recording, tmp_path / name, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "other", "out"]


@pytest.mark.parametrize(
    ("raised", "seen", "said"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
        (OSError(errno.ENOSPC, "No space left on device"), ManipleError, "can't write the export: No space"),
    ],
)
def test_what_is_not_finished_leaves_no_trace(
    tmp_path: Path, raised: BaseException, seen: type[BaseException], said: str
) -> None:
    """The export that was there stays as it was."""
    recording = read(record(tmp_path / "a.mcap", traffic(2)))
    out = tmp_path / "out"
    export_csv(recording, out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    class Broken:
        def __init__(self, path: Path, form: Form, notes: Mapping[str, str]) -> None:
            path.write_text("half")

        def write(self, cells: Sequence[Cells]) -> None:
            raise raised

        def close(self) -> None:
            pass

    with pytest.raises(seen, match=said):
        export_tables(recording, out, Selection(), True, "csv", Broken)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "out"]


def test_a_damaged_recording_leaves_no_trace(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(40), "none")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="damaged"):
        export_csv(read(path), tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniple.recording.table.BATCH_ROWS", 50)
    ranges = bytes(4 * 400)
    peaks = []
    for count in (150, 600):
        sent = (Sent("hw/r1/scan", scan(i, ranges), i * MILLISECOND, i, i) for i in range(count))
        recording = read(record(tmp_path / f"{count}.mcap", sent))
        tracemalloc.start()
        export_csv(recording, tmp_path / f"out-{count}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
