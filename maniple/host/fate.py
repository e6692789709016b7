"""Crashes and freezes of a fault plan: each process does its own to itself, so they are real anywhere."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from typing import NamedTuple, NoReturn, TypeAlias

from maniple.core.faults import back_at, crash_between, dead, freeze_between
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Crash
from maniple.core.time import Duration, Time, from_seconds
from maniple.host.clock import Anchor

LOOK_S = 0.2
"""How often who waits to live again looks at the plan, wall time."""

_STOPPED_WITHIN_S = 0.01
"""A process of several threads goes on for a moment after its signal to itself."""


class Death(NamedTuple):
    """This process is to die now."""

    crash: Crash
    """Of it."""


class Pause(NamedTuple):
    """This process is to stand still."""

    left: Duration
    """For how long from now."""


Meet: TypeAlias = Callable[[Death | Pause, Anchor], None]
"""Makes it happen."""


class Fate:
    """What a plan has in store for one process that began at `began`, in true scenario time. Pure.

    `killers` are the nodes whose crash ends it, itself among them. What is said late is done late: a crash
    that the process has lived to see, and what is left of a freeze.
    """

    def __init__(self, node: str, killers: Collection[str], began: Time) -> None:
        self._node = node
        self._killers = killers
        self._began = self._after = began

    def due(self, plan: FaultPlan, now: Time) -> Death | Pause | None:
        """What is to happen now; each thing once."""
        if crash := crash_between(plan, self._killers, self._began, now):
            return Death(crash)
        while freeze := freeze_between(plan, (self._node,), self._after, now):
            self._after = plan.since_ns + from_seconds(freeze.at_s)
            if (left := self._after + from_seconds(freeze.for_s) - now) > 0:
                return Pause(left)
        return None


def meet(event: Death | Pause, clock: Anchor) -> None:
    """Do it to this process."""
    if isinstance(event, Death):
        die()
    freeze(clock.wall_seconds(event.left))


def die() -> NoReturn:
    """End this process without a word."""
    os.kill(os.getpid(), signal.SIGKILL)
    os._exit(128 + signal.SIGKILL)  # the first process of a container survives its own signals


def freeze(wall_s: float) -> None:
    """Stop this process, and let a child of it wake it up. The child ends with it: its input closes then."""
    began = time.monotonic()
    script = f"timeout {wall_s:.3f} cat >/dev/null; kill -CONT {os.getpid()} 2>/dev/null"
    with subprocess.Popen(  # noqa: S602 - numbers of our own
        script,
        shell=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ):
        os.kill(os.getpid(), signal.SIGSTOP)
        time.sleep(_STOPPED_WITHIN_S)
    if time.monotonic() - began < wall_s / 2.0:
        say(f"was to be frozen for {wall_s:.1f} s and is not: woken up, or process 1 of a container")


def wait_out(
    node: str,
    killers: Collection[str],
    plan_now: Callable[[], FaultPlan],
    clock: Anchor,
    sleep: Callable[[float], None] = time.sleep,
) -> bool:
    """Where the plan has this node dead, wait until it is not. False: it is gone for good."""
    waits = False
    while crash := dead(plan := plan_now(), killers, clock.now()):
        if crash.restart_after_s is None:
            say(f"{node} is dead for good by the fault plan ({crash.node} crashes at {crash.at_s:g} s)")
            return False
        if not waits:
            back_s = crash.at_s + crash.restart_after_s
            say(f"{node} is dead by the fault plan until {back_s:g} s of the run: waits")
            waits = True
        sleep(min(LOOK_S, max(clock.wall_seconds(back_at(plan, crash) - clock.now()), 0.001)))
    return True


def say(line: str) -> None:
    """A line on standard error, if somebody listens."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()
