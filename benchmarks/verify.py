"""`maniple log verify` on six robots: how many times real time it goes, and its cost against the run's.

The recording is of a run in virtual time with everything on. Every node is run again and every byte that it
sends is compared. Wall time is of the whole work on all cores, with the start of the processes; CPU time is
of one process that does it all.
"""

import os
import tempfile
import time
from pathlib import Path

from benchmarks.common import Budget, Row, cpu_s, show
from benchmarks.virtual_run import PAPER
from maniple import run
from maniple.cli.loading import load
from maniple.cli.log.proving import Order, verify
from maniple.recording.compare import EXACT

TITLE = "maniple log verify, six robots, recorded seconds per second"

SECONDS, QUICK_SECONDS = 165.0, 3.0
"""Simulated."""

BUDGET = Budget(50.0, "ours", "at least")


def rows(quick: bool = False) -> list[Row]:
    """Times real time on all cores, and simulated seconds per CPU second against the run."""
    scenario = load(PAPER)
    duration_s = QUICK_SECONDS if quick else SECONDS
    rounds = 1 if quick else 3
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        made = cpu_s(lambda: run(scenario, virtual=True, duration_s=duration_s, log=log))
        cores = len(os.sched_getaffinity(0))
        wall_s = min(_wall_s(log, cores) for _ in range(rounds))
        spent = min(cpu_s(lambda: _verify(log, 1)) for _ in range(rounds))
    return [
        Row(f"wall time, {cores} cores", duration_s / wall_s, "s/s", "real time", 1.0, BUDGET),
        Row("CPU time, one process", duration_s / spent, "s/s", "the virtual run", duration_s / made),
    ]


def _wall_s(log: Path, jobs: int) -> float:
    begin = time.perf_counter()
    _verify(log, jobs)
    return time.perf_counter() - begin


def _verify(log: Path, jobs: int) -> None:
    found = verify(Order(log, EXACT, 0), (), jobs, lambda: False, lambda _: None)
    assert found.holds, f"{log} is not proved"


if __name__ == "__main__":
    show(TITLE, rows())
