"""What has to hold before the platoon moves."""

import math
from collections.abc import Mapping
from typing import Any

import pytest
from msgspec.structs import replace

from central_controller.preflight import ITEMS, Preflight
from central_controller.roster import Roster
from maniple.core import topics
from maniple.core.edges import WORLD
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Check, Command, FormationState, Goal, Odometry, Status
from maniple.core.scenario import types
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND, SECOND
from tests.central_controller.driver import AHEAD, ORIGIN, T0, Driver, odometry, scan, scenario

ASKED = scenario(preflight=types.Preflight(enabled=True))
CONTROL_S = 1.0 / ASKED.rates.control_hz


def status(made: Scenario = ASKED, **changes: Any) -> Status:
    """Of a robot that lacks nothing."""
    fit = Status(
        incarnation=1,
        mode="waiting",
        guard="none",
        command_age_s=-1.0,
        command_age_max_s=-1.0,
        driver="active",
        reason="no command yet",
        counters={},
        controllable=True,
        estop_tested=True,
        scenario=short_digest(made),
        limits=(1.0, 2.0, 0.0),
    )
    return replace(fit, **changes)


class Looked:
    """One look at a platoon of which all but r2 lack nothing."""

    def __init__(self, made: Scenario = ASKED, ranges: bool = False) -> None:
        self.scenario = made
        self.roster = Roster(made.robots)
        self.preflight = Preflight(made, self.roster.members, ranges)
        for member in self.roster.members:
            member.heard(Alive(node=member.id, node_incarnation=1, alive=True), T0)
            member.heard(status(made), T0)
            member.heard(self.at(ORIGIN), T0)
            member.heard(replace(scan(), stamp_ns=T0 - AHEAD), T0)

    def at(self, own: Pose, now: int = T0, **changes: Any) -> Odometry:
        return replace(odometry(own), stamp_ns=now - AHEAD, **changes)

    def r2(self, *heard: Any, now: int = T0) -> None:
        for message in heard:
            self.roster.members[1].heard(message, now)

    def lacking(self, now: int = T0, *, begun: bool = False, anywhere: bool = False) -> dict[str, str]:
        """What r2 lacks, and why; nobody else lacks anything."""
        passed = self.preflight.review(self.scenario, now, begun=begun, anywhere=anywhere)
        missing = [check for check in self.preflight.checks if check.holds is False]
        assert {check.robot for check in missing} <= {"r2"}
        assert passed == (not missing)
        lacks = self.roster.members[1].lacks
        assert lacks == "; ".join(check.why for check in missing)
        return {check.item: check.why for check in missing}


def test_whoever_lacks_nothing_passes() -> None:
    one = Looked()
    assert one.lacking() == {}
    expected = [Check(robot, item, True) for robot in ("r1", "r2", "r3", "r4") for item in ITEMS]
    assert list(one.preflight.checks) == expected


def test_of_a_simulated_platoon_nothing_is_asked() -> None:
    one = Looked(scenario())
    one.r2(Alive(node="r2", node_incarnation=1, alive=False))
    assert one.lacking() == {}
    assert one.preflight.checks == ()


