import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.log.group import app
from maniple.core.errors import ArgumentError
from maniple.recording.reader import read
from tests.recording.test_cut import stop, with_viewers
from tests.recording.traffic import record, traffic


def test_a_part_as_a_recording(tmp_path: Path) -> None:
    sent = [stop(0, 999_999_999 * 10**9), *traffic(60)]
    path = record(tmp_path / "a.mcap", sent)
    result = CliRunner().invoke(
        app, ["cut", str(path), "--from", "2", "--until", "3", "--without", "hw/r2/*"]
    )
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "40 messages",
        "attached from before, as it still holds: platoon/stop",
        f"recording: {tmp_path / 'a-cut.mcap'}",
    ]
    assert len(list(read(tmp_path / "a-cut.mcap").messages())) == 40


def test_as_json_with_viewer_channels(tmp_path: Path) -> None:
    path = with_viewers(tmp_path / "a.mcap", traffic(4))
    out = str(tmp_path / "b.mcap")
    arguments = ["cut", str(path), "--topic", "**/scan", "--topic", "viz/x", "--out", out, "--json"]
    found = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert (found["messages"], found["viewer_messages"], found["out"]) == (8, 16, out)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "say what to take"),
        (["--topic", "nothing"], "no topic .* matches 'nothing'; there are hw/r1/drive"),
        (["--from", "9"], "ends after"),
    ],
)
def test_bad_input(tmp_path: Path, options: list[str], message: str) -> None:
    path = record(tmp_path / "a.mcap", traffic(4))
    result = CliRunner().invoke(app, ["cut", str(path), *options])
    assert isinstance(result.exception, ArgumentError)
    with pytest.raises(ArgumentError, match=message):
        raise result.exception
    assert not (tmp_path / "a-cut.mcap").exists()
