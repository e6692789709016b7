"""One plan, run and judged: in virtual time without a recording, or as real processes from theirs."""

from pathlib import Path

import msgspec

import maniple
from benchmarks.chaos.judge import Judge, Verdict
from benchmarks.chaos.plan import chaos
from maniple.cli.nodes import factories
from maniple.core import codec
from maniple.core.envelope import Envelope
from maniple.core.messages import FormationState
from maniple.core.scenario.types import Parameters
from maniple.core.time import SECOND, Time
from maniple.host.virtual import VirtualHost
from maniple.recording.reader import read
from maniple.report.true_time import epoch_of

LIMIT_S = 150.0
"""Simulated time after which a run that has not ended has failed."""
RUNDOWN_S = 1.5


def virtual(seed: int) -> Verdict:
    """In virtual time."""
    scenario = chaos(seed)
    judge = Judge(scenario)

    def tap(envelope: Envelope, _: Time) -> None:
        if not judge.wants(envelope.topic):
            return
        message = codec.decode(envelope.topic, envelope.data)
        judge.add(envelope.topic, message)
        if isinstance(message, FormationState) and message.phase == "done":
            host.halt()

    makers = factories(scenario)
    host = VirtualHost([make(1) for make in makers.values()], scenario, tap, makers)
    host.start()
    host.run(host.now + round(LIMIT_S * SECOND))
    host.stop(["controller", *(robot.id for robot in scenario.robots)])
    host.run(host.now + round(RUNDOWN_S * SECOND))
    host.stop(["simulator"])
    return judge.verdict()


def realtime(seed: int, log: Path, speed: float) -> Verdict:
    """As real processes, killed and stopped by real signals."""
    scenario = chaos(seed)
    result = maniple.run(scenario, speed=speed, duration_s=LIMIT_S, log=log, keep_alive=True)
    recordings = [read(Path(part)) for part in result.logs]
    judge = Judge(scenario, epoch_of(recordings[0]))
    for recording in recordings:
        for entry in recording.messages(judge.wants):
            if entry.message is not None:
                judge.add(entry.topic, entry.message)
    return judge.verdict()


def describe(seed: int) -> str:
    """What the plan of a seed injects, a line each."""
    scenario = chaos(seed)
    parts = [*scenario.faults, *scenario.partitions, *scenario.crashes, *scenario.freezes]
    return "\n".join([f"robot_from = {scenario.placement.robot_from}", *map(_line, parts)])


def _line(part: Parameters) -> str:
    usual = {field.name: field.default for field in msgspec.structs.fields(part)}
    said = [f"{name}={value}" for name, value in msgspec.structs.asdict(part).items() if value != usual[name]]
    return f"{type(part).__name__.lower()}: {', '.join(said)}"
