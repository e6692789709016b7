"""Kills and freezes each process of a platoon in turn while it runs."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Literal, NamedTuple, TypeAlias

from maniple.cli.loading import load
from maniple.core import codec, topics
from maniple.core.messages import FormationState
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Time, to_seconds
from maniple.host.clock import Anchor
from maniple.transport.zenoh import ZenohSession

SCENE = """
name = "reliability"
task = { kind = "line", start = [0, 0], end = [500, 0], speed_mps = 0.2 }
formation.points = [[2.0, 0.9], [1.2, -0.9], [0.4, 0.9], [-0.4, -0.9], [-1.2, 0.9], [-2.0, -0.9]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }, { id = "r4" }, { id = "r5" }, { id = "r6" }]
guard = { hold_after_s = 0.5, stop_after_s = 1.0 }
"""
FROZEN_S = 3.0
"""How long a process is stopped."""
CALM_S = 4.0
"""The platoon is under way for so long before each case."""
_GIVE_UP_S = 90.0

How: TypeAlias = Literal["kill", "freeze"]


class Case(NamedTuple):
    """One process, and what is done to it."""

    how: How
    who: str


CASES = (
    *(Case("kill", who) for who in ("r3", "controller", "router", "recorder")),
    *(Case("freeze", who) for who in ("r3", "controller", "router", "recorder", "simulator")),
)


class Event(NamedTuple):
    """A case as it was done, in scenario time."""

    case: Case
    begin: Time
    thawed: Time | None
    """When a frozen process was let go."""


class Done(NamedTuple):
    """A run in which cases were done."""

    scenario: Scenario
    logs: list[Path]
    events: list[Event]


def run(cases: Sequence[Case], folder: Path, speed: float = 1.0) -> Done:
    """Run the scene with --keep-alive and do all cases in turn; the recording is left in `folder`."""
    (scenario := folder / "scene.toml").write_text(SCENE)
    robots = len(load(scenario).robots)
    with _running(scenario, folder / "run.mcap", speed) as (process, pids):
        _until(lambda: len(pids()) == robots + 4)
        options = _arguments(pids()["controller"])
        clock = Anchor.parse(options[options.index("--anchor") + 1])
        states: SimpleQueue[FormationState] = SimpleQueue()
        with ZenohSession.client(options[options.index("--connect") + 1], "maniple") as session:
            session.subscribe(topics.FORMATION_STATE, lambda topic, data: _hear(states, topic, data))
            events = [_do(case, pids, states, clock) for case in cases]
            _await_calm(states)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    if process.returncode != 130 or "Traceback" in err:
        raise RuntimeError(f"the run ended with status {process.returncode}:\n{err}")
    return Done(load(scenario), [Path(log) for log in json.loads(out)["logs"]], events)


def _do(
    case: Case, pids: Callable[[], dict[str, int]], states: SimpleQueue[FormationState], clock: Anchor
) -> Event:
    _await_calm(states)
    pid = pids()[case.who]
    begin = clock.now()
    if case.how == "kill":
        os.kill(pid, signal.SIGKILL)
        _until(lambda: pids().get(case.who, pid) != pid)
        return Event(case, begin, None)
    os.kill(pid, signal.SIGSTOP)
    until = begin + round(FROZEN_S * SECOND)
    _until(lambda: clock.now() >= until)
    thawed = clock.now()
    os.kill(pid, signal.SIGCONT)
    return Event(case, begin, thawed)


def _await_calm(states: SimpleQueue[FormationState]) -> None:
    """Until the platoon has been under way for a while, from now on."""
    until = time.monotonic() + _GIVE_UP_S
    for _ in range(states.qsize()):
        states.get_nowait()
    since: FormationState | None = None
    while time.monotonic() < until:
        try:
            state = states.get(timeout=1.0)
        except Empty:
            since = None
            continue
        if not under_way(state):
            since = None
        elif since is None or since.incarnation != state.incarnation:
            since = state
        elif to_seconds(state.stamp_ns - since.stamp_ns) >= CALM_S:
            return
    raise TimeoutError(f"the platoon was not under way within {_GIVE_UP_S:g} s")


def under_way(state: FormationState) -> bool:
    """Whether the reference moves and everybody follows."""
    return state.phase == "running" and state.rate > 0.0 and not state.waits_for


def _hear(states: SimpleQueue[FormationState], topic: str, data: bytes) -> None:
    message = codec.decode(topic, data)
    assert isinstance(message, FormationState)
    states.put(message)


@contextmanager
def _running(
    scenario: Path, log: Path, speed: float
) -> Iterator[tuple[subprocess.Popen[str], Callable[[], dict[str, int]]]]:
    """`maniple run --keep-alive`, and what gives the processes of its platoon; ended by force if need be."""
    root = str(Path(__file__).parents[2])
    arguments = ["run", str(scenario), "--keep-alive", "--json", "--speed", f"{speed}", "--log", str(log)]
    process = subprocess.Popen(
        [sys.executable, "-m", "maniple", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": root},
    )
    seen: set[int] = set()

    def pids() -> dict[str, int]:
        found = {}
        for task in Path(f"/proc/{process.pid}/task").glob("*/children"):
            for pid in map(int, task.read_text().split()):
                if name := _name(_arguments(pid)):
                    found[name] = pid
        seen.update(found.values())
        return found

    try:
        yield process, pids
    finally:
        pids()
        process.kill()
        process.communicate()
        for pid in seen:
            if _name(_arguments(pid)):
                os.kill(pid, signal.SIGKILL)


def _arguments(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().rstrip("\0").split("\0")
    except (FileNotFoundError, ProcessLookupError):
        return []


def _name(arguments: list[str]) -> str:
    """The node that a process runs; empty for any other."""
    command, *rest = arguments[arguments.index("maniple") + 1 :] if "maniple" in arguments else [""]
    known = ("router", "recorder", "simulator", "controller", "agent")
    return "" if command not in known else rest[0] if command == "agent" else command


def _until(what: Callable[[], Any]) -> None:
    until = time.monotonic() + _GIVE_UP_S
    while not what():
        if time.monotonic() > until:
            raise TimeoutError(f"not within {_GIVE_UP_S:g} s")
        time.sleep(0.02)
