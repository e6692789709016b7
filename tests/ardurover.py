"""ArduPilot Rover's own firmware, where the environment variable MANIPLE_ARDUROVER names a binary of it that
was built for its simulator (SITL)."""

import os
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

VARIABLE = "MANIPLE_ARDUROVER"
HOME = (47.3977, 8.5456, 488.0)
"""Where it stands: latitude and longitude (degrees), altitude (m); looking east."""
PARAMETERS = "WP_SPEED 2\nCRUISE_SPEED 1\nFS_THR_ENABLE 0\n"
"""That nobody holds a remote control is no failure."""


@contextmanager
def ardurover(folder: Path) -> Iterator[int]:
    """The TCP port of one that was just switched on; its files are in `folder`. Skips the test where there is
    none."""
    binary = os.environ.get(VARIABLE)
    if not binary:
        pytest.skip(f"{VARIABLE} names no ArduPilot Rover: not tried on firmware")
    parameters = folder / "rover.parm"
    parameters.write_text(PARAMETERS)
    instance = free_instance()
    place = ",".join(map(str, (*HOME, 90)))
    options = {"-M": "rover", "--home": place, "-I": str(instance), "--defaults": str(parameters)}
    command = [binary, "-w", *(word for option in options.items() for word in option)]
    with (folder / "ardurover.log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            yield 5760 + 10 * instance
        finally:
            process.kill()
            process.wait()


def free_instance() -> int:
    """Of its simulator: the ports from 5760 + 10 times that on are free."""
    for instance in range(50, 400):
        base = 5760 + 10 * instance
        try:
            for port in (base, base + 2, base + 3):
                with socket.create_server(("127.0.0.1", port)):
                    pass
        except OSError:
            continue
        return instance
    raise AssertionError("no free ports")
