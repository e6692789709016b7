"""What has to hold of every robot before the platoon moves."""

import math
from collections.abc import Iterator, Sequence

from central_controller.roster import OUT_OF_CONTROL, Member
from maniple.core import edges, topics
from maniple.core.geometry import Pose, wrap
from maniple.core.messages import Check, Status
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.places import fastest_place_mps
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, from_seconds

THERE, HEARD, SCENARIO, CONTROLLABLE = "there", "heard", "scenario", "controllable"
LOCALISED, START, RANGES, LIMITS = "localised", "start pose", "ranges", "limits"
RELEASED, TESTED = "stop released", "stop tested"

ITEMS = (
    THERE,
    HEARD,
    SCENARIO,
    CONTROLLABLE,
    LOCALISED,
    START,
    RANGES,
    LIMITS,
    RELEASED,
    TESTED,
)
"""What is looked at, in this order: its agent lives; it says how it is; it runs the controller's scenario;
its drive is active and lets itself be controlled; it knows where it is, and is heard to; that is near its
pose in the scenario; it has the ranges that its layers and its guard go by; it can do what the task asks; no
emergency stop stands; it has stood by one, and was armed again."""

_OF_THE_DRIVE = (LOCALISED, START, RANGES, TESTED)
"""What may hold by itself once the drive is under control."""

UNTESTED = "its emergency stop was not tested: "

_STALE_PERIODS = 2.5
"""A robot that has not said how it is twice says nothing about now."""


