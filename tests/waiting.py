"""Waiting for what happens in other processes."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def eventually(what: Callable[[], T], within_s: float = 60.0) -> T:
    """The first value of `what()` that is true; it is asked again and again until the deadline."""
    until = time.monotonic() + within_s
    while not (value := what()):
        assert time.monotonic() < until, f"not within {within_s:g} s"
        time.sleep(0.02)
    return value


def runs(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    return state(pid) not in ("", "Z", "X")


def state(pid: int) -> str:
    """The letter of a process's state, as `ps` has it; empty where there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return ""


def children_of(pid: int) -> dict[int, list[str]]:
    """The arguments of every process that `pid` started and that still runs, by process id."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            stat = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            if int(stat[1]) == pid and stat[0] != "Z":
                found[int(entry.name)] = (entry / "cmdline").read_text().rstrip("\0").split("\0")
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found
