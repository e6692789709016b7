"""Nodes run again on recorded inputs under other parameters: what they would have sent.

Open loop: whatever they send changes nothing of what they receive. It tells what a node would have done in
each situation that was recorded, not where that would have led.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from maniple.core.envelope import Envelope, Header
from maniple.core.errors import ArgumentError, MessageError
from maniple.core.messages import Command, Drive, FormationState, Status, unpack_floats
from maniple.core.node import Node, Outgoing, Received
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.host.reexecution import Inputs, LackingError, Life, lives, reexecute
from maniple.recording.reader import Recorded, Recording
from maniple.report.comparison import (
    ERRORS,
    Apart,
    FieldChange,
    Pair,
    apart,
    command_fields,
    scenario_changes,
)
from maniple.report.comparison_messages import MessageComparison, Side, TopicDifference
from maniple.report.comparison_tolerances import Tolerances, tolerances_of
from maniple.report.samples import Samples, Track, seconds
from maniple.report.summary import magnitudes
from maniple.report.true_time import TrueTime, epoch_of

Makers = Mapping[str, Callable[[int], Node]]
"""What makes each node, given its incarnation, by name."""

RECORDED = {
    "rates": "how often everybody is called is recorded",
    "network": "when each message arrived is recorded",
    "faults": "what the network did to each message is recorded",
    "partitions": "what the network did to each message is recorded",
    "crashes": "who died, and when, is recorded",
    "freezes": "who stood still, and when, is recorded",
    "clocks": "what the clock of each node showed is recorded",
    "seed": "what chance did is recorded",
    "placement": "the recorded commands are for the layers as they were placed",
    "preflight.enabled": "what the pre-flight check goes by is said only where there is one, and is recorded",
    "robots.*.driver": "who brought what each robot measured is recorded",
    "robots.*.scans": "who brought what each robot sensed is recorded",
    "robots.*.presents": "who brought what each robot measured is recorded",
}
"""Parts of a scenario that can't be others with the inputs as they were, `*` for any robot, and why."""

AT_LIMIT = 0.999
"""From this share of a limit on a command is said to be at it."""


class NodeRun(msgspec.Struct, frozen=True):
    """One life of a node that was run again."""

    node: str
    incarnation: int
    calls: int
    """That were made."""
    unproved: int
    """Messages that it sent after what could be run again."""
    problem: str = ""
    """Why it could not be run to its end, or where it failed; empty otherwise."""


class Effort(msgspec.Struct, frozen=True):
    """How often a robot was at its limits, as shares; None where nothing was said."""

    robot: str
    saturated_a: float | None
    saturated_b: float | None
    """Of what its drive was told: at the largest speed or turning rate of its model."""
    guarded_a: float | None
    guarded_b: float | None
    """Of its statuses: the guard changed what it was told."""


class OpenLoop(msgspec.Struct, frozen=True):
    """What nodes sent (A) and would have sent (B)."""

    recording: str
    identical: bool
    """Whether all that was run again sent the same bytes."""
    complete: bool
    """Whether every node could be run as far as its journal goes."""
    changes: tuple[FieldChange, ...]
    nodes: tuple[NodeRun, ...]
    series: tuple[Apart, ...]
    effort: tuple[Effort, ...]
    messages: tuple[TopicDifference, ...]
    pictures: tuple[str, ...] = ()


class Rerun(NamedTuple):
    """What came of it, with what pictures are drawn from."""

    found: OpenLoop
    pairs: tuple[Pair, ...]


def require_open_loop(changes: Iterable[FieldChange], recorded: Scenario, changed: Scenario) -> None:
    """Refuse changes that mean nothing for inputs that are recorded.

    Raises:
        ArgumentError: there is one; says why.
    """
    if [robot.id for robot in recorded.robots] != [robot.id for robot in changed.robots]:
        raise ArgumentError("robots: the recorded inputs are of those that were there; use --closed-loop")
    for change in changes:
        part = change.field.split(".")
        names = (part[0], change.field, ".".join([part[0], "*", *part[2:]]))
        if reason := next((RECORDED[name] for name in names if name in RECORDED), ""):
            raise ArgumentError(f"{change.field}: {reason}, and stays as it is; use --closed-loop")


