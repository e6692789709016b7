"""What this machine has of what maniple needs. Each check looks at one thing and never raises."""

import os
import platform
import re
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Literal, TypeAlias

import msgspec

from maniple.core.errors import ManipleError
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession

State: TypeAlias = Literal["ok", "poor", "missing"]
"""Fine; works, but not well or not everything; a run is not possible."""

LEAST_PYTHON = (3, 11)
LEAST_CORES = 2
LEAST_FREE_GB = 1.0
"""A recording of six robots takes about 200 MB an hour."""
ROUNDS = 200
SLOW_MS = 20.0
"""A round trip or a timer that is off by more is felt at 10 Hz."""
_TICK_S = 0.005
_ANSWER_S = 5.0


class Check(msgspec.Struct, frozen=True):
    """One thing that was looked at."""

    name: str
    state: State
    found: str
    advice: str = ""
    """What to do about it; empty where nothing is to be done."""


class Requirement(msgspec.Struct, frozen=True):
    """A package, as an installed distribution asks for it."""

    package: str
    least: str
    extra: str
    """The optional part that needs it; empty where everything does."""


def checks(logs: Path = Path("logs")) -> Iterator[Check]:
    """All checks, as they are done; `logs` is where recordings go."""
    yield python(sys.version_info[:3])
    yield from packages(requirements(), _version)
    yield cores(_cores())
    yield proc(Path("/proc/self/stat"))
    yield port(DEFAULT_PORT)
    yield round_trip()
    yield timer()
    yield disk(logs)


def python(version: tuple[int, int, int]) -> Check:
    """The interpreter."""
    found = f"{'.'.join(map(str, version))} ({platform.python_implementation()})"
    if version >= LEAST_PYTHON:
        return Check("python", "ok", found)
    return Check("python", "missing", found, "needs Python {}.{} or newer".format(*LEAST_PYTHON))


def requirements(distribution: str = "maniple") -> list[Requirement]:
    """What the installed maniple asks for; nothing where it runs from its folder without being installed."""
    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return []
    return [requirement for line in lines if (requirement := requirement_of(line)) is not None]


def requirement_of(line: str) -> Requirement | None:
    """A line of a distribution's metadata, as in 'scipy>=1.11; extra == "planning"'; None for extras of
    extras and for what only developers need."""
    name = re.match(r"[A-Za-z0-9._-]+", line)
    least = re.search(r">=\s*([0-9.]+)", line)
    extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)", line)
    part = extra[1] if extra else ""
    if name is None or name[0] == "maniple" or part == "dev":
        return None
    return Requirement(name[0], least[1] if least else "0", part)


def packages(asked: Sequence[Requirement], version: Callable[[str], str | None]) -> Iterator[Check]:
    """Every package, and whether it is new enough; those of optional parts may be absent."""
    there: set[Requirement] = set()
    for one in asked:
        found = version(one.package)
        if found is not None and _numbers(found) >= _numbers(one.least):
            same = msgspec.structs.replace(one, extra="")
            if same not in there:
                yield Check(one.package, "ok", found)
            there.add(same)
        elif one.extra:
            advice = f"for {one.extra}: pip install 'maniple[{one.extra}]'"
            yield Check(one.package, "poor", found or "absent", advice)
        else:
            advice = f"needs {one.least} or newer: pip install '{one.package}>={one.least}'"
            yield Check(one.package, "missing", found or "absent", advice)


def cores(count: int) -> Check:
    """Processors this process may use."""
    if count >= LEAST_CORES:
        return Check("cores", "ok", str(count))
    return Check(
        "cores", "poor", str(count), "six robots at real time need two: use --virtual, or less --speed"
    )


def proc(stat: Path) -> Check:
    """The process table, where frozen processes are seen."""
    if stat.exists():
        return Check("/proc", "ok", "present")
    return Check("/proc", "poor", "absent", "without it nobody is told of frozen processes")


def port(number: int) -> Check:
    """The usual port of the router."""
    name = f"port {number}"
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
        except OSError as error:
            advice = "a run takes another and says which; operators need --connect then"
            return Check(name, "poor", error.strerror or "not free", advice)
    return Check(name, "ok", "free")


def round_trip(rounds: int = ROUNDS) -> Check:
    """Messages there and back through a router of its own on loopback, ms."""
    try:
        times = _round_trips(rounds)
    except (ManipleError, OSError) as error:
        return Check("zenoh round trip", "missing", str(error), "processes on this machine can't talk")
    if not times:
        return Check("zenoh round trip", "missing", "no answer", "processes on this machine can't talk")
    return _spread("zenoh round trip", times, "too slow or too busy for real time: use --virtual")


def timer(rounds: int = ROUNDS) -> Check:
    """How much later than asked a thread is woken, ms."""
    never = threading.Event()
    late = []
    for _ in range(rounds):
        due = time.perf_counter() + _TICK_S
        never.wait(_TICK_S)
        late.append(1000.0 * max(time.perf_counter() - due, 0.0))
    return _spread("timer lateness", late, "too busy for real time: use --virtual")


def disk(logs: Path) -> Check:
    """Room for recordings."""
    folder = next(path for path in (logs.absolute(), *logs.absolute().parents) if path.is_dir())
    free_gb = shutil.disk_usage(folder).free / 1e9
    found = f"{free_gb:.1f} GB free in {folder}"
    if not os.access(folder, os.W_OK):
        return Check("disk", "missing", f"{folder} can't be written", "run elsewhere, or say --log FILE")
    if free_gb < LEAST_FREE_GB:
        return Check("disk", "poor", found, "a recording of six robots takes about 200 MB an hour")
    return Check("disk", "ok", found)


def _round_trips(rounds: int) -> list[float]:
    """Times in ms; fewer where answers are lost."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    back = threading.Event()
    times = []
    with (
        ZenohSession.router(endpoint, "doctor"),
        ZenohSession.client(endpoint, "doctor") as near,
        ZenohSession.client(endpoint, "doctor") as far,
    ):
        far.subscribe("there", lambda _, data: far.put_raw("back", data))
        near.subscribe("back", lambda *_: back.set())
        far.settle()
        near.settle()
        for _ in range(rounds):
            back.clear()
            begin = time.perf_counter()
            near.put_raw("there", bytes(1000))
            if not back.wait(_ANSWER_S):
                break
            times.append(1000.0 * (time.perf_counter() - begin))
    return times


def _spread(name: str, times_ms: Sequence[float], advice: str) -> Check:
    """Median and 99th percentile."""
    ranked = sorted(times_ms)
    p50, p99 = (ranked[min(int(share * len(ranked)), len(ranked) - 1)] for share in (0.5, 0.99))
    found = f"{p50:.2f} ms median, {p99:.2f} ms p99"
    return Check(name, "poor", found, advice) if p99 > SLOW_MS else Check(name, "ok", found)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])