@pytest.mark.parametrize(
    ("changes", "item", "why"),
    [
        ({"scenario": "0123456789abcdef"}, "scenario", "its agent runs another scenario (0123456789abcdef)"),
        ({"scenario": ""}, "scenario", "its agent does not say which scenario it runs"),
        ({"drive_scenario": "f" * 16}, "scenario", f"its driver runs another scenario ({'f' * 16}) than"),
        (
            {"controllable": False, "reason": "a pilot has taken it: mode MANUAL"},
            "controllable",
            "it can't be controlled: a pilot has taken it: mode MANUAL",
        ),
        (
            {"driver": "configured", "reason": "the drive is not active yet"},
            "controllable",
            "its drive is configured, not active",
        ),
        ({"mode": "fault", "reason": "a layer failed"}, "controllable", "it is in fault: a layer failed"),
        ({"mode": "stopped", "reason": ""}, "controllable", "it is in stopped"),
        ({"localised": False}, "localised", "it does not know where it is"),
        ({"sees": False}, "ranges", "it has no ranges, which its guard or its layers go by"),
        ({"limits": None}, "limits", "its agent does not say what it can do"),
        ({"limits": (0.09, 2.0, 0.0)}, "limits", "it drives at most 0.09 m/s; the task needs 0.10 m/s"),
        ({"mode": "emergency", "reason": "emergency stop: a test"}, "stop released", "maniple arm releases"),
        ({"estop_tested": False}, "stop tested", "its emergency stop was not tested: maniple preflight"),
    ],
)
def test_a_robot_that_lacks_one_thing_lacks_that_alone(changes: dict[str, Any], item: str, why: str) -> None:
    one = Looked()
    one.r2(status(**changes))
    found = one.lacking()
    assert list(found) == [item]
    assert why in found[item]
    one.r2(status())
    assert one.lacking() == {}


def test_in_an_emergency_it_is_not_the_stop_that_keeps_it_from_being_controlled() -> None:
    one = Looked()
    one.r2(status(mode="emergency", controllable=False, reason="emergency stop"))
    assert one.lacking()["controllable"] == "it can't be controlled"


def test_what_the_drive_brings_is_not_asked_before_that_is_under_control() -> None:
    one = Looked()
    one.r2(status(controllable=False, reason="no vehicle", sees=False, localised=False, estop_tested=False))
    assert one.lacking() == {"controllable": "it can't be controlled: no vehicle"}
    own = {check.item: check.holds for check in one.preflight.checks if check.robot == "r2"}
    assert {item for item, holds in own.items() if holds is None} == {
        "localised",
        "start pose",
        "ranges",
        "stop tested",
    }


def test_what_can_not_be_known_is_not_said_to_be_missing() -> None:
    one = Looked()
    one.r2(Alive(node="r2", node_incarnation=1, alive=False))
    assert one.lacking() == {"there": "its agent is not there"}
    own = {check.item: check.holds for check in one.preflight.checks if check.robot == "r2"}
    assert own == {"there": False} | dict.fromkeys(ITEMS[1:])


def test_old_words_and_those_of_an_earlier_life_say_nothing() -> None:
    one = Looked()
    for member in one.roster.members:
        if member.id != "r2":
            member.heard(status(), T0 + 2 * SECOND)
            member.heard(one.at(ORIGIN, T0 + 2 * SECOND), T0 + 2 * SECOND)
    late = T0 + 2 * SECOND + MILLISECOND
    assert one.lacking(late) == {"heard": "it has not said how it is"}
    one.r2(status(), now=late)
    assert one.lacking(late) == {"localised": "its odometry is not heard"}
    one.r2(one.at(ORIGIN, late), now=late)
    assert one.lacking(late) == {}
    one.r2(Alive(node="r2", node_incarnation=2, alive=True), now=late)
    assert one.lacking(late) == {"heard": "it has not said how it is"}


@pytest.mark.parametrize(
    ("x", "turned", "lacks"), [(0.99, 0.49, ""), (1.01, 0.0, "1.01 m from"), (0.0, -0.51, "by 0.51 rad")]
)
@pytest.mark.parametrize("world", [False, True])
def test_a_robot_starts_near_its_pose_in_whatever_frame_it_says_that(
    x: float, turned: float, lacks: str, world: bool
) -> None:
    one = Looked()
    own, frame = Pose(x, 0.0, turned), "own"
    if world:
        pose = one.scenario.robots[1].pose
        assert pose is not None
        own, frame = Pose(pose[0] + x, pose[1], pose[2] + turned + 2 * math.pi), WORLD
    one.r2(one.at(own, frame_id=frame))
    found = one.lacking()
    assert lacks in found.get("start pose", "")
    assert bool(found) == bool(lacks)
    assert one.lacking(anywhere=True) == {}