def rerun(
    recording: Recording,
    scenario: Scenario,
    factories: Callable[[Scenario, str], Makers],
    nodes: Collection[str],
    tell: Callable[[str], None] = lambda _: None,
) -> Rerun:
    """Run the nodes of these names again with another scenario on what they received; `tell` is told which.

    `factories` makes them of a scenario, and of the digest that others know it by.

    Raises:
        ArgumentError: the scenario can't be another in this way, or a node has no journal.
        ScenarioError: a layer is not installed.
        RecordingError: the recording is damaged.
    """
    changes = scenario_changes(recording.scenario, scenario)
    require_open_loop(changes, recording.scenario, scenario)
    found = [life for life in lives(recording) if life.node in nodes]
    if unknown := sorted(set(nodes) - {life.node for life in found}):
        raise ArgumentError(f"{recording.path} holds no journal of {', '.join(unknown)}")
    known_as = short_digest(recording.scenario)  # in what they heard of each other
    before, makers = (factories(made, known_as) for made in (recording.scenario, scenario))
    sides = Sides(recording, scenario)
    runs = []
    for life in found:
        tell(f"{life.node} (life {life.incarnation})")
        was, node = (make[life.node](life.incarnation) for make in (before, makers))
        runs.append(_run(recording, life, InPlaceOf(was, node), sides))
    messages = sides.comparison.result()
    pairs = sides.pairs()
    return Rerun(
        OpenLoop(
            recording=str(recording.path),
            identical=all(topic.identical == topic.a == topic.b for topic in messages),
            complete=not any(run.problem for run in runs),
            changes=changes,
            nodes=tuple(runs),
            series=tuple(apart(pairs, Tolerances())),
            effort=sides.effort(),
            messages=messages,
        ),
        pairs,
    )


class InPlaceOf:
    """A node that is called as another was: what that one took in and this one does not, it does not hear.

    Raises:
        ArgumentError: it needs what the other was never given.
    """

    def __init__(self, was: Node, node: Node) -> None:
        self._node = node
        self.name = node.name
        self.subscriptions = was.subscriptions
        self.timers = was.timers
        if needed := sorted(node.subscriptions - was.subscriptions) or sorted(
            node.timers.keys() - was.timers.keys()
        ):
            raise ArgumentError(
                f"{node.name} would need {', '.join(needed)}, which it was not given in the recorded run; "
                "use --closed-loop"
            )

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        """As the node."""
        return self._node.on_start(now)

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        """As the node, of what it takes in."""
        return self._node.on_message(message, now) if message.topic in self._node.subscriptions else ()

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        """As the node, of timers that it has."""
        return self._node.on_timer(timer, now) if timer in self._node.timers else ()

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        """As the node."""
        return self._node.on_stop(now)


def _run(recording: Recording, life: Life, node: Node, sides: "Sides") -> NodeRun:
    """Run one life again, and show to both sides what it sent and sends."""
    own: list[tuple[Recorded, Header]] = []
    told: dict[str, int] = {}

    def see(record: Recorded, header: Header) -> None:
        if header.incarnation == life.incarnation:
            own.append((record, header))

    def release(everything: bool = False) -> None:
        """Compare what the journals so far say was sent."""
        later = []
        for record, header in own:
            if everything or header.seq < told.get(record.topic, 0):
                sides.add("A", record)
            else:
                later.append((record, header))
        own[:] = later

    inputs = Inputs(recording, life, node.subscriptions, see)
    calls, problem = 0, "" if life.begun else "its first journal is not recorded"
    try:
        for step in reexecute(life, node, inputs):
            calls = step.index + 1
            for envelope in step.sent:
                sides.add("B", _recorded(envelope))
            if step.raised:
                problem = problem or f"failed in call {step.index}: {step.raised}"
            if step.told:
                told |= step.told
                release()
    except LackingError as error:
        problem = f"could be run up to call {error.index}: {error}"
    problem = problem or life.broken
    inputs.drain()
    release(everything=life.ended == "stopped" and not problem)
    return NodeRun(life.node, life.incarnation, calls, len(own), problem)


