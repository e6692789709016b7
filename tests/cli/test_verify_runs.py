"""Whole runs, virtual and real, are proved by their recordings."""

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import pytest
from msgspec.structs import replace

import maniple
from benchmarks.chaos.plan import chaos
from maniple.cli import realtime
from maniple.cli.loading import load
from maniple.cli.log.proving import Order, Verification, verify
from maniple.core.errors import RecordingError
from maniple.core.scenario.types import ClockError, Crash, Fault, Freeze, Partition, Scenario
from maniple.recording.compare import EXACT
from maniple.recording.reader import read
from tests.cli.scenes import ROOT, SMALL, start, write
from tests.cli.test_keep_alive import await_progress, kept_alive, kill
from tests.cli.test_realtime import await_state, running
from tests.host.recorded import flipped, rewrite
from tests.waiting import eventually, state

PAPER = ("paper-simulation-1", "paper-simulation-2", "paper-experiment-1", "paper-experiment-2")

FLUSH_S = 0.2
"""How often a journal is sent, wall time."""

SPEED = 2.0

NODES = ("simulator", "controller", "r1", "r2", "r3")
"""Of the small scene."""


def scene(name: str) -> Scenario:
    return load(ROOT / "scenarios" / f"{name}.toml")


def verified(log: Path, *nodes: str, jobs: int = 1) -> Verification:
    return verify(Order(log, EXACT, 10), nodes, jobs, lambda: False, lambda _: None)


def assert_proved(log: Path, *cut: tuple[str, int]) -> Verification:
    """All lives are identical, and only those that were `cut` have a tail that is unproved, of a flush."""
    found = verified(log, jobs=2)
    assert found.holds, (found.problems, [proof for proof in found.lives if not proof.holds])
    assert {proof.verdict for proof in found.lives} == {"identical"}
    tails = {(proof.node, proof.incarnation) for proof in found.lives if proof.ended == "cut"}
    assert tails == set(cut)
    for proof in found.lives:
        assert proof.messages > 0
        assert proof.unproved_s <= 2 * SPEED * FLUSH_S, "this machine is busy"
        assert proof.unproved == 0 or proof.ended == "cut"
    return found


def journals(log: Path) -> set[str]:
    """Whose journals are in a recording so far."""
    try:
        return {one.topic.split("/")[1] for one in read(log).messages() if one.topic.startswith("journal/")}
    except RecordingError:
        return set()


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """The router takes a free port, not the usual one."""
    monkeypatch.setattr(realtime, "DEFAULT_PORT", 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAPER)
def test_the_scenes_of_the_paper_in_virtual_time(tmp_path: Path, name: str) -> None:
    log = tmp_path / "run.mcap"
    maniple.run(scene(name), virtual=True, duration_s=30.0, log=log)
    found = assert_proved(log)
    assert sum(proof.unrecorded for proof in found.lives) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", PAPER)
@pytest.mark.usefixtures("apart")
def test_the_scenes_of_the_paper_as_real_processes(tmp_path: Path, name: str) -> None:
    log = tmp_path / "run.mcap"
    maniple.run(scene(name), speed=SPEED, duration_s=12.0, log=log)
    found = assert_proved(log)
    assert {one.source for one in found.others} == {"router"}


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_a_real_run_with_all_that_goes_wrong(tmp_path: Path) -> None:
    """And then a bit is flipped, and a gain is another."""
    scenario = replace(
        scene("chaos"),
        faults=(Fault(loss=0.3, latency_s=0.15, jitter_s=0.15, duplicate=0.1, reorder=0.1, corrupt=0.05),),
        crashes=(
            Crash(node="r2", at_s=6.0, restart_after_s=3.0),
            Crash(node="controller", at_s=10.0, restart_after_s=2.0),
            Crash(node="r6", at_s=14.0),
        ),
        freezes=(Freeze(node="r4", at_s=8.0, for_s=2.5),),
        partitions=(Partition(groups=(("r5", "r6"),), at_s=4.0, for_s=3.0),),
        clocks=(
            ClockError(node="r3", offset_s=120.0, skew_ppm=80.0),
            ClockError(node="controller", offset_s=-3.0),
            ClockError(node="simulator", offset_s=7.0, skew_ppm=-50.0),
        ),
    )
    log = tmp_path / "run.mcap"
    maniple.run(scenario, speed=SPEED, duration_s=20.0, log=log, keep_alive=True)
    found = assert_proved(log, ("r2", 1), ("controller", 1), ("r6", 1))
    lives = {(proof.node, proof.incarnation) for proof in found.lives}
    assert {("r2", 2), ("controller", 2)} <= lives
    assert ("r6", 2) not in lives

    bad = verified(rewrite(log, tmp_path / "bit.mcap", flipped("robot/r3/odometry", 100, -40)))
    assert not bad.holds
    assert {proof.node for proof in bad.lives if not proof.holds} <= {"r3", "controller"}

    kappa = scenario.controller.kappa
    assert isinstance(kappa, float)
    other = replace(scenario, controller=replace(scenario.controller, kappa=kappa * (1 + 1e-9)))
    bad = verified(rewrite(log, tmp_path / "gain.mcap", lambda record: (record,), other))
    verdicts = {proof.node: proof.verdict for proof in bad.lives if proof.incarnation == 1}
    assert (verdicts["controller"], verdicts["simulator"]) == ("diverges", "identical")
    first = next(proof.divergence for proof in bad.lives if proof.node == "controller")
    assert first is not None
    assert (first.topic.split("/")[-1], first.field[:6]) == ("command", "values")


