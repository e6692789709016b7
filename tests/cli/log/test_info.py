import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.log.group import app
from maniple.core.errors import RecordingError
from maniple.recording.reader import read
from tests.recording.traffic import Sent, drive, record, traffic


def test_info_as_json(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(41))
    result = CliRunner().invoke(app, ["info", str(path), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["file"] == str(path)
    assert found["complete"] is True
    assert found["messages"] == 164
    assert found["missing"] == 0
    assert {channel["topic"] for channel in found["channels"]} >= {"hw/r1/drive", "hw/r2/scan"}


def test_info_for_people(tmp_path: Path) -> None:
    """Gaps are reported, and are no failure."""
    seqs = [2, 3, 5, 9, 11, 13, 13]
    sent = [Sent("hw/r1/drive", drive(seq), seq, seq, seq) for seq in seqs]
    sent.append(Sent("hw/r1/scan", b"?", 1, 1, 1))
    path = record(tmp_path / "a.mcap", sent)
    result = CliRunner().invoke(app, ["info", str(path)])
    assert result.exit_code == 0
    assert "finished" in result.stdout
    assert "virtual" in result.stdout
    assert (
        "hw/r1/drive: r1 (incarnation 1): missed the first 2, seq 4, 6-8, 10 and 1 more gaps, "
        "8 of 14 missing, 1 repeated"
    ) in result.stdout
    assert "hw/r1/scan: 1 messages without a valid header" in result.stdout
    assert "missed the last" not in result.stdout


def test_info_of_a_damaged_file_tells_what_and_ends_with_1(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(41))
    place = read(path).layouts[0].chunks[1]
    content = bytearray(path.read_bytes())
    content[place.offset + place.length - 9] ^= 1
    path.write_bytes(content)
    result = CliRunner().invoke(app, ["info", str(path)])
    assert result.exit_code == 1
    assert f"damaged: {path}: the chunk at byte {place.offset} is damaged" in result.stdout
    assert f"maniple log recover {path}" in result.stdout
    assert json.loads(CliRunner().invoke(app, ["info", str(path), "--json"]).stdout)["damage"]


def test_info_of_an_unfinished_file(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(41))
    path.write_bytes(path.read_bytes()[:-9])
    result = CliRunner().invoke(app, ["info", str(path)])
    assert result.exit_code == 0
    assert "not finished" in result.stdout


@pytest.mark.parametrize("content", [None, b"", b"[robots]\n"])
def test_bad_file_is_one_error_for_main(tmp_path: Path, content: bytes | None) -> None:
    """`main` prints it and ends with status 2."""
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    result = CliRunner().invoke(app, ["info", str(path)])
    assert isinstance(result.exception, RecordingError)
    assert str(path) in str(result.exception)
    assert result.stdout == ""


def test_usage_error() -> None:
    assert CliRunner().invoke(app, ["info"]).exit_code == 2