def _recorded(envelope: Envelope) -> Recorded:
    return Recorded(envelope.topic, envelope.data, envelope.stamp_ns, envelope.stamp_ns, envelope.seq)


_IGNORED = ("robot/*/status:scenario",)
"""That another scenario is another one need not be told."""


class Sides:
    """What was sent and what would have been, message by message and over time."""

    def __init__(self, recording: Recording, scenario: Scenario) -> None:
        self._scenarios: dict[Side, Scenario] = {"A": recording.scenario, "B": scenario}
        self._start = recording.start_ns
        self._true_time = TrueTime(recording.scenario, epoch_of(recording))
        self.comparison = MessageComparison(tolerances_of((), _IGNORED), self._start)
        self._samples: defaultdict[tuple[str, Side], Samples] = defaultdict(lambda: Samples(2))
        self._errors: defaultdict[Side, Samples] = defaultdict(lambda: Samples(4))
        self._fields: dict[str, tuple[str, ...]] = {}
        self._guarded: defaultdict[tuple[str, Side], list[bool]] = defaultdict(list)

    def add(self, side: Side, record: Recorded) -> None:
        """Take a message of one of them."""
        self.comparison.add(side, record)
        try:
            message = self._true_time.of(record.decode())
        except MessageError:
            return
        match message:
            case Command():
                name = record.topic
                self._fields[name] = command_fields(message)
                self._samples[name, side].add(message.stamp_ns, message.values)
            case Drive(u_mps=u, w_radps=w):
                name = f"robot/{message.source}/drive"
                self._fields[name] = ("u_mps", "w_radps")
                self._samples[name, side].add(message.stamp_ns, (u, w))
            case FormationState(errors=errors) if errors:
                (row,) = magnitudes(unpack_floats(errors, 6)[None])
                self._errors[side].add(message.stamp_ns, tuple(row.tolist()))
            case Status():
                self._guarded[message.source, side].append(message.guard != "none")

    def pairs(self) -> tuple[Pair, ...]:
        """What both said over time, s since the recording begins."""
        found = [
            Pair(name, fields, *(self._track(self._samples[name, side]) for side in ("A", "B")))
            for name, fields in sorted(self._fields.items())
        ]
        errors = Pair("formation/estimate", ERRORS, *(self._track(self._errors[side]) for side in ("A", "B")))
        return (errors, *found) if len(errors.a.t) or len(errors.b.t) else tuple(found)

    def effort(self) -> tuple[Effort, ...]:
        """How often the robots were at their limits."""
        rows = []
        for robot in self._scenarios["A"].robots:
            shares = [self._saturated(robot.id, side) for side in ("A", "B")]
            guarded = [_share(self._guarded[robot.id, side]) for side in ("A", "B")]
            if any(share is not None for share in (*shares, *guarded)):
                rows.append(Effort(robot.id, *shares, *guarded))
        return tuple(rows)

    def _saturated(self, name: str, side: Side) -> float | None:
        scenario = self._scenarios[side]
        model = next(scenario.model_of(robot) for robot in scenario.robots if robot.id == name)
        _, values = self._samples[f"robot/{name}/drive", side].arrays()
        limits = AT_LIMIT * np.array([model.u_max_mps, model.w_max_radps])
        return _share([bool(row.any()) for row in np.abs(values) >= limits])

    def _track(self, samples: Samples) -> Track:
        stamps, values = samples.arrays()
        return Track(seconds(stamps, self._start), values)


def _share(said: Sequence[bool]) -> float | None:
    return sum(said) / len(said) if said else None
