"""What must hold in every run, found from its messages alone."""

from collections import defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from maniple.control.limits import Limits, limits_of
from maniple.core import topics
from maniple.core.messages import Call, Command, Drive, FormationState, Journal, Message
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND, VIRTUAL_EPOCH, Time, to_seconds
from maniple.report.summary import RunFigures, Summary

OFF_M = 0.10
"""A formation that is off by no more at the end has formed again."""

_WANTED = (Command, Drive, Journal)


class Verdict(NamedTuple):
    """What came of a run; good without `faults`."""

    figures: RunFigures
    faults: tuple[str, ...]


class Judge:
    """Takes the messages of a run of `scenario` that started at `epoch`, in any order."""

    def __init__(self, scenario: Scenario, epoch: Time = VIRTUAL_EPOCH) -> None:
        self._summary = Summary(scenario, epoch)
        self._limits = {robot.id: limits_of(scenario, robot) for robot in scenario.robots}
        self._drives: defaultdict[tuple[str, int], list[Drive]] = defaultdict(list)
        self._calls: defaultdict[tuple[str, int], list[Call]] = defaultdict(list)
        self._journaled: dict[tuple[str, int], Time] = {}
        self._commands: dict[tuple[str, int, int], Command] = {}
        self._last: FormationState | None = None

    def wants(self, topic: str) -> bool:
        """Whether messages of this topic matter."""
        return self._summary.wants(topic) or topics.topic(topic).type in _WANTED

    def add(self, topic: str, message: Message) -> None:
        """Take a message into account."""
        if self._summary.wants(topic):
            self._summary.add(message)
        match message:
            case FormationState():
                self._last = msgspec.structs.replace(message, errors=b"", points=b"")
            case Drive():
                self._drives[message.source, message.incarnation].append(message)
            case Command():
                self._commands[topic, message.incarnation, message.seq] = message
            case Journal():
                wanted = [
                    call for call in message.calls if call.kind == "message" and "/command" in call.name
                ]
                self._calls[message.source, message.incarnation].extend(wanted)
                self._journaled[message.source, message.incarnation] = message.stamp_ns

    def verdict(self) -> Verdict:
        """What the messages so far amount to."""
        figures = self._summary.figures()
        return Verdict(figures, (*self._ended(figures), *self._old_motion()))

    def _ended(self, figures: RunFigures) -> Iterable[str]:
        if figures.collisions:
            yield f"{figures.collisions} collisions"
        if not figures.completed:
            last = self._last
            at = "no word of the controller" if last is None else f"{last.phase} at {last.task_time_s:.1f} s"
            waits = "" if last is None or not last.waits_for else f", waits for {', '.join(last.waits_for)}"
            yield f"not completed: {at}{waits}"
        error = figures.final_error
        off = max(error.position_m or 0.0, error.distance_m or 0.0)
        if figures.completed and off > OFF_M:
            yield f"the formation is off by {off:.2f} m at the end"

    def _old_motion(self) -> Iterable[str]:
        """Drives that were told to move by what is older than the robot's limit, and not to brake. The last
        moments of a killed agent are not in its journal, and can't be told."""
        for (robot, life), drives in sorted(self._drives.items()):
            if robot not in self._limits:
                continue
            known = [drive for drive in drives if drive.stamp_ns <= self._journaled.get((robot, life), 0)]
            found = self._driven_by_old(robot, life, sorted(known, key=lambda drive: drive.seq))
            if found:
                yield f"{robot} (life {life}) moves on what is old: {found[0]} and {len(found) - 1} more"

    def _driven_by_old(self, robot: str, life: int, drives: list[Drive]) -> list[str]:
        limits = self._limits[robot]
        calls = sorted(self._calls[robot, life], key=lambda call: call.now_ns)
        found: list[str] = []
        held: tuple[Command, Time] | None = None
        before = Drive(u_mps=0.0, w_radps=0.0, active=True)
        at = 0
        for drive in drives:
            while at < len(calls) and calls[at].now_ns <= drive.stamp_ns:
                command = self._commands.get((calls[at].name, calls[at].incarnation, calls[at].seq))
                if command is not None and command.answers.incarnation == life:
                    held = command, calls[at].now_ns
                at += 1
            age_s = _age_s(held, drive.stamp_ns)
            if age_s >= limits.stop_s and not _brakes(limits, before, drive):
                now_s = to_seconds(drive.stamp_ns - drives[0].stamp_ns)
                found.append(f"u {drive.u_mps:.3f} m/s at {now_s:.2f} s on {age_s:.2f} s")
            before = drive
        return found


def _age_s(held: tuple[Command, Time] | None, now: Time) -> float:
    if held is None:
        return float("inf")
    command, arrived = held
    return to_seconds(max(now - command.answers.stamp_ns, now - arrived + command.inputs_age_ns))


def _brakes(limits: Limits, before: Drive, drive: Drive) -> bool:
    """Whether a drive is told to stand, or to get slower as fast as its limits let it."""
    dt_s = to_seconds(drive.stamp_ns - before.stamp_ns - MILLISECOND) if before.stamp_ns else 0.0
    u = max(abs(before.u_mps) - limits.brake * dt_s, 0.0)
    w = max(abs(before.w_radps) - limits.w_accel * dt_s, 0.0)
    return abs(drive.u_mps) <= u + 1e-6 and abs(drive.w_radps) <= w + 1e-6
