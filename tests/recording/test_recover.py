import json
import random
from pathlib import Path

import pytest
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader

from maniple.core.errors import ArgumentError, RecordingError
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Formation, Line, Robot, Scenario
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.recording.recover import recover
from maniple.recording.scan import scan
from maniple.recording.writer import RecordingWriter
from tests.recording.traffic import METADATA, SCENARIO, Sent, record, traffic


def is_sound(path: Path) -> int:
    """Messages by MCAP's own readers, with every checksum, from the front and by the index."""
    with path.open("rb") as file:
        streamed = [type(found).__name__ for found in StreamReader(file, validate_crcs=True).records]
    with path.open("rb") as file:
        indexed = sum(1 for _ in SeekingReader(file, validate_crcs=True).iter_messages())
    assert streamed.count("Message") == indexed
    return indexed


@pytest.mark.parametrize("size", [-1, -30, -2000, 0.9, 0.5])
def test_of_a_file_that_is_cut_off_everything_whole_is_saved(tmp_path: Path, size: float) -> None:
    path = record(tmp_path / "a.mcap", traffic(60))
    content = path.read_bytes()
    path.write_bytes(content[: int(size * len(content)) if size > 0 else int(size)])
    before = path.read_bytes()
    there = list(read(path).messages())
    found = recover(path)
    out = tmp_path / "a-recovered.mcap"
    assert (found.out, found.complete, found.lost_chunks) == (str(out), False, 0)
    recording = read(out)
    assert recording.complete
    assert list(recording.messages()) == there
    assert recording.scenario_json == SCENARIO
    assert recording.metadata["mode"] == "virtual"
    assert is_sound(out) == found.messages == len(there)
    assert path.read_bytes() == before


def test_damaged_chunks_are_skipped_and_what_they_held_is_named(tmp_path: Path) -> None:
    sent = traffic(60)
    path = record(tmp_path / "a.mcap", sent)
    layout = scan(path)
    content = bytearray(path.read_bytes())
    for number in (1, 3):
        place = layout.chunks[number]
        content[place.offset + place.length - 20] ^= 4
    path.write_bytes(content)
    found = recover(path, tmp_path / "b.mcap")
    assert (found.lost_chunks, len(found.lost)) == (2, 2)
    assert found.lost_bytes == sum(layout.chunks[number].length for number in (1, 3))
    got = list(read(tmp_path / "b.mcap").messages())
    assert found.missing == len(sent) - len(got) > 0
    assert {stream.topic for stream in found.streams} == {entry.topic for entry in sent}
    info = describe(read(tmp_path / "b.mcap"))
    assert (info.missing, info.damage) == (found.missing, ())
    notes = read(tmp_path / "b.mcap").all_metadata[0]
    assert notes["maniple.recovered"]["lost_chunks"] == "2"
    assert json.loads(notes["maniple.recovered"]["lost"]) == list(found.lost)
    assert notes["maniple.gaps"]["missing"] == str(found.missing)
    is_sound(tmp_path / "b.mcap")


def test_times_that_were_changed_on_a_chunk_are_made_anew(tmp_path: Path) -> None:
    sent = traffic(60)
    path = record(tmp_path / "a.mcap", sent)
    place = scan(path).chunks[1]
    content = bytearray(path.read_bytes())
    content[place.offset + 6] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f"maniple log recover {path}"):
        list(read(path).messages())
    recover(path)
    assert list(read(tmp_path / "a-recovered.mcap").messages()) == sent


def test_viewer_channels_and_attachments_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, SCENARIO, METADATA, prefix="maniple") as writer:
        writer.add_viewer_channel("/viz/x", "json", "x", "jsonschema", b'{"type": "object"}')
        for message in traffic(3):
            writer.write(*message)
            writer.draw("/viz/x", b"{}", message.log_time_ns, message.log_time_ns)
    path.write_bytes(path.read_bytes()[:-1])
    found = recover(path)
    assert (found.messages, found.viewer_messages) == (12, 12)
    layout, was = scan(tmp_path / "a-recovered.mcap"), scan(path)
    assert {channel.topic for channel in layout.channels.values()} == {
        channel.topic for channel in was.channels.values()
    }
    [drawn] = [channel for channel in layout.channels.values() if channel.topic == "/viz/x"]
    assert layout.schemas[drawn.schema_id].data == b'{"type": "object"}'


def test_messages_of_a_lost_channel_are_counted(tmp_path: Path) -> None:
    sent = traffic(10)
    path = record(tmp_path / "a.mcap", sent)
    content = bytearray(path.read_bytes()[: scan(path).data_end - 13])
    content[content.index(b"maniple/hw/r1/drive") - 8] ^= 0xFF
    path.write_bytes(content)
    found = recover(path)
    assert found.lost_messages == 10
    assert "10 messages are of channel 1" in found.lost[-1]
    got = list(read(tmp_path / "a-recovered.mcap").messages())
    assert got == [entry for entry in sent if entry.topic != "hw/r1/drive"]


SCENE = Scenario(
    name="pair",
    robots=(Robot(id="r1", pose=(0.0, 1.0, 0.5)),),
    formation=Formation(points=((0.0, 0.0),)),
    task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
)


def test_a_lost_scenario_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent = traffic(10)
    with RecordingWriter(path, to_json(SCENE), METADATA, prefix="maniple") as writer:
        for message in sent:
            writer.write(*message)
    content = path.read_bytes().replace(b'"pair"', b'"pear"')
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"attachment .* does not match its checksum.*--scenario FILE"):
        read(path)
    with pytest.raises(RecordingError, match="lost its scenario; give it with --scenario"):
        recover(path)
    assert not (tmp_path / "a-recovered.mcap").exists()
    recover(path, scenario_json=to_json(SCENE))
    recording = read(tmp_path / "a-recovered.mcap")
    assert recording.scenario == SCENE
    assert list(recording.messages()) == sent
    with pytest.raises(ArgumentError, match="leave out --scenario"):
        recover(tmp_path / "a-recovered.mcap", tmp_path / "b.mcap", to_json(SCENE))


def test_what_the_recording_said_of_its_run_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, to_json(SCENE), METADATA, prefix="maniple") as writer:
        for message in traffic(3):
            writer.write(*message)
    content = bytearray(path.read_bytes())
    content[content.index(b"\x0c")] = 0
    path.write_bytes(content)
    recover(path)
    recording = read(tmp_path / "a-recovered.mcap")
    assert recording.metadata["scenario"] == "pair"
    assert len(list(recording.messages())) == 12


def test_what_can_not_be_saved(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for content in (b"[robots]\n", b"\x89MCAP0\r\n", random.Random(3).randbytes(5000)):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="nothing that could be saved"):
            recover(path)
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="is empty"):
        recover(path)
    record(tmp_path / "b.mcap", traffic(2))
    with pytest.raises(RecordingError, match="exists already"):
        recover(tmp_path / "b.mcap", path)
    with pytest.raises(RecordingError, match="can't create"):
        recover(tmp_path / "b.mcap", tmp_path / "none" / "c.mcap")


def test_a_whole_file_loses_nothing(tmp_path: Path) -> None:
    sent = [*traffic(20), Sent("else/where", b"?", 2**60, 1, 0)]
    found = recover(record(tmp_path / "a.mcap", sent), tmp_path / "b.mcap")
    assert (found.lost, found.lost_bytes, found.missing, found.complete) == ((), 0, 0, True)
    assert list(read(tmp_path / "b.mcap").messages()) == sent