def test_the_controller_s_own_layers_need_the_ranges_heard() -> None:
    one = Looked(ranges=True)
    assert one.lacking() == {}
    now = T0 + 600 * MILLISECOND
    for member in one.roster.members:
        member.heard(one.at(ORIGIN, now), now)
        if member.id != "r2":
            member.heard(replace(scan(), stamp_ns=now - AHEAD), now)
    assert one.lacking(now) == {"ranges": "its ranges, which the controller goes by, are not heard"}


def test_the_stop_is_not_tested_where_nobody_asks_for_that() -> None:
    made = scenario(preflight=types.Preflight(enabled=True, estop=False))
    one = Looked(made)
    one.r2(status(made, estop_tested=False))
    assert one.lacking() == {}
    assert "stop tested" not in {check.item for check in one.preflight.checks}


def test_what_passed_is_asked_again_of_the_lost_and_of_new_lives_alone() -> None:
    one = Looked()
    assert one.lacking() == {}
    one.preflight.accept()
    one.r2(status(controllable=False), one.at(Pose(5.0, 0.0, 0.0)))
    assert one.lacking(begun=True) == {}
    assert one.preflight.checks == ()
    member = one.roster.members[1]
    member.lost = True
    assert list(one.lacking(begun=True)) == ["controllable"]
    one.r2(status())
    assert one.lacking(begun=True) == {}, "where it is does not matter any more"
    member.lost = False
    one.r2(Alive(node="r2", node_incarnation=2, alive=True), status(incarnation=2, estop_tested=False))
    assert list(one.lacking(begun=True)) == ["localised", "stop tested"]
    one.r2(one.at(ORIGIN, T0 + 1, incarnation=2))
    assert list(one.lacking(begun=True)) == ["stop tested"]
    one.r2(status(incarnation=2))
    assert one.lacking(begun=True) == {}
    assert member.seat(1).passed == 2


class Asked(Driver):
    """A platoon that is looked at, whose robots all lack the test of the emergency stop."""

    def __init__(self, made: Scenario = ASKED, **changes: Any) -> None:
        super().__init__(made, **changes)
        for robot in self.ids:
            self.how(robot, estop_tested=False)
        self.odometries()

    def how(self, robot: str, **changes: Any) -> None:
        self.say(topics.status(robot), status(**changes))

    def goes_on(
        self, ticks: int = 1, poses: Mapping[str, Odometry] | None = None
    ) -> tuple[dict[str, Command], FormationState]:
        """Everybody tells where he is, and the controller ticks; what it said last."""
        for _ in range(ticks):
            self.now += round(CONTROL_S * SECOND)
            self.odometries(poses)
            told = self.tick()
        return told


def test_nobody_moves_before_everybody_has_passed() -> None:
    platoon = Asked()
    commands, state = platoon.goes_on()
    assert (commands, state.phase) == ({}, "waiting")
    assert state.waits_for == platoon.ids
    assert state.reason == (
        "waits for r1, r2, r3, r4: pre-flight check: its emergency stop was not tested: "
        "maniple preflight does that"
    )
    for robot in platoon.ids[1:]:
        platoon.how(robot)
    _, state = platoon.goes_on()
    assert (state.phase, state.waits_for) == ("waiting", ("r1",))
    assert [check for check in state.preflight if check.holds is False] == [
        Check("r1", "stop tested", False, "its emergency stop was not tested: maniple preflight does that")
    ]
    platoon.how("r1")
    commands, state = platoon.goes_on()
    assert state.phase != "waiting"
    assert set(commands) == set(platoon.ids)
    assert {seat.passed for seat in platoon.missions[-1].seats} == {1}
    _, state = platoon.goes_on()
    assert state.preflight == ()


