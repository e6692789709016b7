import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli.log.group import app
from maniple.core.errors import ArgumentError
from maniple.recording.reader import read
from tests.recording.test_merge import heard_by
from tests.recording.traffic import drive, record, traffic


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    """What two recorders have of one run; the clock of the second is 2 s ahead."""
    sent = traffic(20)
    a = record(tmp_path / "a.mcap", heard_by(sent, 0, lambda n: n < 60))
    return a, record(tmp_path / "b.mcap", heard_by(sent, 2 * 10**9, lambda n: n >= 20))


def test_merged(two: tuple[Path, Path], tmp_path: Path) -> None:
    a, b = two
    result = CliRunner().invoke(app, ["merge", str(a), str(b)])
    assert result.exit_code == 0
    assert f"{a}: 60 messages, its clock is kept" in result.stdout
    assert (
        f"{b}: 60 messages, 20 of them only there; its clock is +2.000000 s ahead, drift +0.0 ppm, "
        "spread 0.000 ms over 40 common messages"
    ) in result.stdout
    assert list(read(tmp_path / "a-merged.mcap").messages()) == traffic(20)


def test_reference_and_json(two: tuple[Path, Path], tmp_path: Path) -> None:
    a, b = two
    out = str(tmp_path / "c.mcap")
    arguments = ["merge", str(a), str(b), "--reference", str(b), "--out", out, "--json"]
    found = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert found["sources"][0]["files"] == [str(b)]
    assert found["sources"][1]["offset"]["ahead_ns"] == -2 * 10**9
    result = CliRunner().invoke(app, ["merge", str(a), str(b), "--reference", out])
    assert isinstance(result.exception, ArgumentError)


def test_messages_that_differ(two: tuple[Path, Path], tmp_path: Path) -> None:
    a, _ = two
    sent = [m._replace(data=drive(m.sequence, "r1")[:-1] + b"\xc2") if n == 8 else m
            for n, m in enumerate(traffic(20))]  # fmt: skip
    c = record(tmp_path / "c.mcap", sent)
    result = CliRunner().invoke(app, ["merge", str(a), str(c)])
    assert result.exit_code == 1
    assert f"differs in {c}: hw/r1/drive, r1 (incarnation 1), seq 2" in result.stdout
    assert "--take-reference" in result.stdout
    assert not (tmp_path / "a-merged.mcap").exists()
    result = CliRunner().invoke(app, ["merge", str(a), str(c), "--take-reference"])
    assert result.exit_code == 0
    assert list(read(tmp_path / "a-merged.mcap").messages()) == traffic(20)
