"""Who is in the platoon, what each robot said last, and how old that is by the controller's own clock."""

import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

from central_controller.ages import RobotClock
from central_controller.frames import Mounting, propagated
from maniple.control.limits import Velocity, age_limits
from maniple.control.returns import Returns, returns_of
from maniple.core import edges, topics
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Message, Odometry, RobotReport, Scan, Seat, Stamp, Status
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import SECOND, Duration, Time, from_seconds, to_seconds

Presence: TypeAlias = Literal["absent", "present", "silent", "unlocalised"]
"""Not there; there and heard; there, as far as known, and what was heard is too old; or living anew without
knowing where its odometry frame lies."""

WORLD = Pose(0.0, 0.0, 0.0)

OUT_OF_CONTROL = ("fault", "stopped")
"""Modes of an agent that won't do what it is told."""

BACK_AFTER: Duration = SECOND
"""A lost robot is back once it has been fit for this long; twice as long each time it is lost again, ..."""

LONGEST_BACK: Duration = 16 * SECOND
"""... up to this, ..."""

FORGIVEN_AFTER: Duration = 60 * SECOND
"""... unless it was there for this long in between."""


_NUMBER = re.compile(r"(?<![\w.:/])(?<!system )(?<!component )[0-9]+(\.[0-9]+)?(?![\w:])")


