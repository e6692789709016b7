"""How far along its task the platoon is, and what the reference is there."""

from msgspec.structs import replace

from central_controller.reference import REST, Course, Reference, reached
from maniple.core.geometry import Floats, Pose, wrap
from maniple.core.messages import Progress
from maniple.core.scenario.places import legs_of, start_pose
from maniple.core.scenario.types import Controller, Positioning, Samples, Sequence, Task
from maniple.core.time import Duration, from_seconds, to_seconds

NEAR_M, NEAR_RAD = 0.01, 0.01
"""A task that starts this near to where the reference is needs no way there."""


class Mission:
    """The legs of a task, one after the other."""

    def __init__(self, task: Task, controller: Controller) -> None:
        self.task = task
        self.course = Course(task, controller)
        self.leg = 0
        self.ended = False
        self._time: Duration = 0
        self._within: Duration = 0

    @property
    def time_s(self) -> float:
        """Task time: how far along all its legs."""
        before_s = sum(self.course.duration_s(leg) for leg in range(self.leg))
        return before_s + min(to_seconds(self._time), self.course.duration_s(self.leg))

    @property
    def progress(self) -> Progress:
        """What another one of the same task has to `recall` to go on from here."""
        return Progress(self.leg, self._time, self._within)

    def recall(self, progress: Progress, ended: bool) -> None:
        """Go on from there."""
        self.leg = min(max(progress.leg, 0), self.course.legs - 1)
        self._time, self._within, self.ended = max(progress.leg_ns, 0), max(progress.settled_ns, 0), ended

    def advance(self, elapsed: Duration, rate: float, errors: Floats | None) -> None:
        """Go on for `elapsed` at `rate` times the planned pace. A leg of positioning ends by the `errors` of
        the triangles, (m, 6), or None where they are not known."""
        if self.ended:
            return
        self._time += round(elapsed * rate)
        place = self.course.positioning(self.leg)
        if place is None:
            lasts = from_seconds(self.course.duration_s(self.leg))
            over = self._time >= lasts
            self._time = min(self._time, lasts)
        else:
            there = errors is not None and reached(place, errors)
            self._within = self._within + elapsed if there else 0
            over = there and self._within >= from_seconds(place.settle_s)
        if over and self.leg + 1 < self.course.legs:
            self.leg, self._time, self._within = self.leg + 1, 0, 0
        elif over:
            self.ended = True

    def reference(self, rate: float) -> Reference:
        """Where the desired formation's frame is in the world, moving at `rate` times the planned pace."""
        pose, velocity = self.course.at(self.leg, to_seconds(self._time))
        if rate == 1.0:
            return Reference(pose, velocity)
        vx, vy, turning = velocity
        return Reference(pose, (rate * vx, rate * vy, rate * turning) if rate else REST)


def from_here(task: Task, here: Pose, speed_mps: float, reach_m: float) -> Task:
    """The same task with a straight way to its start before it, from the reference at `here`, on which no
    place of the formation, at most `reach_m` from its origin, is faster than about `speed_mps`. A formation
    that only has to be somewhere goes there by itself."""
    legs = legs_of(task)
    if isinstance(legs[0], Positioning):
        return replace(task, start=tuple(here)) if isinstance(task, Positioning) else task
    start = start_pose(task)
    way = ((start.x - here.x) ** 2 + (start.y - here.y) ** 2) ** 0.5
    turn = wrap(start.psi - here.psi)
    if way < NEAR_M and abs(turn) < NEAR_RAD:
        return task
    lasts_s = max((way + abs(turn) * reach_m) / speed_mps, 1.0)
    end = (start.x, start.y, here.psi + turn)
    return Sequence(tasks=(Samples(times_s=(0.0, lasts_s), poses=((here.x, here.y, here.psi), end)), *legs))
