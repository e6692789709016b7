"""Random plans of faults: no collision, no motion on what is old, the formation forms again, nobody fails."""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from benchmarks.chaos.judge import Judge
from benchmarks.chaos.plan import HEALED_S, chaos
from benchmarks.chaos.runs import realtime, virtual
from maniple.core import topics
from maniple.core.messages import Call, Command, Drive, Journal, Stamp
from maniple.core.scenario.check import require_valid
from maniple.core.time import SECOND

PLANS = range(500)
REALTIME = range(1000, 1030)
SPEED = 2.0


def failures(seeds: range, work: int) -> list[str]:
    """What does not hold in virtual time, with the command that shows it."""
    context = get_context("spawn")
    with ProcessPoolExecutor(work, mp_context=context) as pool:
        verdicts = pool.map(faults_of, seeds, chunksize=5)
        return [
            f"{'; '.join(faults)}: python -m benchmarks.chaos {seed}"
            for seed, faults in zip(seeds, verdicts, strict=True)
            if faults
        ]


def faults_of(seed: int) -> tuple[str, ...]:
    """Of one seed; an exception of a node is one of them."""
    try:
        return virtual(seed).faults
    except Exception as error:  # noqa: BLE001 - it is what is looked for
        return (f"{type(error).__name__}: {error}",)


@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 4))])
def test_a_platoon_survives_a_few_plans(seed: int) -> None:
    assert faults_of(seed) == ()


@pytest.mark.slow
def test_a_platoon_survives_five_hundred_plans() -> None:
    found = failures(PLANS, os.cpu_count() or 1)
    assert not found, "\n".join(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", REALTIME)
def test_real_processes_survive_killed_and_stopped_by_signals(seed: int, tmp_path: Path) -> None:
    _, faults = realtime(seed, tmp_path / "chaos.mcap", SPEED)
    assert faults == (), f"python -m benchmarks.chaos {seed} --realtime"


def test_every_plan_is_valid_heals_in_time_and_is_its_own() -> None:
    plans = [chaos(seed) for seed in range(100)]
    for plan in plans:
        require_valid(plan)
        ends = [end for fault in plan.faults for _, end in fault.windows]
        ends += [cut.at_s + (cut.for_s or 1e9) for cut in plan.partitions]
        ends += [crash.at_s + (crash.restart_after_s or 1e9) for crash in plan.crashes]
        ends += [freeze.at_s + freeze.for_s for freeze in plan.freezes]
        assert max(ends) <= HEALED_S + 0.02
    assert len({str(plan.faults) for plan in plans}) == len(plans)
    assert chaos(7) == chaos(7)
    kinds = Counter(type(part).__name__ for plan in plans for part in (*plan.crashes, *plan.freezes))
    assert kinds["Crash"] > 30
    assert kinds["Freeze"] > 30


@pytest.mark.parametrize(
    ("u_mps", "told"),
    [([0.2, 0.2, 0.2], True), ([0.2, 0.14, 0.08], False), ([0.0, 0.0, 0.0], False), ([0.0, 0.0, 0.1], True)],
)
def test_motion_on_a_command_that_is_too_old_is_found_and_braking_is_not(
    u_mps: list[float], told: bool
) -> None:
    judge = Judge(chaos(0))
    name = topics.command("r1")
    judge.add(
        name,
        Command(
            layer="kinematics",
            values=(0.0, 0.0),
            answers=Stamp(1, 0, SECOND),
            inputs_age_ns=0,
            source="controller",
            incarnation=1,
        ),
    )
    call = Call("message", 2 * SECOND, name, "controller", 1, 0)
    judge.add(topics.journal("r1"), Journal(calls=(call,), source="r1", incarnation=1, stamp_ns=9 * SECOND))
    for k, u in enumerate(u_mps):
        stamp = 6 * SECOND + k * SECOND // 10  # the first 5 s after what it answers: the limit is 5.03 s
        drive = Drive(u_mps=u, w_radps=0.0, active=True, source="r1", incarnation=1, seq=k, stamp_ns=stamp)
        judge.add(topics.drive("r1"), drive)
    assert any("moves on what is old" in fault for fault in judge.verdict().faults) == told