def begun() -> Asked:
    platoon = Asked()
    for robot in platoon.ids:
        platoon.how(robot)
    _, state = platoon.goes_on()
    assert state.phase != "waiting"
    for robot in platoon.ids:
        platoon.how(robot, mode="tracking", reason="")
    return platoon


def test_an_agent_that_lives_anew_is_not_commanded_before_it_has_passed() -> None:
    platoon, anew = begun(), {"r3": replace(odometry(), incarnation=2)}
    platoon.say(topics.HOST_ALIVE, Alive(node="r3", node_incarnation=2, alive=True))
    platoon.how("r3", incarnation=2, estop_tested=False)
    commands, state = platoon.goes_on(1, anew)
    assert set(commands) == {"r1", "r2", "r4"}
    assert state.waits_for == ("r3",)
    assert "pre-flight check: its emergency stop was not tested" in state.reason
    _, state = platoon.goes_on(35, anew)
    assert state.chain == ("r1", "r2", "r4")
    assert [r.state for r in state.roster] == ["present", "present", "lost", "present"]
    platoon.how("r3", incarnation=2, estop_tested=False)
    _, state = platoon.goes_on(1, anew)
    assert {check.why for check in state.preflight if check.holds is False} == {
        "its emergency stop was not tested: maniple stop, then maniple arm, do that"
    }
    assert {check.robot for check in state.preflight} == {"r3"}
    assert state.reason == ""
    platoon.mode("r4", "fault")
    platoon.goes_on(34, anew)
    platoon.how("r3", incarnation=2, estop_tested=False)
    _, state = platoon.goes_on(1, anew)
    assert state.reason.startswith(
        "2 robots are left; a formation needs 3; r3 is lost: its emergency stop was not tested: maniple stop"
    )
    platoon.how("r4", mode="tracking", reason="")
    _, state = platoon.goes_on(12, anew)
    assert state.chain == ("r1", "r2", "r4")
    platoon.how("r3", incarnation=2, mode="tracking", reason="")
    commands, state = platoon.goes_on(15, anew)
    assert set(commands) == set(platoon.ids)
    assert state.preflight == ()


def test_the_next_life_of_the_controller_knows_who_has_passed() -> None:
    before = begun()
    before.goes_on()
    _, state = before.goes_on()
    mission = replace(before.missions[-1], source="controller", incarnation=1)
    after = Driver(ASKED, before.now + SECOND, incarnation=2)
    after.say(topics.FORMATION_MISSION, mission)
    after.say(topics.FORMATION_STATE, replace(state, source="controller", incarnation=1, seq=9))
    for robot in after.ids:
        after.say(topics.status(robot), status(mode="tracking", reason="", estop_tested=False))
    after.odometries()
    commands, state = after.tick()
    assert set(commands) == set(after.ids)
    assert state.preflight == ()


def test_a_controller_that_does_not_know_how_far_things_were_does_not_ask_where_robots_start() -> None:
    far = {robot: odometry(Pose(3.0, 0.0, 0.0)) for robot in ("r1", "r2", "r3", "r4")}
    after = Asked(incarnation=2)
    for robot in after.ids:
        after.how(robot)
    _, state = after.goes_on(15, far)
    assert "waits for a goal" in state.reason
    for robot in after.ids:
        after.how(robot)
    after.say(topics.FORMATION_GOAL, Goal(id="on", hold=False))
    _, state = after.goes_on(1, far)
    assert state.phase != "waiting"


def test_a_goal_that_is_too_fast_for_a_robot_is_part_of_what_it_lacks() -> None:
    platoon = Asked()
    for robot in platoon.ids:
        platoon.how(robot, limits=(0.2, 1.0, 0.0))
    faster = types.Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.3)
    platoon.say(topics.FORMATION_GOAL, Goal(id="fast", task=faster))
    _, state = platoon.goes_on()
    assert "it drives at most 0.20 m/s; the task needs 0.30 m/s" in state.reason
