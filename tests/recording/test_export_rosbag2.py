from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from maniple.core.errors import ArgumentError
from maniple.core.time import SECOND
from maniple.recording.export_rosbag2 import SCENARIO, export_rosbag2
from maniple.recording.reader import read
from maniple.recording.selection import Selection
from maniple.recording.viz.export import ExportedFile
from tests.recording.ros2.test_translation import TYPES, said
from tests.recording.viz.pictures import recorded, run


class Made(NamedTuple):
    """A bag of the whole run."""

    bag: Path
    exported: ExportedFile


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    bag = tmp_path_factory.mktemp("made") / "bag"
    return Made(bag, export_rosbag2(read(recorded()), bag))


def test_a_bag_holds_what_is_said_to_ros2(made: Made) -> None:
    """Read back by rosbags."""
    bag, exported = made
    with AnyReader([bag]) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        found = sorted((c.topic, time, bytes(data)) for c, time, data in reader.messages())
    expected = [
        (one.topic.name, one.time, bytes(TYPES.serialize_cdr(one.message, one.topic.type))) for one in said()
    ]
    assert found == sorted(expected)
    assert types == {one.topic.name: one.topic.type for one in said()}
    assert (exported.messages, exported.drawn) == (len(run().seen), len(said()))
    assert exported.complete
    assert (bag / SCENARIO).read_bytes() == read(recorded()).scenario_json
    assert {file.name for file in bag.iterdir()} == {"bag.mcap", "metadata.yaml", SCENARIO}


def test_another_reader_reads_it_by_its_schemas_alone(made: Made) -> None:
    counts: Counter[str] = Counter()
    decoders: list[Any] = [DecoderFactory()]
    with (made.bag / "bag.mcap").open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=decoders).iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "/maniple/r1/odom":
                assert message.child_frame_id == "r1/base_link"
    assert counts == Counter(one.topic.name for one in said())


def test_what_is_latched_is_so_when_the_bag_is_played(made: Made) -> None:
    with AnyReader([made.bag]) as reader:
        latched = {
            connection.topic
            for connection in reader.connections
            for qos in getattr(connection.ext, "offered_qos_profiles", ())
            if qos.durability is QosDurability.TRANSIENT_LOCAL
        }
    assert latched == {"/tf_static", "/rosout", "/maniple/formation/path"}


def test_the_same_recording_makes_the_same_bytes(tmp_path: Path, made: Made) -> None:
    export_rosbag2(read(recorded()), tmp_path / "bag")
    for file in ("bag.mcap", "metadata.yaml"):
        assert (tmp_path / "bag" / file).read_bytes() == (made.bag / file).read_bytes()


def test_a_selection_knows_what_was_before(tmp_path: Path) -> None:
    recording = read(recorded())
    start = recording.start_ns + 3 * SECOND
    export_rosbag2(recording, tmp_path / "bag", Selection(start_ns=start, end_ns=start + SECOND))
    with AnyReader([tmp_path / "bag"]) as reader:
        assert reader.start_time >= start
        assert reader.end_time <= start + SECOND
        assert {"/tf_static", "/maniple/formation/path"} <= {one.topic for one in reader.connections}


def test_only_an_earlier_bag_is_replaced(tmp_path: Path) -> None:
    out, short = tmp_path / "bag", Selection(end_ns=read(recorded()).start_ns + SECOND)
    export_rosbag2(read(recorded()), out, short)
    with pytest.raises(ArgumentError, match="--force"):
        export_rosbag2(read(recorded()), out, short)
    export_rosbag2(read(recorded()), out, short, force=True)
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    with pytest.raises(ArgumentError, match="holds no export"):
        export_rosbag2(read(recorded()), other, force=True)
    assert [file.name for file in other.iterdir()] == ["mine.txt"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bag", "other"]
