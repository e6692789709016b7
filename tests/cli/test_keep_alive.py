"""Runs whose processes die and freeze, by somebody's hand and by the fault plan, and come back."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

import maniple
from maniple.core import codec, topics
from maniple.core.errors import ArgumentError
from maniple.core.messages import FormationState
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import platoon, start, write
from tests.cli.test_realtime import AT_ONCE_S, LONG, Run, await_state, running
from tests.waiting import eventually, runs, state

SPEED = 2.0


@contextmanager
def kept_alive(
    folder: Path, text: str = LONG, *options: object
) -> Iterator[tuple[Run, SimpleQueue[FormationState]]]:
    """A run with --keep-alive that is under way, and what its controllers say."""
    states: SimpleQueue[FormationState] = SimpleQueue()

    def hear(topic: str, data: bytes) -> None:
        message = codec.decode(topic, data)
        assert isinstance(message, FormationState)
        states.put(message)

    with running(folder, write(folder, text), "--keep-alive", "--speed", SPEED, *options) as run:
        eventually(lambda: len(run.children()) == 7)
        with ZenohSession.client(run.option("--connect"), "maniple") as session:
            session.subscribe(topics.FORMATION_STATE, hear)
            await_state(states, lambda state: state.task_time_s > 2.0)
            yield run, states


def forgotten(states: SimpleQueue[FormationState]) -> None:
    """What was said up to now."""
    for _ in range(states.qsize()):
        states.get_nowait()


def await_progress(states: SimpleQueue[FormationState]) -> None:
    """From now on: the task goes on, for a while."""
    forgotten(states)
    first = await_state(states, lambda state: state.phase == "running" and not state.waits_for)
    await_state(states, lambda state: state.task_time_s > first.task_time_s + 1.0)


def kill(run: Run, name: str) -> None:
    """Kill a process, and wait until another takes its place."""
    pid = run.children()[name]
    os.kill(pid, signal.SIGKILL)
    eventually(lambda: run.children().get(name, pid) != pid)


def fault(run: Run, *arguments: object) -> dict[str, Any]:
    """What `maniple fault` says of a running platoon."""
    with start("fault", *arguments, "--connect", run.option("--connect"), "--json") as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    plan: dict[str, Any] = json.loads(out)
    return plan


@pytest.mark.slow
def test_whoever_dies_is_started_again_and_the_platoon_goes_on(tmp_path: Path) -> None:
    with kept_alive(tmp_path) as (run, states):
        planned = fault(run, "set", "--from", "r1", "--topic", "robot/*/ranges", "--loss", 0.5)
        for name in ("r1", "controller", "recorder", "router", "r1"):
            kill(run, name)
            await_progress(states)
        assert fault(run, "show")["rules"] == planned["rules"]
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
    assert status == 130, err
    assert found["restarts"] == {"r1": 2, "controller": 1, "recorder": 1, "router": 1}
    assert found["collisions"] == 0
    assert found["logs"] == [str(run.log), str(tmp_path / "run-2.mcap")]
    assert "r1 is started again (incarnation 2)" in err
    assert "r1 is started again (incarnation 3)" in err
    assert f"recorder is started again: {tmp_path / 'run-2.mcap'}" in err
    assert "Traceback" not in err
    assert [read(log).complete for log in found["logs"]] == [False, True]
    incarnations = {message.incarnation for _, message in read(found["logs"][1]).decoded(FormationState)}
    assert incarnations == {2}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["r1", "controller", "router", "recorder", "simulator"])
def test_who_freezes_is_told_of_and_not_replaced(tmp_path: Path, name: str) -> None:
    with kept_alive(tmp_path) as (run, states):
        pid = run.children()[name]
        os.kill(pid, signal.SIGSTOP)
        until = time.monotonic() + 4.0
        eventually(lambda: time.monotonic() > until)
        assert run.children()[name] == pid
        os.kill(pid, signal.SIGCONT)
        await_progress(states)
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
    assert status == 130, err
    assert f"{name} (process {pid}) is frozen\n" in err
    assert f"{name} (process {pid}) goes on\n" in err
    assert found["restarts"] == {}
    assert found["collisions"] == 0


@pytest.mark.slow
def test_the_death_of_the_simulator_ends_the_run(tmp_path: Path) -> None:
    with kept_alive(tmp_path) as (run, _):
        pid = run.children()["simulator"]
        os.kill(pid, signal.SIGKILL)
        status, found, err = run.finish()
    assert (status, found) == (1, {})
    expected = f"error: simulator (process {pid}) was killed by SIGKILL; a run can't go on without it\n"
    assert expected in err


@pytest.mark.slow
@pytest.mark.parametrize("victims", [("router",), ("recorder",), ("controller", "r1"), ("r1", "r2", "r3")])
def test_ctrl_c_with_dead_processes(tmp_path: Path, victims: tuple[str, ...]) -> None:
    with kept_alive(tmp_path) as (run, _):
        for name in victims:
            os.kill(run.children()[name], signal.SIGKILL)
        begin = time.monotonic()
        run.process.send_signal(signal.SIGINT)
        status, _, err = run.finish()
        assert time.monotonic() - begin < AT_ONCE_S
    assert status == 130, err
    assert "Traceback" not in err


FATED = (
    LONG
    + """
