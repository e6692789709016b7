"""The program's first moments, as a process of its own."""

import signal
import subprocess
import sys

import pytest

from tests.transport.test_zenoh import free_port

ENDED = (130, -signal.SIGINT)
"""A shell says 130 of both: CPython ends by the signal where it came while text was executed, as `dataclass`
and `NamedTuple` do."""


def interrupted(module: str, *arguments: str) -> tuple[int, list[str]]:
    """The status of a process that is interrupted when it has imported a module, and what it said."""
    program = (sys.executable, "-X", "importtime", "-m", "maniple", *arguments)
    with subprocess.Popen(program, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        sent, said = False, []
        for line in process.stderr:
            if not line.startswith("import time:"):
                said.append(line)
            elif not sent and line.rpartition("|")[2].strip() == module:
                process.send_signal(signal.SIGINT)
                sent = True
        assert sent, said
        return process.wait(), said


@pytest.mark.parametrize(
    "module", ["maniple.core.scenario.types", "maniple.core.errors", "numpy", "typer", "maniple.cli.program"]
)
def test_a_command_that_is_interrupted_while_it_is_imported_says_nothing(module: str) -> None:
    status, said = interrupted(module, "status", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert (status in ENDED, said) == (True, []), status


@pytest.mark.parametrize("module", ["maniple.core.scenario.types", "numpy", "maniple.cli.node_commands"])
def test_a_node_that_is_interrupted_while_it_is_imported_says_nothing(module: str) -> None:
    status, said = interrupted(module, "recorder", "--scenario", "-", "--log", "/dev/null/x")
    assert (status in ENDED, said) == (True, []), status