class AgeLimits(NamedTuple):
    """How old the commands of a robot may be, s; see `maniple.control.limits.age_limits`."""

    hold_s: float = 0.0
    stop_s: float = 0.0


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
    """One robot of the platoon and the last that was heard of it.

    `limits` are what its commands may be old: what is computed from an odometry older than that moves nobody.
    `incarnation` is the life of the controller.
    """

    def __init__(
        self, robot: Robot, frame: Pose = WORLD, limits: AgeLimits | None = None, incarnation: int = 1
    ) -> None:
        self.id = robot.id
        self.pose = initial_pose(robot)
        """In the world, by the scenario."""
        self._own = Mounting(frame.inverse().compose(self.pose), robot.control_point_m)
        self._in_world = Mounting(frame.inverse(), robot.control_point_m)
        self.odometry: Odometry | None = None
        self.returns: Returns | None = None
        self.status: Status | None = None
        self.status_at: Time = 0
        self.mode = ""
        self.reason = ""
        """Why it is not tracking, by its own account."""
        self.lacks = ""
        """What it lacks of the pre-flight check, if it has to pass that before it is told where to go."""
        self.passed = 0
        """The last life of its agent that passed it."""
        self.held_back = False
        """Whether its guard, by its last status, kept it from doing what it could have done."""
        self.lost = False
        """Whether the others go on without it."""
        self._controller = incarnation
        self._clock = RobotClock(incarnation)
        self._odometry_at: Time = 0
        self._returns_at: Time = 0
        self._scan: Scan | None = None
        self._command_age_s = -1.0
        self._alive = False
        self._incarnation = 0
        self._located: int | None = None
        self._frame_id: str | None = None
        self._localised = True
        self._localised_from = (0, 0)
        self._fit_since: Time | None = None
        self._unfit_since: Time | None = None
        self._back_at: Time | None = None
        self._back_after = BACK_AFTER
        self._cause = ("", "")
        self._seen: tuple[Time, Duration | None, Presence] | None = None
        self._stale_after = from_seconds(topics.topic(topics.odometry(robot.id)).stale_after_s)
        self.limit(limits or AgeLimits())

    def limit(self, limits: AgeLimits) -> None:
        """How old its commands may be from here on."""
        self._seen = None
        self._limits = limits
        self._late_after = max(from_seconds(limits.hold_s), self._stale_after)
        self._silent_after = max(from_seconds(limits.stop_s), self._stale_after)

    @property
    def incarnation(self) -> int:
        """The last life of its agent that was heard of; 0 before the first."""
        return self._incarnation

    @property
    def mounting(self) -> Mounting:
        """Where the frame of its odometry lies: by the scenario, or where it says itself where it is."""
        odometry = self.odometry
        return self._in_world if odometry is not None and odometry.frame_id == edges.WORLD else self._own

    def heard(self, message: Message, now: Time) -> None:
        """One of the robot's own messages arrived, or news of its life."""
        self._seen = None
        if isinstance(message, Odometry):
            if self._believes(message):
                self._take(message, now)
        elif isinstance(message, Scan):
            self.returns = returns_of(message)
            self._scan, self._returns_at = message, now
        elif isinstance(message, Status):
            self.status, self.status_at = message, now
            self.mode, self.reason = message.mode, message.reason
            self.held_back = message.guard in ("age", "clearance", "blind", "fence")
            self._command_age_s = message.command_age_s
            self._hear_where(message)
        elif isinstance(message, Alive):
            self._life(message.node_incarnation, message.alive)

    def _life(self, incarnation: int, alive: bool) -> None:
        """Newer lives replace older ones, whose ends may be heard of late. A later one than the first has yet
        to say whether it knows where its frame lies."""
        if incarnation > self._incarnation:
            self._localised = incarnation in (1, self._located)
        if incarnation >= self._incarnation:
            self._incarnation = incarnation
            self._alive = alive

    def _hear_where(self, status: Status) -> None:
        """It says whether it knows where its frame lies. What it said before it did was in another frame."""
        if status.incarnation < self._incarnation:
            return
        if status.localised and self._located is not None:
            self._located = max(self._located, status.incarnation)
        elif status.localised and not self._localised:
            self._localised_from = status.incarnation, status.stamp_ns
            if self.odometry is not None and not self._believes(self.odometry):
                self.odometry = None
        self._localised = status.localised

    def _take(self, odometry: Odometry, now: Time) -> None:
        if self.odometry is None or self.odometry.incarnation != odometry.incarnation:
            self._clock = RobotClock(self._controller)
        self._clock.heard(odometry, now)
        self.odometry = odometry
        self._odometry_at = now

    def _believes(self, odometry: Odometry) -> bool:
        """Whether it is given in the frame that is known."""
        if self._located is None:
            return (odometry.incarnation, odometry.stamp_ns) >= self._localised_from
        return odometry.incarnation == self._located and self._frame_id in (None, odometry.frame_id)

    def free(self, now: Time) -> bool:
        """Whether what its odometry shows is what its drive made of what it was told."""
        age = self.odometry_age(now)
        return not self.held_back and age is not None and age <= self._stale_after

    def locate(self) -> None:
        """From now on a life is believed whose odometry frame is known: the present one, which began at the
        initial pose of the scenario, and a later one that says it has resumed that frame."""
        self._seen = None
        if self.odometry is not None:
            self._located, self._frame_id = self.odometry.incarnation, self.odometry.frame_id

    def seat(self, place: int) -> Seat:
        """What the next life of the controller has to know of it, whose place is `place`."""
        return Seat(self.id, place, self._located or 0, self._frame_id or "", self.lost, self.passed)

    def recall(self, seat: Seat) -> None:
        """Go on with what the life of the controller before this one knew."""
        self._seen = None
        self._located, self._frame_id = seat.incarnation or None, seat.frame_id or None
        self._localised = self._localised or self._incarnation == self._located
        self.lost, self.passed = seat.lost, seat.passed
        if self.odometry is not None and not self._believes(self.odometry):
            self.odometry = None

    def odometry_age(self, now: Time) -> Duration | None:
        """Since its odometry was sent."""
        return self._look(now)[1]

    def returns_age(self, now: Time) -> Duration:
        """Since what it senses was sent; all of time where nothing has come."""
        scan, odometry = self._scan, self.odometry
        if scan is None or odometry is None or scan.incarnation != odometry.incarnation:
            return now - self._returns_at
        return self._clock.age(scan.stamp_ns, now)

    def presence(self, now: Time) -> Presence:
        """Whether it is there, and heard."""
        return self._look(now)[2]

    def _look(self, now: Time) -> tuple[Time, Duration | None, Presence]:
        """The age of its odometry and its presence, once for each moment."""
        if self._seen is None or self._seen[0] != now:
            odometry = self.odometry
            age = None if odometry is None else self._clock.age(odometry.stamp_ns, now)
            self._seen = now, age, self._presence(age)
        return self._seen

    def _presence(self, age: Duration | None) -> Presence:
        if not self._alive:
            return "absent"
        if self._located not in (None, self._incarnation) or not self._localised:
            return "unlocalised"
        return "silent" if age is None or age > self._silent_after else "present"

    def fit(self, now: Time) -> bool:
        """Whether it can be told where to go: there, heard, in control of its drive, and passed as fit to
        move."""
        return self.presence(now) == "present" and self.mode not in OUT_OF_CONTROL and not self.lacks

    def review(self, lost_after: Duration, anybody_fit: bool, now: Time) -> bool:
        """Whether it has just been lost or come back. While nobody is fit nobody is lost: then it is the
        network that is gone. One that comes and goes has to stay ever longer to be taken in again."""
        before = self.lost
        if self.fit(now):
            self._unfit_since = None
            self._fit_since = now if self._fit_since is None else self._fit_since
            self.lost = before and now - self._fit_since < self._back_after
        else:
            self._fit_since = None
            if self._unfit_since is None or not anybody_fit:
                self._unfit_since = now
            self.lost = before or now - self._unfit_since >= lost_after
        if self.lost and not before:
            again = self._back_at is not None and now - self._back_at < FORGIVEN_AFTER
            self._back_after = min(2 * self._back_after, LONGEST_BACK) if again else BACK_AFTER
        elif before and not self.lost:
            self._back_at = now
        return self.lost != before

    def cause(self, now: Time) -> str:
        """Why the reference waits for it, with the figures of when that began; empty if it does not."""
        kind, text = self._hindrance(now)
        if kind != self._cause[0]:
            self._cause = kind, text
        return self._cause[1]

    def _hindrance(self, now: Time) -> tuple[str, str]:
        """What kind of reason there is to wait for it, and in words."""
        (_, age, presence), limits = self._look(now), self._limits
        if self.lacks:
            return f"lacks {without_figures(self.lacks)}", f"pre-flight check: {self.lacks}"
        if presence == "absent":
            return presence, "it is not there"
        if presence == "unlocalised":
            return presence, "it does not know where it is"
        if age is None:
            return "unheard", "it was not heard yet"
        if age > self._late_after:
            if now - self._odometry_at > self._late_after:
                return "silent", "it is not heard"
            return "late", f"its odometry is {to_seconds(age):.1f} s old, the limit {limits.hold_s:.2f} s"
        if self.mode in ("tracking", ""):
            return self.mode or "new", "" if self.mode else "it has not said how it is"
        if self.mode == "holding" and self._command_age_s > limits.hold_s > 0.0:
            return "old", f"the command is {self._command_age_s:.1f} s old, the limit {limits.hold_s:.2f} s"
        said = self.reason.startswith(self.mode)
        text = self.reason if said else f"{self.mode}{': ' * bool(self.reason)}{self.reason}"
        return without_figures(text), text

    def report(
        self,
        now: Time,
        compensation: tuple[float, ...] = (),
        memory: tuple[tuple[float, ...], ...] = (),
    ) -> RobotReport:
        """What `formation/state` says of it, and of its layers."""
        age, both_ways = self.odometry_age(now), self._clock.round_trip
        return RobotReport(
            id=self.id,
            state="lost" if self.lost else self.presence(now),
            odometry_age_s=-1.0 if age is None else to_seconds(age),
            mode=self.mode,
            compensation=compensation,
            incarnation=self._incarnation,
            reason=self.reason,
            round_trip_s=-1.0 if both_ways is None else to_seconds(both_ways),
            memory=memory,
        )

    def view(self, now: Time) -> View | None:
        """Where it is, its last odometry carried forward to `now` for no longer than that is worth anything;
        None before the first."""
        odometry, age = self.odometry, self.odometry_age(now)
        if odometry is None or age is None:
            return None
        own = propagated(odometry, to_seconds(min(age, self._silent_after)))
        answers = Stamp(odometry.incarnation, odometry.seq, odometry.stamp_ns)
        velocity = Velocity(odometry.u_mps, odometry.w_radps, odometry.v_mps)
        return View(own.psi, self.mounting.point(own), age, answers, velocity)


