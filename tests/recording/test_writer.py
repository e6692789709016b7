import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import SeekingReader

from maniple.core import messages, topics
from maniple.core.errors import RecordingError
from maniple.core.time import MILLISECOND
from maniple.recording.reader import read
from maniple.recording.writer import CHUNK_PERIOD, schema_of
from tests.recording.traffic import METADATA, SCENARIO, Sent, drive, record, traffic, writer_to


def test_round_trip(tmp_path: Path) -> None:
    sent = traffic()
    recording = read(record(tmp_path / "a.mcap", sent))
    assert list(recording.messages()) == sent
    assert recording.complete
    assert recording.scenario_json == SCENARIO
    assert recording.metadata == {**METADATA, "prefix": "maniple"}


def test_same_calls_same_bytes(tmp_path: Path) -> None:
    """Also in another process, where the hashes of strings differ."""
    here = record(tmp_path / "a.mcap", traffic())
    program = (
        "import sys; from pathlib import Path; from tests.recording.traffic import record, traffic;"
        "record(Path(sys.argv[1]), traffic())"
    )
    there = tmp_path / "another name.mcap"
    subprocess.run(
        [sys.executable, "-c", program, str(there)], check=True, env={**os.environ, "PYTHONHASHSEED": "99"}
    )
    assert here.read_bytes() == there.read_bytes()


def test_says_nothing_of_the_path(tmp_path: Path) -> None:
    assert os.fsencode(tmp_path.name) not in record(tmp_path / "a.mcap", traffic(), "none").read_bytes()


def test_existing_file_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(RecordingError, match="exists already"):
        writer_to(path)
    assert path.read_text() == "precious"


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file or directory"):
        writer_to(tmp_path / "none" / "a.mcap")


