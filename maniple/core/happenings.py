"""What messages tell that happens, in words for people."""

from collections.abc import Iterator
from typing import Literal, NamedTuple, TypeAlias

from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Goal
from maniple.core.plans import numbered

Weight: TypeAlias = Literal["info", "warning", "error"]

_ROBOT_WEIGHTS: dict[str, Weight] = {"present": "info", "lost": "error"}


class Happening(NamedTuple):
    """Something that happened, and how much it matters."""

    what: str
    weight: Weight = "info"


def changes(before: FormationState | None, now: FormationState) -> Iterator[Happening]:
    """What is new in a state; all of it where there is none before. Of a wait it is told why it began, not
    who joins in and who leaves."""
    if before is None or now.phase != before.phase:
        weight: Weight = "warning" if now.phase == "holding" else "info"
        yield Happening(f"{now.phase}{': ' * bool(now.reason)}{now.reason}", weight)
    elif now.reason and now.reason != before.reason and not (now.waits_for and before.waits_for):
        yield Happening(now.reason, "warning")
    if before is None:
        return
    if now.incarnation != before.incarnation:
        yield Happening("the controller lives anew", "warning")
    if now.leg != before.leg:
        yield Happening(f"part {now.leg + 1} of the task")
    if now.chain != before.chain:
        yield Happening(f"chain {' '.join(now.chain) or 'of nobody'}")
    if now.goal != before.goal and now.goal:
        if now.goal_refused:
            yield Happening(f"goal refused: {now.goal_refused}", "warning")
        else:
            yield Happening("goal accepted")
    known = {} if before.phase == "waiting" else {robot.id: robot.state for robot in before.roster}
    for robot in now.roster:
        if known.get(robot.id, robot.state) != robot.state:
            yield Happening(f"{robot.id} {robot.state}", _ROBOT_WEIGHTS.get(robot.state, "warning"))
    yield from (Happening(f"supervisor: {note}") for note in now.supervisor if note not in before.supervisor)


def wish(goal: Goal) -> Happening:
    """What an operator wants, in few words."""
    words = []
    if goal.task is not None:
        words.append(f"task {goal.task.__struct_config__.tag}")
    if goal.formation is not None:
        words.append("another shape")
    if goal.hold is not None:
        words.append("hold" if goal.hold else "resume")
    return Happening(f"goal: {', '.join(words) or 'nothing'}")


def stop(said: EmergencyStop) -> Happening:
    """An emergency stop, or its release."""
    if not said.stopped:
        return Happening("armed")
    return Happening(f"emergency stop{f': {said.reason}' if said.reason else ''}", "error")


def contact(who: str) -> Happening:
    """A contact, of those that the ground truth lists."""
    return Happening(f"contact: {who.replace('|', ' and ')}", "error")


def planned(plan: FaultPlan) -> Iterator[tuple[float, str]]:
    """When each part of a plan begins, in s since its start, and what it is."""
    for number, rule in numbered(plan).items():
        link = f"fault rule {number}, from {rule.source} to {rule.destination}, topic {rule.topic}"
        for start, end in rule.windows:
            yield start, f"{link}, for {end - start:g} s"
        if not rule.windows:
            yield 0.0, link
    for one in plan.partitions:
        groups = " | ".join(",".join(group) for group in one.groups)
        yield one.at_s, f"partition {groups} | all others{_lasting(one.for_s)}"
    for crash in plan.crashes:
        back = "" if crash.restart_after_s is None else f", back after {crash.restart_after_s:g} s"
        yield crash.at_s, f"{crash.node} is killed{back}"
    for freeze in plan.freezes:
        yield freeze.at_s, f"{freeze.node} is frozen{_lasting(freeze.for_s)}"


def _lasting(for_s: float | None) -> str:
    return "" if for_s is None else f" for {for_s:g} s"
