"""Crashes and freezes of a plan, which a process does to itself."""

import signal
import subprocess
import sys
import time
from typing import Any

import msgspec
import pytest

from maniple.core.faults import NEVER
from maniple.core.messages import FaultPlan
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.fate import Death, Fate, Pause, wait_out
from tests.waiting import eventually, state

S = SECOND
CRASH = {"node": "r1", "at_s": 10.0, "restart_after_s": 5.0}


def plan(since: int = 0, crashes: Any = (), freezes: Any = ()) -> FaultPlan:
    return msgspec.convert({"since_ns": since, "crashes": crashes, "freezes": freezes}, FaultPlan)


def test_a_process_dies_when_its_crash_is_due_and_not_of_one_before_its_time() -> None:
    crash = plan(crashes=[CRASH])
    assert Fate("r1", ("r1",), 0).due(crash, 10 * S - 1) is None
    assert Fate("r1", ("r1",), 0).due(crash, 10 * S) == Death(crash.crashes[0])
    assert Fate("r1", ("r1",), 10 * S).due(crash, 12 * S) is None
    assert Fate("r2", ("r2",), 0).due(crash, 12 * S) is None


def test_a_controller_dies_with_the_robot_it_runs_on() -> None:
    assert isinstance(Fate("controller", ("controller", "r1"), 0).due(plan(crashes=[CRASH]), 11 * S), Death)


def test_a_plan_that_comes_late_is_carried_out_late() -> None:
    fate = Fate("r1", ("r1",), 0)
    assert fate.due(plan(NEVER, crashes=[CRASH]), 11 * S) is None
    assert isinstance(fate.due(plan(crashes=[CRASH]), 11 * S), Death)


def test_each_freeze_is_met_once_for_what_is_left_of_it() -> None:
    freezes = [{"node": "r1", "at_s": at, "for_s": 2.0} for at in (20.0, 3.0, 8.0)]
    fate = Fate("r1", ("r1",), 0)
    assert fate.due(plan(freezes=freezes), 2 * S) is None
    assert fate.due(plan(freezes=freezes), 4 * S) == Pause(1 * S)
    assert fate.due(plan(freezes=freezes), 4 * S) is None
    again = plan(freezes=[*freezes, {"node": "r1", "at_s": 15.0, "for_s": 1.0}])
    assert fate.due(again, 12 * S) is None  # that of 8 s is over
    assert fate.due(again, 15 * S) == Pause(1 * S)
    assert fate.due(again, 20 * S) == Pause(2 * S)
    assert fate.due(again, 99 * S) is None


def test_who_starts_in_the_time_of_its_death_waits(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Anchor(12 * S, time.monotonic_ns(), speed=100.0)
    assert wait_out("r2", ("r2",), lambda: plan(crashes=[CRASH]), clock)
    assert capsys.readouterr().err == ""
    assert wait_out("r1", ("r1",), lambda: plan(crashes=[CRASH]), clock)
    assert clock.now() >= 15 * S
    assert "r1 is dead by the fault plan until 15 s of the run" in capsys.readouterr().err


def test_a_plan_that_is_cleared_lets_it_live_at_once() -> None:
    plans = iter([plan(crashes=[CRASH]), plan()])
    clock = Anchor(12 * S, time.monotonic_ns())
    assert wait_out("r1", ("r1",), lambda: next(plans), clock, lambda _: None)


def test_who_is_dead_for_good_does_not_live(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Anchor(12 * S, time.monotonic_ns())
    dead = plan(crashes=[{"node": "r1", "at_s": 10.0}])
    assert not wait_out("controller", ("controller", "r1"), lambda: dead, clock)
    assert "controller is dead for good by the fault plan (r1 crashes at 10 s)" in capsys.readouterr().err


def process(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_a_death_is_a_real_one() -> None:
    with process("from maniple.host.fate import die; die(); print('lives')") as child:
        out, _ = child.communicate(timeout=60)
    assert child.returncode == -signal.SIGKILL
    assert out == ""


FREEZE = """
import time
from maniple.host.fate import freeze
print("begins", flush=True)
began = time.monotonic()
freeze({wall_s})
print(time.monotonic() - began, flush=True)
"""


def test_a_freeze_is_a_real_one_and_ends_by_itself() -> None:
    with process(FREEZE.format(wall_s=1.0)) as child:
        assert child.stdout is not None
        child.stdout.readline()
        eventually(lambda: state(child.pid) == "T")
        lasted = float(child.stdout.readline())
        child.wait(timeout=60)
    assert 1.0 <= lasted < 3.0
    assert child.returncode == 0


def test_what_wakes_a_frozen_process_ends_with_it() -> None:
    with process(FREEZE.format(wall_s=3600.0)) as child:
        eventually(lambda: state(child.pid) == "T")
        assert wakers(child.pid)
        child.kill()
        child.wait(timeout=60)
    eventually(lambda: not wakers(child.pid))


def wakers(pid: int) -> list[str]:
    found = subprocess.run(["pgrep", "-f", f"kill -CONT {pid}"], capture_output=True, text=True)
    return found.stdout.split()