[[crashes]]
node = "r2"
at_s = 8.0
restart_after_s = 4.0
[[crashes]]
node = "controller"
at_s = 20.0
restart_after_s = 2.0
[[freezes]]
node = "r3"
at_s = 30.0
for_s = 3.0
[[crashes]]
node = "router"
at_s = 40.0
restart_after_s = 2.0
[[crashes]]
node = "recorder"
at_s = 50.0
restart_after_s = 2.0
"""
)


@pytest.mark.slow
def test_the_plan_kills_and_freezes_and_the_supervisor_brings_back(tmp_path: Path) -> None:
    """Without --keep-alive: what the plan brings back comes back."""
    with running(tmp_path, write(tmp_path, FATED), "--speed", SPEED, "--duration", 65) as run:
        eventually(lambda: len(run.children()) == 7)
        status, found, err = run.finish(120.0)
    assert status == 1, err
    assert found["collisions"] == 0
    assert found["restarts"] == {"r2": 1, "controller": 1, "router": 1, "recorder": 1}
    assert len(found["logs"]) == 2
    assert "was killed by SIGKILL, as the fault plan says; 2 robots go on, 1 will be back" in err
    assert "was killed by SIGKILL, as the fault plan says; back after 2 s" in err
    assert "r3 (process " in err
    assert ") is frozen" in err
    states = [message for _, message in read(found["logs"][1]).decoded(FormationState)]
    assert (states[-1].phase, states[-1].incarnation) == ("running", 2)
    assert states[-1].task_time_s > 30.0


@pytest.mark.slow
def test_live_crashes_and_freezes(tmp_path: Path) -> None:
    with kept_alive(tmp_path) as (run, states):
        pid = run.children()["r1"]
        assert [one["node"] for one in fault(run, "crash", "r1", "--restart-after", 3)["crashes"]] == ["r1"]
        assert [one["node"] for one in fault(run, "freeze", "controller", "--for", 3)["freezes"]] == [
            "controller"
        ]
        eventually(lambda: state(run.children().get("controller", 0)) == "T")
        eventually(lambda: not runs(pid))
        eventually(lambda: run.children().get("r1", pid) != pid)
        await_progress(states)
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
    assert status == 130, err
    assert found["restarts"] == {"r1": 1}
    assert "as the fault plan says" in err


@pytest.mark.slow
def test_who_is_taken_out_of_the_plan_lives_again(tmp_path: Path) -> None:
    text = LONG + '[[crashes]]\nnode = "r2"\nat_s = 6.0\nrestart_after_s = 600.0\n'
    with kept_alive(tmp_path, text) as (run, states):
        pid = run.children()["r2"]
        eventually(lambda: not runs(pid))
        assert fault(run, "clear", "--all")["crashes"] == []
        eventually(lambda: run.children().get("r2", pid) != pid)
        await_progress(states)
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
    assert status == 130, err
    assert found["restarts"] == {"r2": 1}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "command"), [("r2", ("agent", "r2")), ("controller", ("controller",))])
def test_one_that_was_replaced_while_it_was_frozen_steps_back(
    tmp_path: Path, name: str, command: tuple[str, ...]
) -> None:
    """The run goes on with who was started by hand, and does not start another."""
    with kept_alive(tmp_path) as (run, states):
        pid = run.children()[name]
        options = ("--scenario", tmp_path / "small.toml", "--connect", run.option("--connect"))
        os.kill(pid, signal.SIGSTOP)
        with ZenohSession.client(run.option("--connect"), "maniple") as session:
            eventually(lambda: not session.lives(name))
        with start(*command, *options) as guest:
            await_progress(states)
            os.kill(pid, signal.SIGCONT)
            eventually(lambda: not runs(pid))
            await_progress(states)
            assert name not in run.children()
            run.process.send_signal(signal.SIGINT)
            status, found, err = run.finish()
            guest.send_signal(signal.SIGTERM)
            guest.communicate(timeout=30)
    assert status == 130, err
    assert found["restarts"] == {}
    assert f"{name} is there twice (incarnation 2)" in err
    assert f"{name} (process {pid}) ended with status 1" in err


def test_there_is_nothing_to_keep_alive_in_virtual_time(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="keep alive: there are no processes in virtual time"):
        maniple.run(platoon(3), virtual=True, keep_alive=True, log=tmp_path / "a.mcap")
