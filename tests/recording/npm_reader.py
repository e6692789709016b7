"""The MCAP implementation in TypeScript, which shares no code with the one in Python."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

NPM = Path(__file__).parent / "npm"


def install(folder: Path) -> Path:
    """The check script with its packages, in a folder; the test is skipped where that can't be had."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    for name in ("package.json", "check.mjs"):
        shutil.copy(NPM / name, folder)
    command = [npm, "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    if done.returncode:
        pytest.skip(f"npm install failed: {done.stderr.strip()[-300:]}")
    return folder / "check.mjs"


def check(checker: Path, path: Path) -> Any:
    """What it finds in a recording, read from front to back with all checksums, and by the index."""
    done = subprocess.run(
        ["node", checker.name, str(path)], cwd=checker.parent, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
