"""Who is in the platoon, what each robot said last, and how long ago by the controller's own clock."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

from central_controller.frames import Mounting, propagated
from maniple.control.limits import Velocity
from maniple.control.returns import Returns, returns_of
from maniple.core import topics
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Message, Odometry, RobotReport, Scan, Stamp, Status
from maniple.core.scenario.types import Robot
from maniple.core.time import Duration, Time, from_seconds, to_seconds

Presence: TypeAlias = Literal["absent", "present", "silent", "unlocalised"]
"""Not there; there and heard; there, as far as known, and not heard for too long; or living anew without
knowing where its odometry frame lies."""

WORLD = Pose(0.0, 0.0, 0.0)

OUT_OF_CONTROL = ("fault", "stopped")
"""Modes of an agent that won't do what it is told."""


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
    velocity: Velocity
    """By that odometry."""


class Member:
    """One robot of the platoon and the last that was heard of it."""

    def __init__(self, robot: Robot, frame: Pose = WORLD) -> None:
        self.id = robot.id
        self.mounting = Mounting(frame.inverse().compose(initial_pose(robot)), robot.control_point_m)
        self.odometry: Odometry | None = None
        self.returns: Returns | None = None
        self.mode = ""
        self.held_back = False
        """Whether its guard, by its last status, kept it from doing what it could have done."""
        self.lost = False
        """Whether the others go on without it."""
        self._odometry_at: Time = 0
        self._returns_at: Time = 0
        self._alive = False
        self._incarnation = -1
        self._located: int | None = None
        self._localised = True
        self._unfit_since: Time | None = None
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
            self.held_back = message.guard in ("age", "clearance", "blind")
            self._localised = message.localised
            if self._located is not None and message.localised:
                self._located = max(self._located, message.incarnation)
        elif isinstance(message, Alive):
            self._life(message.node_incarnation, message.alive)

    def _life(self, incarnation: int, alive: bool) -> None:
        """Newer lives replace older ones, whose ends may be heard of late."""
        if incarnation >= self._incarnation:
            self._incarnation = incarnation
            self._alive = alive

    def locate(self) -> None:
        """From now on a life is believed whose odometry frame is known: the present one, which began at the
        initial pose of the scenario, and a later one that says it has resumed that frame."""
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
        if self._located not in (None, self._incarnation) or not self._localised:
            return "unlocalised"
        age = self.odometry_age(now)
        return "silent" if age is None or age > self._stale_after else "present"

    def fit(self, now: Time) -> bool:
        """Whether it can be told where to go: there, heard, and in control of its drive."""
        return self.presence(now) == "present" and self.mode not in OUT_OF_CONTROL

    def review(self, lost_after: Duration, anybody_fit: bool, now: Time) -> bool:
        """Whether it has just been lost or come back. While nobody is fit nobody is lost: then it is the
        network that is gone."""
        if self.fit(now):
            self._unfit_since = None
        elif self._unfit_since is None or not anybody_fit:
            self._unfit_since = now
        unfit = self._unfit_since
        lost = unfit is not None and (self.lost or now - unfit >= lost_after)
        lost, self.lost = self.lost, lost
        return lost != self.lost

    def report(self, now: Time, compensation: tuple[float, ...] = ()) -> RobotReport:
        """What `formation/state` says of it."""
        age = self.odometry_age(now)
        return RobotReport(
            id=self.id,
            state="lost" if self.lost else self.presence(now),
            odometry_age_s=-1.0 if age is None else to_seconds(age),
            mode=self.mode,
            compensation=compensation,
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
        velocity = Velocity(odometry.u_mps, odometry.w_radps, odometry.v_mps)
        return View(own.psi, self.mounting.point(own), age, answers, velocity)


class Roster:
    """The platoon in the order of the scenario. With `host`, everything is given in the odometry frame of the
    robot of that name, else in the world's.

    `active` are those that are not lost.
    """

    def __init__(self, robots: Sequence[Robot], host: str | None = None) -> None:
        self.frame = next((initial_pose(robot) for robot in robots if robot.id == host), WORLD)
        """Of the platoon's frame in the world, m, m, rad."""
        self.members = tuple(Member(robot, self.frame) for robot in robots)
        self.active = self.members

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

    def review(self, lost_after: Duration, now: Time) -> bool:
        """Whether a robot has just been lost or come back, so that the triangles need a new order."""
        anybody = any(member.fit(now) for member in self.members)
        changed = [member.review(lost_after, anybody, now) for member in self.members]
        if not any(changed):
            return False
        self.active = tuple(member for member in self.members if not member.lost)
        return True

    def waited_for(self, now: Time) -> tuple[str, ...]:
        """The robots that do not follow now: not heard, or not tracking by their own account."""
        return tuple(
            member.id
            for member in self.active
            if member.presence(now) != "present" or member.mode != "tracking"
        )


def initial_pose(robot: Robot) -> Pose:
    """Of a robot of a resolved scenario: where its odometry frame lies in the world."""
    assert robot.pose is not None, "the scenario is resolved"
    return Pose(*robot.pose)
