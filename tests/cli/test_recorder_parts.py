"""What the recorder process is put together from: its files, their names and what they say of themselves."""

from pathlib import Path

import pytest

from maniple.cli.loading import completed
from maniple.cli.recorder_parts import drawing_of, require_free_name, writer_of
from maniple.cli.recording_options import EVERYTHING, RecordingOptions
from maniple.core.errors import RecordingError
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.recording.reader import read
from maniple.recording.rolling import RollingWriter
from tests.cli.scenes import platoon
from tests.recording.traffic import traffic

SCENARIO = completed(platoon(3))
CLOCK = Anchor(7 * SECOND, Anchor.here().monotonic_ns, 2.0)


def test_parts_know_their_run_and_number(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    options = RecordingOptions(split_s=1.0, without=("hw/*/scan",), compression="none")
    sent = traffic(100)
    writer = writer_of(SCENARIO, log, False, CLOCK, options, None)
    for message in sent:
        writer.write(*message)
    writer.close()
    recording = read(log)
    assert len(recording.paths) == 5
    assert list(recording.messages()) == sent
    for number, parts in enumerate(recording.all_metadata, 1):
        about = parts["maniple"]
        assert (about["anchor"], about["speed"], about["part"]) == (str(7 * SECOND), "2.0", str(number))
        assert about["without"] == "hw/*/scan"
    assert recording.scenario == SCENARIO


def test_a_recorder_that_is_started_again_goes_on_where_there_is_room(tmp_path: Path) -> None:
    """Also one that writes parts: none is in the way of another."""
    log = tmp_path / "a.mcap"
    sent = traffic(100)
    for half in (sent[:200], sent[200:]):
        writer = writer_of(SCENARIO, log, True, CLOCK, RecordingOptions(split_s=1.0), None)
        for message in half:
            writer.write(*message)
        writer.close()
    names = [path.name for path in read(log).paths]
    assert names == ["a.mcap", *(f"a-{number}.mcap" for number in range(2, len(names) + 1))]
    assert list(read(log).messages()) == sent


def test_a_file_that_is_there(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    require_free_name(log, next=False)
    log.touch()
    with pytest.raises(RecordingError, match="exists already"):
        require_free_name(log, next=False)
    require_free_name(log, next=True)
    with pytest.raises(RecordingError, match="is not a directory"):
        require_free_name(tmp_path / "none" / "a.mcap", next=True)
    with pytest.raises(RecordingError, match="exists already"):
        writer_of(SCENARIO, log, False, CLOCK, EVERYTHING, None)
    with pytest.raises(RecordingError, match="No such file"):
        writer_of(SCENARIO, tmp_path / "none" / "a.mcap", True, CLOCK, EVERYTHING, None)


def test_a_part_steps_over_a_file_of_somebody_else(tmp_path: Path) -> None:
    log, other = tmp_path / "a.mcap", tmp_path / "a-2.mcap"
    other.write_text("precious")
    writer = writer_of(SCENARIO, log, False, CLOCK, RecordingOptions(split_s=1.0), None)
    for message in traffic(40):
        writer.write(*message)
    writer.close()
    assert [path.name for path in writer.paths] == ["a.mcap", "a-3.mcap"]
    assert other.read_text() == "precious"


def test_kept_files_are_no_parts(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    (tmp_path / "a-kept-1.mcap").touch()
    writer = writer_of(SCENARIO, log, False, CLOCK, EVERYTHING, 10.0)
    assert isinstance(writer, RollingWriter)
    for message in traffic(3):
        writer.write(*message)
    for _ in range(2):
        writer.keep(0)
        writer.end()
    assert [path.name for path in writer.paths] == ["a-kept-2.mcap", "a-kept-3.mcap"]
    assert all(read(path).paths == (path,) for path in writer.paths)
    assert "part" not in read(writer.paths[0]).metadata


def test_viewer_channels_unless_they_are_left_out(tmp_path: Path) -> None:
    for name, options in (("a", EVERYTHING), ("b", RecordingOptions(viz=False))):
        writer = writer_of(SCENARIO, tmp_path / f"{name}.mcap", False, CLOCK, options, None)
        drawing = drawing_of(SCENARIO, writer, options)
        writer.close()
        assert (drawing is not None) == (name == "a")
        assert bool(read(tmp_path / f"{name}.mcap").viewer_keys) == (name == "a")
