"""What a run amounts to, from its messages alone: the same for a live virtual run and for a recording.

Errors are ground truth against the desired formation; see `RunFigures`.
"""

import msgspec
import numpy as np

from central_controller.chain import Chain
from central_controller.reference import reference
from maniple.core import topics
from maniple.core.errors import MessageError
from maniple.core.geometry import Floats, wrap_array
from maniple.core.messages import (
    Decisions,
    FormationState,
    Journal,
    Message,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Time, to_seconds
from maniple.report.links import LinkCounts

LAST: int = SECOND
"""Final errors are the mean of this long before the end, ns."""


_WANTED = (Truth, FormationState, Status, Journal, Decisions)


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
    """The figures of a run that its messages tell."""

    duration_s: float
    """Simulated time from the first ground truth to the end of the task, or of what was seen of it."""
    completed: bool
    collisions: int
    min_clearance_m: float | None
    final_error: Errors
    peak_error: Errors
    estimated_final_error: Errors
    messages: MessageCounts
    command_age_ms: Percentiles


class Summary:
    """Takes messages in any order, gives the figures at the end."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._chain = Chain(scenario.formation.points)
        self._arms = np.array([robot.control_point_m for robot in scenario.robots])
        self._truth: list[Truth] = []
        self._states: list[FormationState] = []
        self._ages: list[float] = []
        self._links = LinkCounts()
        self.done_at: Time | None = None
        """When the controller said that the task is done, by its stamp; None before."""

    def wants(self, topic: str) -> bool:
        """Whether messages of this topic matter."""
        try:
            return topics.topic(topic).type in _WANTED
        except MessageError:
            return False

    def add(self, message: Message) -> None:
        """Take a message into account."""
        match message:
            case Truth():
                self._truth.append(message)
            case FormationState():
                self._states.append(message)
                if message.phase == "done" and (self.done_at is None or message.stamp_ns < self.done_at):
                    self.done_at = message.stamp_ns
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
        running = [m for m in states if m.phase != "waiting"]
        ends = (self.done_at, *(m.stamp_ns for m in (*running[-1:], *truth[-1:])), 0)
        end = next(moment for moment in ends if moment is not None)
        running = [m for m in running if m.stamp_ns <= end]
        during = [m for m in truth if m.stamp_ns <= end]
        stamps, errors = self._true_errors(during, running)
        seen_at = np.array([m.stamp_ns for m in running])
        seen = np.array([unpack_floats(m.errors, 6) for m in running])
        clearances = [float(unpack_floats(m.clearances).min()) for m in truth]
        return RunFigures(
            duration_s=round(to_seconds(end - truth[0].stamp_ns), 6) if truth else 0.0,
            completed=self.done_at is not None,
            collisions=last.collisions if last else 0,
            min_clearance_m=min(clearances) if clearances else None,
            final_error=_final(stamps, errors, end),
            peak_error=_errors(errors.max(axis=0)) if len(errors) else Errors(),
            estimated_final_error=_final(seen_at, _magnitudes(seen), end),
            messages=MessageCounts(**self._links.totals()),
            command_age_ms=_percentiles(self._ages),
        )

    def _true_errors(self, truth: list[Truth], states: list[FormationState]) -> tuple[Floats, Floats]:
        """Times of the ground truth while the task ran, and magnitudes of the errors then, shape (k, 4)."""
        truth = [m for m in truth if states and m.stamp_ns >= states[0].stamp_ns]
        if not truth:
            return np.empty(0), np.empty((0, 4))
        stamps = np.array([m.stamp_ns for m in truth])
        base = states[0].stamp_ns
        task_time = np.interp(
            (stamps - base).astype(float),
            [float(m.stamp_ns - base) for m in states],
            [m.task_time_s for m in states],
        )
        poses = np.array([unpack_floats(m.poses, 3) for m in truth])
        heading = np.stack([np.cos(poses[..., 2]), np.sin(poses[..., 2])], axis=-1)
        points = poses[..., :2] + self._arms[:, None] * heading
        actual = self._chain.triangles(points).variables()
        desired = np.array(
            [self._chain.desired(*reference(self._scenario.task, float(t))).q for t in task_time]
        )
        return stamps, _magnitudes(desired - actual)


def _magnitudes(errors: Floats) -> Floats:
    """|errors| of triangles (k, m, 6) as the largest over the triangles of the four kinds (k, 4)."""
    if not len(errors):
        return np.empty((0, 4))
    position = np.hypot(errors[..., 0], errors[..., 1])
    orientation = np.abs(wrap_array(errors[..., 2]))
    distance = np.abs(errors[..., 3:5]).max(axis=-1)
    angle = np.abs(wrap_array(errors[..., 5]))
    return np.asarray(np.stack([position, orientation, distance, angle], axis=-1).max(axis=1))


def _final(stamps: Floats, errors: Floats, end: Time) -> Errors:
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
