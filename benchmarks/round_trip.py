"""Sense, command, robot: the way through two realtime hosts against a bare Zenoh round trip.

Each end is a process, and a third is the router that both ways go through; sizes, topics, priorities and
rate are the same. Bare: one end puts the bytes of an odometry at 20 Hz, the callback of the other puts
the bytes of a command, the callback of the first takes the time. Ours: from the moment a node returns an
odometry to the moment it is called with the command that answers it; so it holds encoding, checking and
decoding, the journal, the inbox and the waking of the host's thread at both ends, but neither the time
of the nodes nor the wait for a timer. The two take turns, with new processes each time.
"""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from benchmarks.common import RATE_HZ, Budget, Row, quantile, show
from benchmarks.round_trip_peers import PREFIX

TITLE = f"Realtime sense-command-robot time through the router at {RATE_HZ:g} Hz"
BUDGET = Budget(1.25, "ratio")

ROOT = Path(__file__).parent.parent
WARM_UP = 5
"""Round trips of each turn that do not count."""
_CALM_S = 5.0


def rows(quick: bool = False) -> list[Row]:
    """The median and the 99th percentile of the round trip."""
    rounds, count = (1, 5) if quick else (3, 100)
    bare: list[float] = []
    ours: list[float] = []
    with router() as endpoint:
        for turn in range(1, rounds + 1):
            bare += _turn("bare", endpoint, turn, count)
            ours += _turn("host", endpoint, turn, count)
    return [
        _row("median", 0.5, ours, bare, BUDGET),
        _row("99th percentile", 0.99, ours, bare, None),
    ]


def _row(name: str, share: float, ours: list[float], bare: list[float], budget: Budget | None) -> Row:
    return Row(name, quantile(ours, share), "us", "bare Zenoh callbacks", quantile(bare, share), budget)


@contextmanager
def router() -> Iterator[str]:
    """A router of `maniple` of our own, in a process; its endpoint. Never the usual port: that may be
    somebody's."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "maniple", "router", "--listen", endpoint, "--prefix", PREFIX]
    with process(command) as running:
        assert running.stdout is not None
        if not running.stdout.readline():
            raise RuntimeError(f"the router can't listen on {endpoint}")
        yield endpoint


def free_port() -> int:
    """A TCP port of this machine that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _turn(kind: str, endpoint: str, incarnation: int, count: int) -> list[float]:
    """Times of `count` round trips, us."""

    def command(role: str) -> list[str]:
        asked = (str(incarnation), str(count + WARM_UP))
        return [sys.executable, "-m", "benchmarks.round_trip_peers", kind, role, endpoint, *asked]

    with process(command("answerer")), process(command("asker")) as asker:
        out, _ = asker.communicate()
    taken = msgspec.json.decode(out or b"[]", type=list[int])
    if len(taken) < count + WARM_UP:
        raise RuntimeError(f"{kind} round trip: {len(taken)} answers of {count + WARM_UP}")
    return [1e-3 * ns for ns in taken[WARM_UP:]]


@contextmanager
def process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A child with a pipe to read and one that stays open; ended with the block."""
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=_CALM_S)


if __name__ == "__main__":
    show(TITLE, rows())
