"""Oracle: the MCAP implementation in TypeScript, which shares no code with the one in Python."""

import json
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from maniple.core import topics
from maniple.recording.writer import Compression
from tests.recording.traffic import METADATA, SCENARIO, Sent, record, traffic

NPM = Path(__file__).parent / "npm"


@pytest.fixture(scope="module")
def checker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The check script with its packages installed."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    folder = tmp_path_factory.mktemp("npm")
    for name in ("package.json", "check.mjs"):
        shutil.copy(NPM / name, folder)
    command = [npm, "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    if done.returncode:
        pytest.skip(f"npm install failed: {done.stderr.strip()[-300:]}")
    return folder / "check.mjs"


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_typescript_readers_agree(checker: Path, tmp_path: Path, compression: Compression) -> None:
    sent = [*traffic(200), Sent("else/where", b"\x01", 1, 1, 0)]
    found = _check(checker, record(tmp_path / "a.mcap", sent, compression))
    counts = Counter(f"maniple/{message.topic}" for message in sent)
    assert found["streamed"] == found["indexed"] == counts
    assert found["attachments"] == {"scenario.json": SCENARIO.decode()}
    assert found["metadata"] == {"maniple": {**METADATA, "prefix": "maniple"}}
    assert found["schemas"].pop("maniple/else/where") is None
    assert found["schemas"] == {
        key: f"maniple.{topics.topic(key.removeprefix('maniple/')).type.__name__}" for key in found["schemas"]
    }


@pytest.mark.slow
def test_typescript_readers_take_a_recording_without_messages(checker: Path, tmp_path: Path) -> None:
    found = _check(checker, record(tmp_path / "a.mcap", []))
    assert found["streamed"] == found["indexed"] == {}


def _check(checker: Path, path: Path) -> Any:
    done = subprocess.run(
        ["node", checker.name, str(path)], cwd=checker.parent, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
