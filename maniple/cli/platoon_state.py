"""How a running platoon is, as a value: from what was heard of it."""

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from maniple.cli.operator import Known
from maniple.core import topics
from maniple.core.messages import (
    EmergencyStop,
    FormationState,
    LinkReports,
    Message,
    RobotReport,
    Status,
)


class RobotState(msgspec.Struct, frozen=True):
    """One robot; what is not known is empty or -1."""

    id: str
    lives: tuple[int, ...]
    """The incarnations that are there."""
    state: str
    """As the controller sees it: present, silent, unlocalised, lost, absent."""
    mode: str
    guard: str
    command_age_s: float
    command_age_max_s: float
    driver: str
    localised: bool
    odometry_age_s: float
    """As the controller sees it."""
    round_trip_s: float
    reason: str
    """Why it is not tracking."""
    lacks: str = ""
    """What it lacks of the pre-flight check."""


class LinkState(msgspec.Struct, frozen=True):
    """What a receiver has counted of one sender's topic."""

    source: str
    destination: str
    topic: str
    received: int
    missing: int
    injected: int
    refused: int


class RecorderState(msgspec.Struct, frozen=True):
    """One recorder."""

    name: str
    """Its computer and process."""
    state: str
    """recording, paused, rolling or keeping."""
    reason: str
    """Why it is paused."""
    file: str
    """What it writes, or wrote last."""


class PlatoonState(msgspec.Struct, frozen=True):
    """What `--json` prints."""

    connect: str
    """Where it was asked."""
    ok: bool
    """Whether every robot of the roster is there, and may move."""
    nodes: dict[str, tuple[int, ...]]
    """The lives of everybody that is there."""
    phase: str
    """Empty where no controller has ever said anything."""
    controlled: bool
    """Whether the controller has just said so."""
    task_time_s: float
    task_duration_s: float
    waits_for: tuple[str, ...]
    reason: str
    """Why the platoon holds."""
    stopped: bool
    """Whether an emergency stop holds."""
    stop_reason: str
    faults: dict[str, Any]
    """What is injected, as `maniple fault show --json` has it."""
    robots: tuple[RobotState, ...]
    links: tuple[LinkState, ...]
    recorders: tuple[RecorderState, ...] = ()
    """Those that have answered."""


def state_of(
    connect: str,
    known: Known,
    heard: Mapping[str, Message],
    formation: FormationState | None,
    said: EmergencyStop | None,
    faults: dict[str, Any],
    recorders: tuple[RecorderState, ...] = (),
) -> PlatoonState:
    """The platoon from what was just heard, by topic, and from what is latched."""
    stopped = said is not None and said.stopped
    reports = {robot.id: robot for robot in formation.roster} if formation is not None else {}
    whole = bool(reports) and all(name in known.alive for name in reports)
    return PlatoonState(
        connect=connect,
        ok=whole and not stopped,
        nodes=dict(known.alive),
        phase="" if formation is None else formation.phase,
        controlled=topics.FORMATION_STATE in heard,
        task_time_s=0.0 if formation is None else formation.task_time_s,
        task_duration_s=0.0 if formation is None else formation.task_duration_s,
        waits_for=() if formation is None else formation.waits_for,
        reason="" if formation is None else formation.reason,
        stopped=stopped,
        stop_reason=said.reason if said is not None and said.stopped else "",
        faults=faults,
        robots=tuple(
            _robot(
                name, known.alive.get(name, ()), reports.get(name), heard.get(topics.status(name)), formation
            )
            for name in known.robots
        ),
        links=tuple(_links(heard)),
        recorders=recorders,
    )


def _robot(
    name: str,
    lives: tuple[int, ...],
    report: RobotReport | None,
    said: Message | None,
    formation: FormationState | None,
) -> RobotState:
    checks = () if formation is None else formation.preflight
    own = said if isinstance(said, Status) else None
    return RobotState(
        id=name,
        lives=lives,
        state="" if report is None else report.state,
        mode="" if own is None else own.mode,
        guard="" if own is None else own.guard,
        command_age_s=-1.0 if own is None else own.command_age_s,
        command_age_max_s=-1.0 if own is None else own.command_age_max_s,
        driver="" if own is None else own.driver,
        localised=own is None or own.localised,
        odometry_age_s=-1.0 if report is None else report.odometry_age_s,
        round_trip_s=-1.0 if report is None else report.round_trip_s,
        reason="" if own is None else own.reason,
        lacks="; ".join(one.why for one in checks if one.robot == name and one.holds is False),
    )


def _links(heard: Mapping[str, Message]) -> Iterator[LinkState]:
    for topic, message in sorted(heard.items()):
        if isinstance(message, LinkReports):
            node = topics.sender_of(topic)
            for link in message.links:
                yield LinkState(
                    link.source, node, link.topic, link.received, link.missing, link.injected, link.refused
                )