class Preflight:
    """The pre-flight check of a platoon whose scenario asks for one; of others it finds nothing.

    Until it is accepted all lines have to hold at once, for everybody. After that a robot that was lost, or
    whose agent lives anew, has to pass its own before it is told where to go again; where it starts is not
    looked at any more. An agent that lives anew has not stood by an emergency stop yet, so that is tested
    again too.

    With `ranges` the controller itself goes by what the robots sense. `digest` is what the robots know the
    scenario by, its own by default.
    """

    def __init__(self, scenario: Scenario, members: Sequence[Member], ranges: bool, digest: str = "") -> None:
        self._asked = scenario.preflight
        self._members = members if edges.preflight_asked(scenario) else ()
        self._ranges = ranges
        self._digest = (digest or short_digest(scenario)) if self._members else ""
        self._status_stale = max(
            from_seconds(topics.topic(topics.status("x")).stale_after_s),
            from_seconds(_STALE_PERIODS / scenario.rates.status_hz),
        )
        self._ranges_stale = max(
            from_seconds(topics.topic(topics.ranges("x")).stale_after_s),
            from_seconds(_STALE_PERIODS / scenario.rates.scan_hz),
        )
        self.checks: tuple[Check, ...] = ()
        """What was found: every line of the robots that had to be looked at."""

    def review(self, scenario: Scenario, now: Time, *, begun: bool, anywhere: bool = False) -> bool:
        """Look at every robot that has to pass: all of them until the platoon has `begun`. Whether all do.

        `scenario` has the task as it is now. Where the robots go on from wherever they are (`anywhere`) it
        does not matter where that is.
        """
        found: list[Check] = []
        needed_mps = _needed_mps(scenario) if self._members else 0.0
        for member in self._members:
            member.lacks = ""
            if begun and not member.lost and member.passed == member.incarnation:
                continue
            lines = tuple(self._lines(member, needed_mps, anywhere or begun, begun, now))
            member.lacks = "; ".join(line.why for line in lines if line.holds is False)
            if begun and not member.lacks:
                member.passed = member.incarnation
            found += lines
        self.checks = tuple(found)
        return not any(member.lacks for member in self._members)

    def accept(self) -> None:
        """The platoon begins: these lives have passed."""
        for member in self._members:
            member.passed = member.incarnation

    def _lines(
        self, member: Member, needed_mps: float, anywhere: bool, begun: bool, now: Time
    ) -> Iterator[Check]:
        """Every line of one robot; what can't be known before another line holds is None."""
        items = [item for item in ITEMS if not self._left_out(item, anywhere)]
        status = self._status(member, now)
        if status is None:
            there = member.presence(now) != "absent"
            why = "it has not said how it is" if there else "its agent is not there"
            known = {THERE: "" if there else why, **({HEARD: why} if there else {})}
        else:
            known = {THERE: "", HEARD: "", **self._said(member, status, needed_mps, begun, now)}
        for item in items:
            why_not = known.get(item)
            yield Check(member.id, item, None if why_not is None else not why_not, why_not or "")

    def _left_out(self, item: str, anywhere: bool) -> bool:
        return (item == TESTED and not self._asked.estop) or (item == START and anywhere)

    def _status(self, member: Member, now: Time) -> Status | None:
        """The last word of the life that is there, if that is not long ago."""
        status = member.status
        if status is None or member.presence(now) == "absent" or status.incarnation != member.incarnation:
            return None
        return status if now - member.status_at <= self._status_stale else None

    def _said(
        self, member: Member, status: Status, needed_mps: float, begun: bool, now: Time
    ) -> dict[str, str]:
        """Why each item does not hold, by what the robot says of itself; empty where it does."""
        stopped = status.mode == "emergency"
        untested = UNTESTED + (
            "maniple stop, then maniple arm, do that" if begun else "maniple preflight does that"
        )
        found = {
            SCENARIO: self._other_scenario(status),
            CONTROLLABLE: _uncontrolled(status),
            LOCALISED: _lost_its_way(member, status, now),
            LIMITS: _too_slow(status, needed_mps),
            RELEASED: f"{status.reason or 'an emergency stop'}: maniple arm releases it" if stopped else "",
            TESTED: "" if status.estop_tested else untested,
            RANGES: self._blind(member, status, now),
        }
        if not found[LOCALISED]:
            found[START] = self._elsewhere(member)
        if found[CONTROLLABLE]:
            return {item: why for item, why in found.items() if not (why and item in _OF_THE_DRIVE)}
        return found

    def _other_scenario(self, status: Status) -> str:
        if not status.scenario:
            return "its agent does not say which scenario it runs"
        told = {"agent": status.scenario, "driver": status.drive_scenario or self._digest}
        return "; ".join(
            f"its {who} runs another scenario ({digest}) than the controller ({self._digest})"
            for who, digest in told.items()
            if digest != self._digest
        )

    def _blind(self, member: Member, status: Status, now: Time) -> str:
        if not status.sees:
            return "it has no ranges, which its guard or its layers go by"
        if not self._ranges:
            return ""
        heard = member.returns is not None and member.returns_age(now) <= self._ranges_stale
        return "" if heard else "its ranges, which the controller goes by, are not heard"

    def _elsewhere(self, member: Member) -> str:
        odometry = member.odometry
        assert odometry is not None, "it is localised"
        own = Pose(odometry.x_m, odometry.y_m, odometry.psi_rad)
        here = own if odometry.frame_id == edges.WORLD else member.pose.compose(own)
        away_m = math.hypot(here.x - member.pose.x, here.y - member.pose.y)
        turned = abs(wrap(here.psi - member.pose.psi))
        why = []
        if away_m > self._asked.start_m:
            why.append(
                f"it is at ({here.x:.2f}, {here.y:.2f}) m, {away_m:.2f} m from its pose in the scenario; "
                f"at most {self._asked.start_m:g} m"
            )
        if turned > self._asked.start_rad:
            why.append(
                f"it is turned by {turned:.2f} rad from its pose in the scenario; "
                f"at most {self._asked.start_rad:g} rad"
            )
        return "; ".join(why)


def _uncontrolled(status: Status) -> str:
    """In an emergency a robot gives that as its reason, whatever else is wrong."""
    reason = "" if status.mode == "emergency" else status.reason
    if status.mode in OUT_OF_CONTROL:
        return f"it is in {status.mode}{': ' * bool(reason)}{reason}"
    if not status.controllable:
        return f"it can't be controlled{': ' * bool(reason)}{reason}"
    return "" if status.driver == "active" else f"its drive is {status.driver}, not active"


def _lost_its_way(member: Member, status: Status, now: Time) -> str:
    if not status.localised or member.presence(now) == "unlocalised":
        return "it does not know where it is"
    return "" if member.presence(now) == "present" else "its odometry is not heard"


def _too_slow(status: Status, needed_mps: float) -> str:
    if status.limits is None:
        return "its agent does not say what it can do"
    u_max, _, v_max = status.limits
    fastest = max(u_max, v_max)
    if fastest >= needed_mps:
        return ""
    return f"it drives at most {fastest:.2f} m/s; the task needs {needed_mps:.2f} m/s"


def _needed_mps(scenario: Scenario) -> float:
    """How fast a robot has to be able to go for the task, and for its way to its place."""
    built = scenario.planning.speed_mps if scenario.planning.build == "straight" else 0.0
    return max(fastest_place_mps(scenario), built)
