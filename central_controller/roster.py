"""Who is in the platoon, what each robot said last, and how long ago by the controller's own clock."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

from central_controller.frames import Mounting, propagated
from maniple.control.returns import Returns, returns_of
from maniple.core import topics
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Message, Odometry, RobotReport, Scan, Stamp, Status
from maniple.core.scenario.types import Robot
from maniple.core.time import Duration, Time, from_seconds, to_seconds

Presence: TypeAlias = Literal["absent", "present", "silent", "unlocalised"]
"""Not there; there and heard; there, as far as known, and not heard for too long; or living anew since the
task began, so that nobody knows where its odometry frame lies."""


class View(NamedTuple):
    """What the control law uses of one robot, at one moment."""

    heading: float
    """In the robot's own odometry frame, rad."""
    point: tuple[float, float]
    """Its control point in the formation frame, m."""
    age: Duration
    """Of its odometry."""
    answers: Stamp
    """That odometry."""


class Member:
    """One robot of the platoon and the last that was heard of it."""

    def __init__(self, robot: Robot) -> None:
        assert robot.pose is not None, "the scenario is resolved"
        self.id = robot.id
        self.mounting = Mounting(Pose(*robot.pose), robot.control_point_m)
        self.odometry: Odometry | None = None
        self.returns: Returns | None = None
        self.mode = ""
        self._odometry_at: Time = 0
        self._returns_at: Time = 0
        self._alive = False
        self._incarnation = -1
        self._located: int | None = None
        self._stale_after = from_seconds(topics.topic(topics.odometry(robot.id)).stale_after_s)

    def heard(self, message: Message, now: Time) -> None:
        """One of the robot's own messages arrived, or news of its life."""
        if isinstance(message, Odometry):
            if self._located in (None, message.incarnation):
                self.odometry = message
                self._odometry_at = now
        elif isinstance(message, Scan):
            self.returns = returns_of(message)
            self._returns_at = now
        elif isinstance(message, Status):
            self.mode = message.mode
        elif isinstance(message, Alive):
            self._life(message.node_incarnation, message.alive)

    def _life(self, incarnation: int, alive: bool) -> None:
        """Newer lives replace older ones, whose ends may be heard of late."""
        if incarnation >= self._incarnation:
            self._incarnation = incarnation
            self._alive = alive

    def locate(self) -> None:
        """From now on only the life whose odometry is known is believed: the initial pose in the scenario
        says where its frame lies, and where the frame of a later one lies nobody knows."""
        self._located = None if self.odometry is None else self.odometry.incarnation

    def odometry_age(self, now: Time) -> Duration | None:
        """Since its odometry arrived."""
        return None if self.odometry is None else now - self._odometry_at

    def returns_age(self, now: Time) -> Duration:
        """Since what it senses arrived; all of time where nothing has."""
        return now - self._returns_at

    def presence(self, now: Time) -> Presence:
        """Whether it is there, and heard."""
        if not self._alive:
            return "absent"
        if self._located not in (None, self._incarnation):
            return "unlocalised"
        age = self.odometry_age(now)
        return "silent" if age is None or age > self._stale_after else "present"

    def report(self, now: Time) -> RobotReport:
        """What `formation/state` says of it."""
        age = self.odometry_age(now)
        return RobotReport(
            id=self.id,
            state=self.presence(now),
            odometry_age_s=-1.0 if age is None else to_seconds(age),
            mode=self.mode,
        )

    def view(self, now: Time) -> View | None:
        """Where it is, its last odometry carried forward to `now` for no longer than that is worth anything;
        None before the first."""
        odometry = self.odometry
        if odometry is None:
            return None
        age = now - self._odometry_at
        own = propagated(odometry, to_seconds(min(age, self._stale_after)))
        answers = Stamp(odometry.incarnation, odometry.seq, odometry.stamp_ns)
        return View(own.psi, self.mounting.point(own), age, answers)


class Roster:
    """The platoon, in the order of the triangle chain."""

    def __init__(self, robots: Sequence[Robot]) -> None:
        self.members = tuple(Member(robot) for robot in robots)
        self.ids = tuple(member.id for member in self.members)

    def ready(self, now: Time, with_ranges: bool) -> bool:
        """Whether every robot is there and is heard: its odometry and, if asked, what it senses."""
        return all(
            member.presence(now) == "present" and (member.returns is not None or not with_ranges)
            for member in self.members
        )

    def locate(self) -> None:
        """The task begins: where every robot's odometry frame lies is known from here on."""
        for member in self.members:
            member.locate()

    def waited_for(self, now: Time) -> tuple[str, ...]:
        """The robots that do not follow now: not heard, or not tracking by their own account."""
        return tuple(
            member.id
            for member in self.members
            if member.presence(now) != "present" or member.mode != "tracking"
        )

    def views(self, now: Time) -> list[View] | None:
        """Every robot as the law sees it, or None while one has not been heard."""
        views = [member.view(now) for member in self.members]
        known = [view for view in views if view is not None]
        return known if len(known) == len(views) else None

    def reports(self, now: Time) -> tuple[RobotReport, ...]:
        """What is known of every robot."""
        return tuple(member.report(now) for member in self.members)
