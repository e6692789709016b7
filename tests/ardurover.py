"""A real ArduPilot Rover, where there is one: its simulator's binary, named by MANIPLE_ARDUROVER.

The variable holds a command: "/opt/ardurover", or with options of its own as in
"/opt/ardurover --model rover-skid --defaults /opt/rover-skid.parm". Port and place are added.
"""

import os
import shlex
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.transport.test_zenoh import free_port

VARIABLE = "MANIPLE_ARDUROVER"
HOME = (47.3977, 8.5456, 488.0)
"""Where it stands: latitude and longitude (degrees), altitude (m); looking east."""


@contextmanager
def ardurover(folder: Path) -> Iterator[int]:
    """The TCP port of one that was just switched on, with parameters as delivered; it keeps them in `folder`.
    Skips the test where there is none."""
    given = shlex.split(os.environ.get(VARIABLE, ""))
    if not given:
        pytest.skip(f"no real ArduPilot Rover here: {VARIABLE} names none")
    model = [] if "--model" in given else ["--model", "rover"]
    port = free_port()
    place = ",".join(map(str, (*HOME, 90)))
    command = [*given, *model, "--wipe", "--home", place, "--base-port", str(port)]
    with (folder / "ardurover.log").open("w") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=subprocess.STDOUT)
        try:
            yield port
        finally:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
