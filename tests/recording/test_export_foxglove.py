import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from maniple.core.errors import ArgumentError, ManipleError, RecordingError
from maniple.core.time import SECOND
from maniple.recording.export_foxglove import METADATA_NAME, export_foxglove
from maniple.recording.reader import read
from maniple.recording.selection import Selection
from maniple.recording.viz import Viewer
from tests.recording.traffic import record
from tests.recording.viz.pictures import drawn, recorded, run

DECODERS: list[Any] = [DecoderFactory()]


def test_it_holds_what_a_viewer_draws(tmp_path: Path) -> None:
    recording = read(recorded())
    exported = export_foxglove(recording, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [(c.topic, m.data, m.log_time, m.publish_time) for _, c, m in reader.iter_messages()]
        summary = reader.get_summary()
        (metadata,) = list(reader.iter_metadata())
        (attachment,) = list(reader.iter_attachments())
    assert sorted(found) == sorted((one.key, one.data, one.time_ns, one.time_ns) for one in drawn())
    assert summary is not None
    channels = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert channels.keys() == {one.key for one in Viewer(run().scenario).channels}
    assert all(schema.data for schema in channels.values())
    assert channels["/viz/tf"].name == "foxglove.FrameTransforms"
    assert metadata.name == METADATA_NAME
    assert metadata.metadata["scenario"] == "drawn"
    assert attachment.data == recording.scenario_json
    assert (exported.messages, exported.drawn) == (len(run().seen), len(drawn()))
    assert exported.complete
    assert not exported.unreadable


def test_an_independent_decoder_reads_every_message(tmp_path: Path) -> None:
    """By the schemas in the file alone, protobuf as well as JSON."""
    export_foxglove(read(recorded()), tmp_path / "a.mcap")
    kinds: Counter[str] = Counter()
    with (tmp_path / "a.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            decode = DECODERS[0].decoder_for(channel.message_encoding, schema)
            if channel.message_encoding == "protobuf":
                decoded = decode(message.data)
                assert decoded.DESCRIPTOR.full_name == schema.name
                assert decoded.SerializeToString(deterministic=True) == message.data
            else:
                assert schema.encoding == "jsonschema"
                _check(message.data, schema.data)
            kinds[schema.name] += 1
    assert kinds.keys() == {
        "foxglove.FrameTransforms",
        "foxglove.LaserScan",
        "foxglove.Log",
        "foxglove.PointCloud",
        "foxglove.PosesInFrame",
        "foxglove.SceneUpdate",
        "maniple.FormationScalars",
        "maniple.RobotScalars",
        "maniple.TriangleScalars",
    }


def _check(data: bytes, schema: bytes) -> None:
    """A flat JSON object against its schema."""
    value, wanted = json.loads(data), json.loads(schema)
    assert wanted["type"] == "object"
    assert set(wanted["required"]) <= value.keys() <= wanted["properties"].keys()
    types: dict[str, Any] = {"number": (int, float), "integer": int, "string": str}
    for name, field in value.items():
        assert isinstance(field, types[wanted["properties"][name]["type"]])


def test_the_same_recording_makes_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        export_foxglove(read(recorded()), tmp_path / f"{name}.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_recording_that_is_drawn_already_makes_the_same_bytes(tmp_path: Path) -> None:
    for viz in (False, True):
        export_foxglove(read(recorded(viz)), tmp_path / f"{viz}.mcap")
    assert (tmp_path / "True.mcap").read_bytes() == (tmp_path / "False.mcap").read_bytes()


def test_every_channel_of_a_recording_has_a_schema() -> None:
    with recorded(viz=True).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    names = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert {"/viz/tf", "maniple/sim/truth"} <= names.keys()
    assert all(schema.name and schema.data for schema in names.values())


def test_a_part_knows_what_was_before(tmp_path: Path) -> None:
    recording = read(recorded())
    start = recording.start_ns + 4 * SECOND
    export_foxglove(recording, tmp_path / "a.mcap", Selection(start_ns=start, end_ns=start + 2 * SECOND))
    with (tmp_path / "a.mcap").open("rb") as file:
        found = [(c.topic, m) for _, c, m in make_reader(file).iter_messages()]
    times = [message.log_time for _, message in found]
    assert start <= min(times) < start + SECOND // 10
    assert start + 1.9 * SECOND < max(times) < start + 2 * SECOND
    first: dict[str, int] = {}
    for topic, message in found:
        first.setdefault(topic, message.log_time)
    once = ("/viz/tf", "/viz/robots", "/viz/obstacles", "/viz/trajectory/r1", "/viz/trajectory/r2")
    assert all(first[topic] < start + SECOND // 10 for topic in once)
    whole = {one.key: one.data for one in drawn() if one.time_ns < start}
    trail = next(message.data for topic, message in found if topic == "/viz/trajectory/r1")
    assert len(trail) >= len(whole["/viz/trajectory/r1"])


def test_topics_that_are_not_taken_are_not_drawn(tmp_path: Path) -> None:
    export_foxglove(read(recorded()), tmp_path / "a.mcap", Selection(without=("robot/*/ranges", "sim/truth")))
    with (tmp_path / "a.mcap").open("rb") as file:
        found = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert not [topic for topic in found if topic.startswith(("/viz/scan", "/viz/points"))]
    assert "/viz/tf" in found


def test_nothing_is_overwritten_unless_asked(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    export_foxglove(read(recorded()), out)
    made = out.read_bytes()
    out.write_bytes(made[:-1])
    with pytest.raises(ArgumentError, match="--force"):
        export_foxglove(read(recorded()), out)
    with pytest.raises(ArgumentError, match="is a folder"):
        export_foxglove(read(recorded()), tmp_path, force=True)
    assert out.read_bytes() == made[:-1]
    export_foxglove(read(recorded()), out, force=True)
    assert out.read_bytes() == made
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    out, other = tmp_path / "a.mcap", tmp_path / "notes.mcap"
    out.write_bytes(recorded().read_bytes())
    other.write_text("mine")
    for path in (out, other):
        before = path.read_bytes()
        with pytest.raises(ArgumentError, match="no earlier export to Foxglove"):
            export_foxglove(read(out), path, force=True)
        assert path.read_bytes() == before


def test_a_file_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ManipleError, match="can't write"):
        export_foxglove(read(recorded()), tmp_path / "file" / "a.mcap")


def test_a_scenario_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    log = record(tmp_path / "a.mcap", [])
    with pytest.raises(RecordingError, match="scenario can't be read"):
        export_foxglove(read(log), tmp_path / "b.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_damaged_recording_leaves_nothing(tmp_path: Path) -> None:
    data = bytearray(recorded().read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(RecordingError, match="recover"):
        export_foxglove(read(tmp_path / "a.mcap"), tmp_path / "b.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
