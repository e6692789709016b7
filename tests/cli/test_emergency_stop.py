"""The emergency stop of real processes: while they move, without a controller, without a network."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniple.cli.operator import latched, operator_session, publish
from maniple.cli.status_command import Listener, look
from maniple.cli.stop_command import Confirmed, confirm
from maniple.core import topics
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Truth, unpack_floats
from maniple.core.scenario.types import Fault
from maniple.core.time import Time, to_seconds
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import SMALL, write
from tests.cli.test_realtime import Run, running
from tests.pioneer import PIONEER
from tests.waiting import eventually

pytestmark = pytest.mark.slow

PATIENCE_S = 60.0
SPEED = 2.0
FAST = SMALL.replace("end = [1.5, 0]", "end = [6, 0]").replace("speed_mps = 0.15", "speed_mps = 0.3")
ROBOTS = {"r1", "r2", "r3"}
STOP, ARM = EmergencyStop(stopped=True, reason="a test"), EmergencyStop(stopped=False)

REACTION_S = 0.5
"""Of scenario time: until a stop is with every robot, on a machine that is busy with other things."""


def progress(session: ZenohSession) -> float:
    """How far along the task the platoon is, s."""
    state = latched(session, topics.FORMATION_STATE)
    return state.task_time_s if isinstance(state, FormationState) and state.phase == "running" else 0.0


def connected(run: Run) -> Any:
    """A session with a platoon of which every process has started."""
    eventually(lambda: len(run.children()) == 7)
    return operator_session(run.option("--connect"), "maniple", PATIENCE_S)


def ordered(session: ZenohSession, message: EmergencyStop) -> Confirmed:
    found = confirm(session, message, PATIENCE_S)
    assert found.ok, found
    assert set(found.confirmed) == ROBOTS
    return found


def modes(session: ZenohSession, listener: Listener) -> dict[str, tuple[tuple[int, ...], str]]:
    return {robot.id: (robot.lives, robot.mode) for robot in look(session, listener).robots}


def truths(log: Path) -> list[tuple[Time, Any, Any]]:
    """(time, poses, speeds) of all robots as they really were."""
    return [
        (one.stamp_ns, unpack_floats(one.poses, 3), np.abs(unpack_floats(one.velocities, 2)[:, 0]))
        for _, one in read(log).decoded(Truth)
    ]


def assert_stood_within_braking_distance(log: Path) -> None:
    """From the first stop to the first release: u^2 / (2 brake) and what is driven until the drive reacts."""
    words = [(one.stamp_ns, one.stopped) for _, one in read(log).decoded(EmergencyStop)]
    stopped_at = next(at for at, stopped in words if stopped)
    armed_at = next(at for at, stopped in words if not stopped)
    moved = [one for one in truths(log) if stopped_at <= one[0] < armed_at]
    _, start, speeds = moved[0]
    assert speeds.min() > 0.15, "all of them were on the move"
    lag_s = PIONEER.theta[0] / PIONEER.theta[3]
    way = np.hypot(*(moved[-1][1][:, :2] - start[:, :2]).T)
    assert (way <= speeds**2 / (2.0 * PIONEER.brake_mps2) + speeds * (REACTION_S + lag_s)).all(), way
    settled = [one for one in moved if to_seconds(one[0] - stopped_at) > 3.0]
    assert settled
    assert all(speeds.max() < 0.01 for _, _, speeds in settled)


def test_everybody_stands_also_who_comes_later_until_armed_and_then_goes_on_to_the_end(
    tmp_path: Path,
) -> None:
    with running(tmp_path, write(tmp_path, FAST), "--speed", SPEED, "--keep-alive") as run:
        with connected(run) as session:
            listener = Listener(session)
            eventually(lambda: progress(session) > 4.0)
            ordered(session, STOP)
            assert not look(session, listener).ok
            os.kill(run.children()["r2"], signal.SIGKILL)
            eventually(lambda: modes(session, listener)["r2"] == ((2,), "emergency"))
            stood_at = progress(session)
            assert {mode for _, mode in modes(session, listener).values()} == {"emergency"}
            assert progress(session) == stood_at
            ordered(session, ARM)
            eventually(lambda: {mode for _, mode in modes(session, listener).values()} == {"tracking"})
        status, found, err = run.finish(120.0)
    assert (status, found["completed"], found["collisions"]) == (0, True, 0), (found, err)
    assert_stood_within_braking_distance(run.log)


def test_it_needs_neither_a_controller_nor_a_network_that_carries_anything_else(tmp_path: Path) -> None:
    with running(tmp_path, write(tmp_path, FAST), "--speed", SPEED) as run:
        with connected(run) as session:
            listener = Listener(session)
            eventually(lambda: progress(session) > 4.0)
            publish(session, topics.PLAN, FaultPlan(since_ns=0, faults=(Fault(loss=1.0),)), PATIENCE_S)
            ordered(session, STOP)
            assert {mode for _, mode in modes(session, listener).values()} == {"emergency"}
            eventually(lambda: any(link.injected for link in look(session, listener).links))
            ordered(session, ARM)
            publish(session, topics.PLAN, FaultPlan(since_ns=0), PATIENCE_S)
            eventually(lambda: {mode for _, mode in modes(session, listener).values()} == {"tracking"})
            os.kill(run.process.pid, signal.SIGSTOP)  # or it would end the run
            os.kill(run.children()["controller"], signal.SIGKILL)
            eventually(lambda: "controller" not in session.everyone())
            ordered(session, STOP)
            shown = look(session, listener)
            assert ("controller" in shown.nodes, shown.controlled, shown.ok) == (False, False, False)
            assert {robot.mode for robot in shown.robots} == {"emergency"}
        os.kill(run.process.pid, signal.SIGCONT)
        assert run.finish()[0] == 1