def test_scenario_is_on_disk_before_any_message(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = writer_to(path)
    recording = read(path)
    assert recording.scenario_json == SCENARIO
    assert not recording.complete
    assert list(recording.messages()) == []
    writer.close()
    assert read(path).complete


def test_tick_bounds_what_a_kill_loses(tmp_path: Path) -> None:
    """With a tick every 100 ms no message stays in memory longer than 0.5 s."""
    path = tmp_path / "a.mcap"
    start = 5_000_000_000
    with writer_to(path) as writer:
        for step in range(40):
            now = start + step * 100 * MILLISECOND
            writer.tick(now)
            on_disk = [record.log_time_ns for record in read(path).messages()]
            assert [
                t for t in range(start, now - 500 * MILLISECOND, 100 * MILLISECOND) if t not in on_disk
            ] == []
            writer.write("hw/r1/drive", drive(step), now, now, step)
    assert CHUNK_PERIOD < 500 * MILLISECOND


def test_large_chunks_are_closed_without_a_tick(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with writer_to(path) as writer:
        for step in range(6):
            writer.write("hw/r1/drive", bytes(1 << 20), step, step, step)
        assert len(list(read(path).messages())) >= 4


def test_schemas_of_all_types_in_the_order_of_the_table(tmp_path: Path) -> None:
    with record(tmp_path / "a.mcap", traffic(1)).open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    names = [f"maniple.{kind.__name__}" for kind in dict.fromkeys(row.type for row in topics.TOPICS)]
    assert [summary.schemas[id].name for id in sorted(summary.schemas)] == names
    assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
    for channel in summary.channels.values():
        kind = topics.topic(channel.topic.removeprefix("maniple/")).type.__name__
        assert channel.message_encoding == "msgpack"
        assert summary.schemas[channel.schema_id].name == f"maniple.{kind}"
        assert channel.metadata == {"encoding": f"application/msgpack;maniple.{kind}@1"}


def test_schema_tells_dtype_and_shape() -> None:
    schema = json.loads(schema_of(messages.Truth))
    assert schema["type"] == "object"
    assert schema["properties"]["poses"]["description"].startswith("float32 little-endian, shape (robots, 3)")


@pytest.mark.parametrize("kind", dict.fromkeys(row.type for row in topics.TOPICS))
def test_schema_has_all_fields_and_no_dangling_reference(kind: type[messages.Message]) -> None:
    schema = json.loads(schema_of(kind))
    assert tuple(schema["properties"]) == kind.__struct_fields__
    for reference in _references(schema):
        assert reference.removeprefix("#/$defs/") in schema["$defs"]


def test_numbers_that_do_not_fit_are_clipped(tmp_path: Path) -> None:
    """A foreign sender may stamp anything; the recorder goes on."""
    path = record(
        tmp_path / "a.mcap",
        [Sent("hw/r1/drive", b"x", -1, -5, -1), Sent("hw/r1/drive", b"y", 2**70, 2**64, 2**32 + 3)],
    )
    first, last = read(path).messages()
    assert first[2:] == (0, 0, 2**32 - 1)
    assert last[2:] == (2**64 - 1, 2**64 - 1, 3)


def test_unknown_topic_is_recorded_without_a_schema(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", [Sent("else/where", b"\x01", 1, 1, 0)])
    [found] = read(path).messages()
    assert (found.topic, found.data, found.message) == ("else/where", b"\x01", None)


@pytest.mark.slow
def test_too_many_topics(tmp_path: Path) -> None:
    with writer_to(tmp_path / "a.mcap") as writer:
        for number in range(65535):
            writer.write(f"t/{number}", b"", 0, 0, 0)
        with pytest.raises(RecordingError, match="65535 topics"):
            writer.write("t/more", b"", 0, 0, 0)


def test_closed_writer(tmp_path: Path) -> None:
    writer = writer_to(tmp_path / "a.mcap")
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match="is closed"):
        writer.write("hw/r1/drive", b"", 0, 0, 0)
    with pytest.raises(RecordingError, match="is closed"):
        writer.flush()


def test_file_is_finished_when_its_block_ends_in_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def interrupted() -> None:
        with writer_to(path) as writer:
            writer.write("hw/r1/drive", drive(0), 1, 1, 0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    recording = read(path)
    assert recording.complete
    assert len(list(recording.messages())) == 1


def test_full_disk(tmp_path: Path) -> None:
    """One clear message, and everything flushed before can be read. A file size limit stands for the disk."""
    path = tmp_path / "a.mcap"
    sent = traffic(400)
    writer = writer_to(path, "none")

    def fill() -> None:
        for message in sent:
            writer.write(*message)
            writer.tick(message.log_time_ns)

    with (
        file_size_limit(40_000),
        pytest.raises(RecordingError, match=r"can't write .*a.mcap: File too large"),
    ):
        fill()
    with pytest.raises(RecordingError, match="File too large"):
        writer.write(*sent[0])
    writer.close()
    recording = read(path)
    found = list(recording.messages())
    assert not recording.complete
    assert found == sent[: len(found)]
    assert 30_000 < path.stat().st_size <= 40_000


def test_full_disk_at_the_end(tmp_path: Path) -> None:
    """The summary does not fit: the messages are there all the same."""
    path = tmp_path / "a.mcap"
    sent = traffic(4)
    writer = writer_to(path, "none")
    for message in sent:
        writer.write(*message)
    writer.flush()
    with file_size_limit(path.stat().st_size + 100), pytest.raises(RecordingError, match="File too large"):
        writer.close()
    assert list(read(path).messages()) == sent


def test_full_disk_at_the_start_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with file_size_limit(100), pytest.raises(RecordingError, match="File too large"):
        writer_to(path)
    assert not path.exists()


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Within it no file of this process grows beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def _references(schema: Any) -> Iterator[str]:
    if isinstance(schema, dict):
        if "$ref" in schema:
            yield schema["$ref"]
        for value in schema.values():
            yield from _references(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from _references(value)


def test_wire_bytes_are_what_the_schema_describes(tmp_path: Path) -> None:
    """Every property of the schema is a key of the map on the wire."""
    schema = json.loads(schema_of(messages.Drive))
    assert msgspec.msgpack.decode(drive(0)).keys() == schema["properties"].keys()
