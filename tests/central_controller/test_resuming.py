"""A controller that is started again, told what the one before it left, or not."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.testing import assert_allclose

from central_controller.node import CONTROL
from maniple.control.limits import age_limits
from maniple.core import topics
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, FormationState, Goal, Mission, Stamp, unpack_floats
from maniple.core.node import Received
from maniple.core.scenario.types import (
    Avoidance,
    Compensation,
    Formation,
    Guard,
    Line,
    Planning,
    Scenario,
    Shape,
)
from maniple.core.time import SECOND
from tests.central_controller.driver import Driver, odometry, scan, scenario

GOALS = {
    "another task": Goal(id="g", task=Line(start=(1.0, 1.0), end=(2.0, 3.0), speed_mps=0.1)),
    "another shape": Goal(id="g", formation=Formation(shape=Shape(kind="vee", spacing_m=0.9))),
}
OFF = {"r1": odometry(Pose(0.2, -0.1, 0.0), u=0.05), "r3": odometry(Pose(-0.1, 0.1, 0.3))}


def go_on(driver: Driver, ticks: int, **scans: Any) -> Any:
    """Everybody is heard at each tick: commands and state of the last."""
    for _ in range(ticks):
        driver.odometries(OFF)
        if driver.node.subscriptions & {topics.ranges("r1")}:
            driver.scans(**scans)
        heard = driver.tick(100)
    return heard


def left_by(driver: Driver, state: FormationState) -> list[Any]:
    """The last words of the life of `driver`, as the network has them."""
    mission = replace(driver.missions[-1], source="controller", incarnation=1, seq=len(driver.missions))
    return [mission, replace(state, source="controller", incarnation=1, seq=999)]


def next_life(made: Scenario, last: list[Any], driver: Driver, **scans: Any) -> Driver:
    """A second life that is told `last` at its start, and hears the robots."""
    new = Driver(made, now=driver.now, incarnation=2)
    assert new.node.on_start(new.now) == []
    for message in last:
        name = topics.FORMATION_MISSION if isinstance(message, Mission) else topics.FORMATION_STATE
        assert name in new.node.subscriptions
        new.say(name, message)
    new.odometries(OFF)
    if new.node.subscriptions & {topics.ranges("r1")}:
        new.scans(**scans)
    return new


@pytest.mark.parametrize("stage", ["building", "running", "another task", "another shape", "done"])
@pytest.mark.parametrize("robot_from", ["kinematics", "drive"])
def test_it_commands_what_the_life_before_would_have(stage: str, robot_from: Any) -> None:
    """But for the time in between, of which nobody knows. Then both go on alike."""
    made = scenario(
        robot_from,
        compensation=Compensation(enabled=True),
        planning=Planning(build="straight" if stage == "building" else "off", method="optimal"),
    )
    seen = {"r1": scan(0.5, -0.5), "r2": scan(0.6, 0.4)}
    old = Driver(made)
    old.odometries()
    if robot_from == "drive":
        old.scans(**seen)
    _, state = go_on(old, 150 if stage == "done" else 20, **seen)
    if stage.startswith("another"):
        old.say(topics.FORMATION_GOAL, GOALS[stage])
        _, state = go_on(old, 15, **seen)
        assert (state.goal, state.goal_refused) == ("g", "")
    new = next_life(made, left_by(old, state), old, **seen)
    if stage.startswith("another"):
        new.say(topics.FORMATION_GOAL, GOALS[stage])
    commands, first = new.tick()
    old.odometries(OFF)
    again, same = old.tick()
    assert (first.phase, first.task_time_s) == (same.phase, same.task_time_s)
    assert (first.chain, first.points, first.goal) == (same.chain, same.points, same.goal)
    assert first.reference == pytest.approx(same.reference, abs=1e-12)
    assert_allclose(unpack_floats(first.errors), unpack_floats(same.errors), atol=1e-6)
    for name, command in commands.items():
        assert command.values == pytest.approx(again[name].values, abs=0.02)
    for one, other in zip(first.roster, same.roster, strict=True):
        assert one.compensation == pytest.approx(other.compensation, abs=1e-3)
        for layer, known in zip(one.memory, other.memory, strict=True):
            assert layer == pytest.approx(known, abs=1e-9)
    assert first.roster[0].memory or robot_from != "drive"
    (commands, first), (again, same) = go_on(new, 30, **seen), go_on(old, 30, **seen)
    assert (first.phase, first.chain) == (same.phase, same.chain)
    assert first.task_time_s == pytest.approx(same.task_time_s, abs=0.11)
    for name, command in commands.items():
        assert command.values == pytest.approx(again[name].values, abs=5e-3)


def test_it_waits_for_the_robots_that_were_not_lost_and_goes_on_without_those_that_do_not_come() -> None:
    made = scenario()
    old = Driver(made)
    _, state = go_on(old, 20)
    new = next_life(made, left_by(old, state), old)
    for name in ("r3", "r4"):
        new.say(topics.HOST_ALIVE, Alive(node=name, node_incarnation=1, alive=False))
    commands, first = new.tick(100)
    assert commands == {}
    assert (first.phase, first.waits_for, first.chain) == ("holding", ("r3", "r4"), new.ids)
    assert first.reason == "the controller was started again; waits for r3, r4: it is not there"
    new.say(topics.HOST_ALIVE, Alive(node="r3", node_incarnation=1, alive=True))
    for _ in range(29):
        new.odometries(OFF)
        commands, gone_on = new.tick(100)
        assert (commands, gone_on.task_time_s) == ({}, state.task_time_s)
    for _ in range(3):
        new.odometries(OFF)
        commands, gone_on = new.tick(100)
    assert set(commands) == {"r1", "r2", "r3"}
    assert (gone_on.phase, gone_on.chain) == ("running", ("r1", "r2", "r3"))


def test_a_robot_that_was_lost_is_not_waited_for() -> None:
    made = scenario()
    old = Driver(made)
    old.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=True))
    go_on(old, 5)
    old.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    _, state = go_on(old, 40)
    assert state.chain == ("r1", "r3", "r4")
    new = next_life(made, left_by(old, state), old)
    new.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    commands, first = new.tick()
    assert set(commands) == {"r1", "r3", "r4"}
    assert (first.chain, first.roster[1].state) == (state.chain, "lost")


@pytest.mark.parametrize("kept", [(), ("mission",), ("state",)])
def test_where_the_record_is_missing_it_holds_until_a_goal_comes(kept: tuple[str, ...]) -> None:
    """And begins where the robots are, not where the task does."""
    made = scenario()
    old = Driver(made)
    _, state = go_on(old, 20)
    mission, last = left_by(old, state)
    known = {"mission": mission, "state": last}
    new = next_life(made, [known[what] for what in kept], old)
    moved = {}
    for robot in made.robots:
        assert robot.pose is not None
        start = Pose(*robot.pose)
        moved[robot.id] = odometry(start.inverse().compose(Pose(3.0, 1.0, 0.5)).compose(start))
    new.say(topics.FORMATION_GOAL, Goal(id="of old", hold=False))
    assert new.node.on_timer(CONTROL, new.now + SECOND // 2) == []
    new.now += SECOND
    for _ in range(20):
        new.odometries(moved)
        commands, state = new.tick(100)
    assert commands == {}
    assert (state.phase, state.goal) == ("holding", "of old")
    assert state.reason.startswith("the controller was started again and knows ")
    assert state.reason.endswith("; waits for a goal")
    assert new.missions == []
    new.say(topics.FORMATION_GOAL, Goal(id="stay", hold=True))
    assert new.tick(100)[1].phase == "holding"
    new.say(topics.FORMATION_GOAL, Goal(id="go", hold=False))
    poses = []
    for _ in range(600):
        new.odometries(moved)
        commands, state = new.tick(100)
        poses.append(state.reference[:2])
    assert (state.phase, state.goal) == ("done", "go")
    assert poses[0] == pytest.approx((3.0, 1.0))
    assert max(math.dist(a, b) for a, b in pairwise(poses)) < 0.03
    assert min(math.dist(pose, (0.0, 0.0)) for pose in poses) < 0.02


@pytest.mark.parametrize("when", ["before the record", "after it"])
def test_a_new_shape_waits_for_the_robots(when: str) -> None:
    """One of which was started again, too, and has not said where it is."""
    made = scenario()
    old = Driver(made)
    old.odometries()
    _, state = go_on(old, 20)
    new = Driver(made, now=old.now, incarnation=2)
    new.node.on_start(new.now)
    shape = GOALS["another shape"]
    if when == "before the record":
        new.say(topics.FORMATION_GOAL, shape)
    for message in left_by(old, state):
        kind = topics.FORMATION_MISSION if isinstance(message, Mission) else topics.FORMATION_STATE
        new.say(kind, message)
    _, first = new.tick(100)
    if when == "after it":
        new.say(topics.FORMATION_GOAL, shape)
    assert (first.phase, first.goal) == ("holding", "")
    new.odometries({**OFF, "r2": replace(odometry(), incarnation=2)})
    commands, held = new.tick(100)
    assert (commands, held.phase, held.goal, held.points) == ({}, "holding", "", state.points)
    _, gone_on = go_on(new, 1)
    assert (gone_on.phase, gone_on.goal, gone_on.goal_refused) == ("running", "g", "")


def test_a_record_that_comes_late_is_believed_all_the_same() -> None:
    made = scenario()
    old = Driver(made)
    _, state = go_on(old, 20)
    new = next_life(made, [], old)
    new.now += SECOND
    _, held = go_on(new, 5)
    assert held.phase == "holding"
    for message in left_by(old, state):
        kind = topics.FORMATION_MISSION if isinstance(message, Mission) else topics.FORMATION_STATE
        new.say(kind, message)
    _, first = go_on(new, 1)
    assert (first.phase, first.reference) == ("running", state.reference)


def test_a_first_life_takes_nothing_from_a_run_before() -> None:
    made = scenario()
    old = Driver(made)
    _, state = go_on(old, 20)
    new = Driver(made, now=old.now)
    for message in left_by(old, state):
        new.node.on_message(Received(topics.FORMATION_STATE, message), new.now)
    _, first = go_on(new, 1)
    assert first.task_time_s == 0.0


def test_a_life_that_began_before_the_task_did_waits_like_the_first() -> None:
    made = scenario()
    old = Driver(made)
    _, state = old.tick(100)
    assert state.phase == "waiting"
    new = next_life(made, left_by(old, state), old)
    _, first = new.tick(100)
    assert (first.phase, first.task_time_s, first.reason) == ("running", 0.0, "")


def test_a_goal_that_is_faster_makes_commands_count_for_less_long() -> None:
    made = scenario("drive", avoidance=Avoidance(enabled=False), guard=Guard())
    driver = Driver(made)
    commands, _ = go_on(driver, 2)
    assert {command.stop_after_s for command in commands.values()} == {0.0}
    task = Line(start=(0.0, 0.0), end=(3.0, 0.0), speed_mps=0.4)
    driver.say(topics.FORMATION_GOAL, Goal(id="fast", task=task))
    commands, state = go_on(driver, 2)
    assert state.goal_refused == ""
    stop_s = age_limits(replace(made, task=task), made.robots[0])[1]
    assert stop_s < age_limits(made, made.robots[0])[1]
    assert {command.stop_after_s for command in commands.values()} == {stop_s}
    slow = Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.05)
    driver.say(topics.FORMATION_GOAL, Goal(id="slow", task=slow))
    assert {command.stop_after_s for command in go_on(driver, 2)[0].values()} == {0.0}


def test_round_trips_are_of_its_own_commands() -> None:
    driver = Driver(scenario())
    go_on(driver, 2)
    sent = driver.now
    for incarnation, expected in ((2, -1.0), (1, 0.3)):
        applied = Stamp(incarnation, 1, sent)
        driver.now = sent + 4 * SECOND // 10
        for name in driver.ids:
            driver.say(topics.odometry(name), replace(odometry(), applied=applied, held_ns=SECOND // 10))
        _, state = driver.tick()
        assert [robot.round_trip_s for robot in state.roster] == pytest.approx([expected] * 4)


def test_the_state_tells_why_it_waits() -> None:
    driver = Driver(scenario())
    go_on(driver, 2)
    driver.mode("r3", "holding")
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    _, state = go_on(driver, 1)
    assert (state.phase, state.waits_for) == ("running", ("r2", "r3"))
    assert state.reason == "waits for r2: it is not there; for r3: holding"
    assert np.all([robot.incarnation == 1 for robot in state.roster])