class Roster:
    """The platoon in the order of the scenario. With `host`, everything is given in the odometry frame of the
    robot of that name, else in the world's. `limits` and `incarnation` are as for a `Member`.

    `active` are those that are not lost.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        host: str | None = None,
        limits: Mapping[str, AgeLimits] | None = None,
        incarnation: int = 1,
    ) -> None:
        self.frame = next((initial_pose(robot) for robot in robots if robot.id == host), WORLD)
        """Of the platoon's frame in the world, m, m, rad."""
        limits = limits or {}
        self.members = tuple(Member(robot, self.frame, limits.get(robot.id), incarnation) for robot in robots)
        self.active = self.members

    def by_topic(self, with_ranges: bool) -> dict[str, Member]:
        """Which robot a topic is about, for every topic a robot may be heard on."""
        names = (topics.odometry, topics.status, *((topics.ranges,) if with_ranges else ()))
        return {name(member.id): member for member in self.members for name in names}

    def ready(self, now: Time, with_ranges: bool) -> bool:
        """Whether every robot that is not lost is there and is heard: its odometry and, if asked, what it
        senses."""
        return all(
            member.presence(now) == "present" and (member.returns is not None or not with_ranges)
            for member in self.active
        )

    def locate(self) -> None:
        """The task begins: where every robot's odometry frame lies is known from here on."""
        for member in self.members:
            member.locate()

    def recall(self, seats: Sequence[Seat]) -> None:
        """Go on with what the life of the controller before this one knew of every robot."""
        for member, seat in zip(self.members, seats, strict=True):
            member.recall(seat)
        self.active = tuple(member for member in self.members if not member.lost)

    def review(self, lost_after: Duration, now: Time) -> bool:
        """Whether a robot has just been lost or come back, so that the triangles need a new order."""
        anybody = any(member.fit(now) for member in self.members)
        changed = [member.review(lost_after, anybody, now) for member in self.members]
        if not any(changed):
            return False
        self.active = tuple(member for member in self.members if not member.lost)
        return True

    def waited_for(self, now: Time, lacking: bool = False) -> dict[str, str]:
        """The robots that do not follow now, and why: not passed as fit to move, not there, not heard or too
        late, or not tracking by their own account. With `lacking` only those that have not passed."""
        causes = {member.id: member.cause(now) for member in self.active if member.lacks or not lacking}
        return {name: cause for name, cause in causes.items() if cause}

    def kept_out(self) -> list[str]:
        """What each lost robot lacks of the pre-flight check, in a line."""
        return [
            f"{member.id} is lost: {member.lacks}" for member in self.members if member.lost and member.lacks
        ]


def bearable(scenario: Scenario) -> dict[str, AgeLimits]:
    """How old the commands of each robot of a resolved scenario may be."""
    return {robot.id: AgeLimits(*age_limits(scenario, robot)) for robot in scenario.robots}


def waiting_for(causes: Mapping[str, str]) -> str:
    """Whom the reference waits for, and why, in a line; empty for nobody. Of robots that are waited for for
    the same reason the first says it for all."""
    groups: dict[str, tuple[list[str], str]] = {}
    for name, cause in causes.items():
        groups.setdefault(without_figures(cause), ([], cause))[0].append(name)
    parts = [f"for {', '.join(names)}: {cause}" for names, cause in groups.values()]
    return f"waits {'; '.join(parts)}" if parts else ""


def without_figures(text: str) -> str:
    """A text without its numbers, but with names like r2, addresses and ids: the same for the same thing at
    another moment."""
    return _NUMBER.sub("", text)


def initial_pose(robot: Robot) -> Pose:
    """Of a robot of a resolved scenario: where its odometry frame lies in the world."""
    assert robot.pose is not None, "the scenario is resolved"
    return Pose(*robot.pose)