@pytest.mark.slow
def test_a_real_run_that_is_meddled_with(tmp_path: Path) -> None:
    """By goals, an emergency stop, and by killing the agent, the controller and the router."""
    with kept_alive(tmp_path) as (run, states):

        def tell(*arguments: object) -> None:
            with start(*arguments, "--connect", run.option("--connect"), "--json") as process:
                out, err = process.communicate(timeout=60)
            assert process.returncode == 0, (out, err)

        tell("goal", "hold")
        await_state(states, lambda one: one.phase == "holding")
        tell("goal", "resume")
        tell("stop", "--reason", "test")
        tell("arm")
        for name in ("r1", "controller", "router"):
            kill(run, name)
            await_progress(states)
        run.process.send_signal(signal.SIGINT)
        status, _, err = run.finish()
    assert status == 130, err
    found = verified(run.log)
    verdicts = {(proof.node, proof.incarnation): proof for proof in found.lives}
    for proof in found.lives:  # without a router nothing reaches the recorder
        assert proof.holds or "the recording lacks " in proof.reason
    assert not any(proof.divergence for proof in found.lives)
    assert verdicts["r1", 1].holds
    assert verdicts["controller", 1].holds
    assert {"router"} < {one.source for one in found.others}


@pytest.mark.slow
def test_what_a_dead_recorder_missed_ends_the_proof(tmp_path: Path) -> None:
    with kept_alive(tmp_path) as (run, states):
        kill(run, "recorder")
        await_progress(states)
        eventually(lambda: journals(run.log.with_name("run-2.mcap")) >= set(NODES))
        run.process.send_signal(signal.SIGINT)
        status, said, err = run.finish()
    assert status == 130, err
    assert len(said["logs"]) == 2
    found = verified(run.log)
    assert not found.holds
    for proof in found.lives:
        assert proof.verdict == "unproved"
        assert proof.reason.startswith(f"the recording lacks journal/{proof.node} ")
        assert proof.messages > 20
        assert proof.unproved > 20
    alone = verified(Path(said["logs"][1]))
    assert not alone.holds
    assert {proof.messages for proof in alone.lives} == {0}


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(5), range(5, 10)], ids=str)
def test_random_plans_of_faults(tmp_path: Path, seeds: Iterable[int]) -> None:
    """`python -m benchmarks.chaos` has the same plans, and judges what the robots do."""
    for seed in seeds:
        log = tmp_path / f"{seed}.mcap"
        maniple.run(chaos(seed), virtual=True, duration_s=40.0, log=log)
        found = verified(log)
        assert found.holds, (seed, found.problems, [proof for proof in found.lives if not proof.holds])
        assert not any(proof.unrecorded or proof.differing for proof in found.lives), seed
        assert all(proof.unproved_s <= FLUSH_S for proof in found.lives), seed


@pytest.mark.slow
def test_a_process_that_was_stopped_and_goes_on(tmp_path: Path) -> None:
    with running(tmp_path, write(tmp_path, SMALL), "--speed", SPEED) as run:
        eventually(lambda: len(run.children()) == 7)
        eventually(lambda: run.log.exists() and run.log.stat().st_size > 100_000)
        pid = run.children()["r2"]
        os.kill(pid, signal.SIGSTOP)
        eventually(lambda: state(pid) == "T")
        os.kill(pid, signal.SIGCONT)
        run.process.send_signal(signal.SIGINT)
        run.finish()
    assert_proved(run.log)
    assert read(run.log).complete
