import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.log.group import app
from maniple.core.errors import RecordingError
from maniple.core.scenario.parse import to_json
from maniple.recording.reader import read
from maniple.recording.scan import scan
from maniple.recording.writer import RecordingWriter
from tests.cli.scenes import write
from tests.recording.traffic import METADATA, record, traffic


def test_what_was_saved_and_lost_is_told(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(60))
    place = scan(path).chunks[2]
    content = bytearray(path.read_bytes()[:-10])
    content[place.offset + place.length - 20] ^= 4
    path.write_bytes(content)
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert result.exit_code == 0
    assert f"lost: the chunk at byte {place.offset} is damaged" in result.stdout
    assert "no whole record" in result.stdout
    assert "missing: hw/r1/drive: r1 (incarnation 1): seq " in result.stdout
    assert f"recording: {tmp_path / 'a-recovered.mcap'}" in result.stdout
    again = CliRunner().invoke(app, ["recover", str(path)])
    assert isinstance(again.exception, RecordingError)
    assert "exists already" in str(again.exception)


def test_nothing_lost_as_text_and_json(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(4))
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert "nothing is lost" in result.stdout
    result = CliRunner().invoke(app, ["recover", str(path), "--out", str(tmp_path / "b.mcap"), "--json"])
    found = json.loads(result.stdout)
    assert (found["messages"], found["lost"], found["out"]) == (16, [], str(tmp_path / "b.mcap"))


def test_a_scenario_for_a_file_that_lost_its_own(tmp_path: Path) -> None:
    from maniple.cli.loading import load

    scene = write(tmp_path)
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, to_json(load(scene)), METADATA, prefix="maniple") as writer:
        for message in traffic(4):
            writer.write(*message)
    path.write_bytes(path.read_bytes().replace(b'"small"', b'"smoll"'))
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert isinstance(result.exception, RecordingError)
    result = CliRunner().invoke(app, ["recover", str(path), "--scenario", str(scene)])
    assert result.exit_code == 0
    assert read(tmp_path / "a-recovered.mcap").scenario == load(scene)


@pytest.mark.parametrize("content", [None, b"", b"[robots]\n"])
def test_what_is_no_recording(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert isinstance(result.exception, RecordingError)
    assert str(path) in str(result.exception)
