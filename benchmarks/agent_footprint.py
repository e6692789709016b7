"""What one agent costs in a realtime run of the paper's scene at speed 1: CPU and memory of its process.

The run is started as `maniple run` starts it; its processes are looked at through /proc (Linux only) after
they have come up. CPU: user + system of all threads, as a share of one core; memory: the resident set. The
reference is a bare Zenoh client in the same run that hears and says as much as an agent.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from benchmarks.common import Budget, Row, show
from benchmarks.round_trip import ROOT, process
from benchmarks.virtual_run import PAPER
from maniple.cli.loading import load
from maniple.transport.zenoh import ZenohSession

TITLE = "One process of a realtime run at speed 1: CPU of one core, resident memory"
CPU_BUDGET = Budget(2.0, "ours")
MEMORY_BUDGET = Budget(60.0, "ours")

OTHERS = ("controller", "recorder", "router", "simulator")
"""The nodes that are not agents."""
ROBOT = "r1"
PREFIX = "maniple"
"""Of the scene's keys."""

CALM_S = 1.0
"""Between the last process coming up and the first look."""
START_WITHIN_S = 60.0
STOP_WITHIN_S = 20.0


class Look(NamedTuple):
    """What /proc says of one process."""

    cpu_s: float
    resident_mb: float


def rows(quick: bool = False) -> list[Row]:
    """CPU and memory of the agents (the worst of them), then of the other processes for information."""
    window_s = 1.0 if quick else 20.0
    with platoon() as (pids, endpoint), bare_agent(endpoint) as bare:
        time.sleep(CALM_S)
        begin, first = time.monotonic(), {pid: look(pid) for pid in (*pids.values(), bare)}
        time.sleep(window_s)
        last = {pid: look(pid) for pid in first}
        elapsed = time.monotonic() - begin
    share = {pid: 100 * (last[pid].cpu_s - first[pid].cpu_s) / elapsed for pid in last}
    resident = {pid: look.resident_mb for pid, look in last.items()}
    return [
        *_rows("CPU", "%", pids, share, bare, CPU_BUDGET),
        *_rows("memory", "MB", pids, resident, bare, MEMORY_BUDGET),
    ]


def _rows(
    what: str, unit: str, pids: Mapping[str, int], figures: Mapping[int, float], bare: int, budget: Budget
) -> list[Row]:
    agents = [pid for name, pid in pids.items() if name not in OTHERS]
    worst = max(figures[pid] for pid in agents)
    reference = max(figures[bare], 0.01)
    others = [Row(f"{name} {what}", figures[pids[name]], unit, "") for name in OTHERS]
    return [Row(f"agent {what}, worst", worst, unit, "Zenoh, same traffic", reference, budget), *others]


@contextmanager
def platoon() -> Iterator[tuple[Mapping[str, int], str]]:
    """A realtime run of the paper's scene: the process ids of its nodes by name, and its router."""
    with tempfile.TemporaryDirectory() as folder:
        log = str(Path(folder) / "run.mcap")
        command = [sys.executable, "-m", "maniple", "run", str(PAPER), "--speed", "1", "--log", log]
        run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield _nodes_of(run)
        finally:
            run.send_signal(signal.SIGINT)
            run.wait(STOP_WITHIN_S)


def _nodes_of(run: "subprocess.Popen[bytes]") -> tuple[dict[str, int], str]:
    """The process ids of a run by the name of their node, and its router, once all of them work."""
    names = {*OTHERS, *(robot.id for robot in load(PAPER).robots)}
    until = time.monotonic() + START_WITHIN_S
    while time.monotonic() < until and run.poll() is None:
        words = {pid: _words(pid) for pid in _children(run.pid)}
        pids = {name: pid for pid, said in words.items() if (name := _node(said))}
        if pids.keys() == names:
            said = words[pids["controller"]]
            endpoint = said[said.index("--connect") + 1]
            _await_lives(endpoint, names, until)
            return pids, endpoint
        time.sleep(0.1)
    raise RuntimeError(f"the run did not come up within {START_WITHIN_S:g} s")


def _children(parent: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def _words(pid: int) -> list[str]:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return []


def _node(words: list[str]) -> str:
    """The name of the node that a command line runs; empty where it runs none."""
    if "maniple" not in words:
        return ""
    command, *rest = words[words.index("maniple") + 1 :]
    return rest[0] if command == "agent" else command


def _await_lives(endpoint: str, names: set[str], until: float) -> None:
    """Wait until all nodes show that they live."""
    lives: SimpleQueue[str] = SimpleQueue()
    missing = set(names)
    with ZenohSession.client(endpoint, PREFIX) as session:
        session.watch(lambda node, _life, alive: lives.put(node) if alive else None)
        while missing:
            missing.discard(lives.get(timeout=max(until - time.monotonic(), 0.0)))


def look(pid: int) -> Look:
    """CPU time so far and resident set of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return Look(ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE") / 1e6)


@contextmanager
def bare_agent(endpoint: str) -> Iterator[int]:
    """The process id of a client with the traffic of an agent, and no more."""
    command = [sys.executable, "-m", "benchmarks.bare_agent", endpoint, PREFIX]
    with process([*command, "sink"]) as sink, process([*command, ROBOT]) as bare:
        for one in (sink, bare):
            assert one.stdout is not None
            if not one.stdout.readline():
                raise RuntimeError("the bare agent did not start")
        yield bare.pid


if __name__ == "__main__":
    show(TITLE, rows())
