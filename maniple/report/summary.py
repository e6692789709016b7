"""What a run amounts to, from its messages alone: the same for a live virtual run and for a recording.

Errors are ground truth against the desired formation; see `RunFigures`.
"""

from collections import defaultdict
from collections.abc import Iterable
from itertools import groupby, takewhile

import msgspec
import numpy as np

from maniple.core import topics
from maniple.core.edges import WORLD
from maniple.core.errors import MessageError
from maniple.core.geometry import Floats, wrap_array
from maniple.core.messages import (
    Decisions,
    FormationState,
    Journal,
    Message,
    Odometry,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, VIRTUAL_EPOCH, Time, to_seconds
from maniple.report.links import LinkCounts
from maniple.report.samples import Samples, Stamps
from maniple.report.true_time import TrueTime
from maniple.report.truth import Ground, drift, ground_of, stretches, without_truth

LAST: int = SECOND
"""Final errors are the mean of this long before the end, ns."""


_WANTED = (Truth, FormationState, Status, Odometry, Journal, Decisions)


OFF_M = 0.2
"""A platoon that is off by more at the end is told to be out of formation."""


class Errors(msgspec.Struct, frozen=True):
    """Formation errors: the largest over the triangles."""

    position_m: float | None = None
    """Of the centroid."""
    orientation_rad: float | None = None
    """psi_F."""
    distance_m: float | None = None
    """p and q, whichever is off more."""
    angle_rad: float | None = None
    """beta."""

    @property
    def out_of_formation_m(self) -> float:
        """The larger of the errors in metres where it is more than `OFF_M`, else 0; 0 where none is known."""
        worst = max(self.position_m or 0.0, self.distance_m or 0.0)
        return worst if worst > OFF_M else 0.0


class MessageCounts(msgspec.Struct, frozen=True):
    """Messages over links that faults apply to."""

    sent: int
    delivered: int
    lost_injected: int
    lost_other: int
    refused: int


class Percentiles(msgspec.Struct, frozen=True):
    """Of a sample; None where there is none."""

    p50: float | None
    p99: float | None


class RunFigures(msgspec.Struct, frozen=True):
    """The figures of a run that its messages tell.

    Errors count from when the formation is first built and the task runs, up to the end of the task.
    """

    duration_s: float
    """Time of the scenario from the first ground truth, or where there is none the controller's first word,
    to the end of the task, or of what was seen of it."""
    completed: bool
    """Whether the controller ended with the task done."""
    collisions: int | None
    """Onsets of contact; None where no ground truth tells."""
    min_clearance_m: float | None
    """Smallest distance from a robot's outline to anything, likewise."""
    final_error: Errors
    """Mean of the last second, over the triangles of which every robot has ground truth."""
    peak_error: Errors
    estimated_final_error: Errors
    """The final error as the controller sees it, over all triangles."""
    messages: MessageCounts
    command_age_ms: Percentiles
    lost_robots: list[str] = []
    """Robots that the controller ever gave up as lost."""
    odometry_drift_m: float | None = None
    """Largest distance, at the end, from where a control point of the chain is to where dead reckoning puts
    it: what the controller can't see of the true error."""
    without_truth: list[str] = []
    """Robots that no ground truth tells of: collisions, clearance and true errors are of the others."""


class Summary:
    """Takes messages in any order, gives the figures at the end; `epoch` is the start of the run."""

    def __init__(self, scenario: Scenario, epoch: Time = VIRTUAL_EPOCH) -> None:
        self._scenario = scenario
        self._true_time = TrueTime(scenario, epoch)
        self._truth: list[Truth] = []
        self._states: list[FormationState] = []
        self._odometry: defaultdict[str, Samples] = defaultdict(lambda: Samples(3))
        self._in_world: set[str] = set()
        self._lost: set[str] = set()
        self._ages: list[float] = []
        self._links = LinkCounts()

    def wants(self, topic: str) -> bool:
        """Whether messages of this topic matter."""
        try:
            return topics.topic(topic).type in _WANTED
        except MessageError:
            return False

    def add(self, message: Message) -> None:
        """Take a message into account."""
        message = self._true_time.of(message)
        match message:
            case Truth():
                self._truth.append(message)
            case FormationState():
                self._lost.update(robot.id for robot in message.roster if robot.state == "lost")
                self._states.append(msgspec.structs.replace(message, roster=()))
            case Odometry():
                if message.frame_id == WORLD:
                    self._in_world.add(message.source)
                self._odometry[message.source].add(
                    message.stamp_ns, (message.x_m, message.y_m, message.psi_rad)
                )
            case Status() if message.command_age_s >= 0:
                self._ages.append(1000 * message.command_age_s)
            case Journal():
                self._links.journal(message)
            case Decisions():
                self._links.decisions(message)

    def figures(self) -> RunFigures:
        """What the messages so far amount to."""
        truth = sorted(self._truth, key=lambda message: message.stamp_ns)
        states = sorted(self._states, key=lambda message: message.stamp_ns)
        last = truth[-1] if truth else None
        done_at = done_since(states)
        seen = [m.stamp_ns for m in states if m.phase != "waiting"]
        ends = (done_at, *seen[-1:], *(m.stamp_ns for m in (*truth[-1:], *states[-1:])), 0)
        end = next(moment for moment in ends if moment is not None)
        running = [m for m in under_way(states) if m.stamp_ns <= end]
        ground = ground_of([m for m in truth if m.stamp_ns <= end], self._scenario)
        stamps, errors = self._true_errors(ground, running)
        seen_at, estimated = _estimated_errors(running)
        clearances = [float(unpack_floats(m.clearances).min()) for m in truth if m.clearances]
        begin = next((m.stamp_ns for m in (*truth[:1], *states[:1])), end)
        return RunFigures(
            duration_s=round(to_seconds(end - begin), 6),
            completed=done_at is not None,
            collisions=last.collisions if last else None,
            min_clearance_m=min(clearances) if clearances else None,
            final_error=_final(stamps, errors, end),
            peak_error=_errors(errors.max(axis=0)) if len(errors) else Errors(),
            estimated_final_error=_final(seen_at, estimated, end),
            messages=MessageCounts(**self._links.totals()),
            command_age_ms=_percentiles(self._ages),
            lost_robots=[robot.id for robot in self._scenario.robots if robot.id in self._lost],
            odometry_drift_m=self._drift(ground, states, end),
            without_truth=without_truth(ground, self._scenario),
        )

    def _true_errors(self, ground: Ground, states: list[FormationState]) -> tuple[Stamps, Floats]:
        """Times of the ground truth while the task ran, and magnitudes of the errors then, shape (k, 4)."""
        parts = stretches(ground, states, self._scenario)
        stamps = [np.empty(0, dtype=np.int64), *(part.stamps for part in parts)]
        errors = [np.empty((0, 4)), *(magnitudes(part.errors) for part in parts)]
        return np.concatenate(stamps), np.concatenate(errors)

    def _drift(self, ground: Ground, states: list[FormationState], end: Time) -> float | None:
        chains = [m.chain for m in states if m.stamp_ns <= end]
        chain = chains[-1] if chains else [robot.id for robot in self._scenario.robots]
        odometry = {name: samples.arrays() for name, samples in self._odometry.items()}
        return drift(ground, odometry, chain, self._scenario, end, self._in_world)


def done_since(states: list[FormationState]) -> Time | None:
    """Since when the task has been done, of states in order; None where it is not at the end."""
    finished = list(takewhile(lambda state: state.phase == "done", reversed(states)))
    return finished[-1].stamp_ns if finished else None


def under_way(states: list[FormationState]) -> list[FormationState]:
    """The states from when the task first runs, of states in order."""
    starts = [index for index, state in enumerate(states) if state.phase in ("running", "done")]
    return [state for state in states[starts[0] :] if state.phase != "waiting"] if starts else []


def magnitudes(errors: Floats) -> Floats:
    """|errors| of triangles (k, m, 6) as the largest over the triangles of the four kinds (k, 4); triangles
    that are NaN are left out."""
    position = np.hypot(errors[..., 0], errors[..., 1])
    orientation = np.abs(wrap_array(errors[..., 2]))
    distance = np.abs(errors[..., 3:5]).max(axis=-1)
    angle = np.abs(wrap_array(errors[..., 5]))
    return np.asarray(np.fmax.reduce(np.stack([position, orientation, distance, angle], axis=-1), axis=1))


def _estimated_errors(states: Iterable[FormationState]) -> tuple[Stamps, Floats]:
    """Times and magnitudes (k, 4) of the errors as the controller sees them."""
    told = [state for state in states if state.errors]
    stamps = np.array([state.stamp_ns for state in told], dtype=np.int64)
    parts = [np.empty((0, 4))]
    for _, group in groupby(told, lambda state: len(state.errors)):
        parts.append(magnitudes(np.array([unpack_floats(state.errors, 6) for state in group])))
    return stamps, np.concatenate(parts)


def _final(stamps: Stamps, errors: Floats, end: Time) -> Errors:
    """The mean of the last second before the end."""
    late = stamps > end - LAST
    return _errors(errors[late].mean(axis=0)) if late.any() else Errors()


def _errors(values: Floats) -> Errors:
    return Errors(*(float(value) for value in values))


def _percentiles(sample: list[float]) -> Percentiles:
    if not sample:
        return Percentiles(None, None)
    p50, p99 = np.percentile(sample, [50, 99])
    return Percentiles(float(p50), float(p99))
