import math
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.testing import assert_allclose

from central_controller.node import CONTROL, STAGES, CentralController
from maniple.control import unicycle
from maniple.control.builtin import BUILTIN
from maniple.control.limits import Velocity
from maniple.core import codec, topics
from maniple.core.geometry import Pose
from maniple.core.layers import Layer
from maniple.core.messages import (
    Alive,
    Command,
    FormationState,
    Goal,
    Mode,
    Refused,
    Stamp,
    unpack_floats,
)
from maniple.core.node import Node
from maniple.core.scenario.types import (
    Avoidance,
    Compensation,
    Controller,
    Formation,
    Line,
    Planning,
    Positioning,
    Shape,
    Supervisor,
    Waiting,
)
from maniple.core.time import MILLISECOND, SECOND
from tests.central_controller.driver import (
    AHEAD,
    HEADINGS,
    PLACES,
    T0,
    A,
    Driver,
    heard,
    odometry,
    scan,
    scenario,
)


def control_point_velocity(driver: Driver, robot: str, u: float, w: float, own_psi: float) -> Any:
    psi = HEADINGS[driver.ids.index(robot)] + own_psi
    return unicycle.forward(psi, A, u, w)


def test_is_a_node() -> None:
    node: Node = CentralController(scenario())
    assert node.name == "controller"
    assert node.timers == {"control": 100 * MILLISECOND}


@pytest.mark.parametrize("robot_from", ["kinematics", "avoidance", "compensation", "drive"])
@pytest.mark.parametrize("enabled", [True, False])
def test_ranges_are_subscribed_where_avoidance_runs_here(robot_from: Layer, enabled: bool) -> None:
    node = CentralController(scenario(robot_from, avoidance=Avoidance(enabled=enabled)))
    wanted = {f"robot/r{k}/{what}" for k in (1, 2, 3, 4) for what in ("odometry", "status")}
    wanted |= {"formation/goal", "host/alive", "host/refused"}
    if enabled and robot_from in ("compensation", "drive"):
        wanted |= {f"robot/r{k}/ranges" for k in (1, 2, 3, 4)}
    assert node.subscriptions == wanted


def test_it_says_from_the_start_that_it_waits() -> None:
    node = CentralController(scenario())
    commands, state = heard(node.on_start(T0))
    assert commands == {}
    assert state.phase == "waiting"
    assert state.chain == ("r1", "r2", "r3", "r4")
    assert state.errors == b""
    assert state.task_duration_s == 12.0
    assert state.reference == (0.0, 0.0, 0.0)
    assert state.reference_velocity == (0.0, 0.0, 0.0)
    assert {report.state for report in state.roster} == {"absent"}
    assert node.on_stop(T0) == []


def test_it_waits_for_the_last_odometry() -> None:
    driver = Driver(scenario())
    for robot in driver.ids[:3]:
        driver.say(topics.odometry(robot), odometry())
        commands, state = driver.tick(100)
        assert (commands, state.phase, state.task_time_s) == ({}, "waiting", 0.0)
    driver.say(topics.odometry("r4"), odometry())
    commands, state = driver.tick(100)
    assert set(commands) == set(driver.ids)
    assert (state.phase, state.task_time_s) == ("running", 0.0)
    assert state.reference_velocity == pytest.approx((0.1, 0.0, 0.0))


def test_it_waits_for_ranges_where_it_needs_them() -> None:
    driver = Driver(scenario("drive"))
    driver.odometries()
    commands, state = driver.tick()
    assert (commands, state.phase) == ({}, "waiting")
    assert state.errors == b""
    driver.scans()
    assert driver.tick(100)[1].phase == "running"


def test_it_runs_the_task_and_then_holds() -> None:
    driver = Driver(scenario())
    seen = []
    for k in range(27):
        driver.now += 500 * MILLISECOND if k else 0
        driver.odometries()
        seen.append(driver.tick()[1])
    assert [state.phase for state in seen] == ["running"] * 24 + ["done"] * 3
    assert [state.task_time_s for state in seen] == pytest.approx([*(k / 2 for k in range(25)), 12.0, 12.0])
    assert seen[10].reference == pytest.approx((0.5, 0.0, 0.0))
    assert seen[-1].reference == pytest.approx((1.0, 0.0, 0.0))
    assert seen[-1].reference_velocity == (0.0, 0.0, 0.0)
    assert set(driver.tick(500)[0]) == set(driver.ids)


def test_stages_only_go_forward_but_for_another_task() -> None:
    order = ["waiting", "forming", "running", "done"]
    for (stage, event), after in STAGES.items():
        assert order.index(after) == order.index(stage) + (-1 if event == "new task" else 1)


def test_in_place_every_control_point_moves_as_the_reference() -> None:
    """Whatever the robots' headings; before K^-1 the velocity is in each robot's own frame."""
    driver = Driver(scenario("kinematics"))
    driver.odometries()
    commands, state = driver.tick()
    assert_allclose(unpack_floats(state.errors, 6), 0.0, atol=1e-6)
    for robot, psi in zip(driver.ids, HEADINGS, strict=True):
        assert commands[robot].layer == "kinematics"
        assert Pose(0.0, 0.0, psi).rotate(*commands[robot].values) == pytest.approx((0.1, 0.0), abs=1e-9)


@pytest.mark.parametrize("robot_from", ["avoidance", "compensation", "drive"])
def test_after_the_kinematics_values_are_those_of_the_wheels(robot_from: Layer) -> None:
    """Robots that have turned meanwhile, about their control points."""
    driver = Driver(scenario(robot_from, avoidance=Avoidance(enabled=robot_from != "drive")))
    turned = Pose(A - A * math.cos(0.7), -A * math.sin(0.7), 0.7)
    driver.odometries({robot: odometry(turned) for robot in driver.ids})
    if driver.node.subscriptions & {topics.ranges("r1")}:
        driver.scans()
    commands, state = driver.tick()
    assert_allclose(unpack_floats(state.errors, 6), 0.0, atol=1e-6)
    for robot in driver.ids:
        assert commands[robot].layer == robot_from
        velocity = control_point_velocity(driver, robot, *commands[robot].values, own_psi=0.7)
        assert velocity == pytest.approx((0.1, 0.0), abs=1e-9)


def test_a_displaced_robot_is_called_back() -> None:
    driver = Driver(scenario("kinematics"))
    driver.odometries({"r4": odometry(Pose(0.2, 0.0, 0.0))})
    commands, state = driver.tick()
    errors = unpack_floats(state.errors, 6)
    assert_allclose(errors[0], 0.0, atol=1e-6)
    assert np.abs(errors[1]).max() > 0.01
    back = commands["r4"].values[0] - Pose(0.0, 0.0, -HEADINGS[3]).rotate(0.1, 0.0)[0]
    assert back < -0.01
    for robot, psi in zip(driver.ids[:3], HEADINGS[:3], strict=True):
        assert Pose(0.0, 0.0, psi).rotate(*commands[robot].values) == pytest.approx((0.1, 0.0), abs=1e-9)


def test_odometry_is_carried_forward_to_now() -> None:
    """A robot that keeps up with the reference shows no error, however old its odometry is within limits;
    beyond them it is carried no farther, and the reference waits."""
    made = scenario("kinematics")
    straight = tuple(
        replace(robot, pose=(x - A, y, 0.0)) for robot, (x, y) in zip(made.robots, PLACES, strict=True)
    )
    driver = Driver(replace(made, robots=straight))
    driver.odometries({robot: odometry(u=0.1) for robot in driver.ids})
    driver.tick()
    assert_allclose(unpack_floats(driver.tick(400)[1].errors, 6), 0.0, atol=1e-6)
    late = unpack_floats(driver.tick(600)[1].errors, 6)
    assert_allclose(late[:, 0], 0.04 - 0.05, atol=1e-6)


def test_commands_say_which_odometry_they_answer_and_how_old_their_inputs_are() -> None:
    driver = Driver(scenario("kinematics"))
    driver.odometries()
    driver.now += 30 * MILLISECOND
    for robot in ("r1", "r2", "r3"):
        driver.say(topics.odometry(robot), odometry(seq=int(robot[1])))
    commands, state = driver.tick(20)
    assert commands["r2"].answers == Stamp(incarnation=1, seq=2, stamp_ns=T0 + 30 * MILLISECOND - AHEAD)
    assert commands["r4"].answers == Stamp(incarnation=1, seq=0, stamp_ns=T0 - AHEAD)
    assert {command.inputs_age_ns for command in commands.values()} == {50 * MILLISECOND}
    assert [report.odometry_age_s for report in state.roster] == pytest.approx([0.02, 0.02, 0.02, 0.05])


def test_old_ranges_make_only_their_own_robots_command_older() -> None:
    driver = Driver(scenario("drive"))
    driver.scans()
    driver.now += 60 * MILLISECOND
    driver.odometries()
    for robot in ("r1", "r2", "r3"):
        driver.say(topics.ranges(robot), scan())
    commands, _ = driver.tick(10)
    ages = {robot: command.inputs_age_ns // MILLISECOND for robot, command in commands.items()}
    assert ages == {"r1": 10, "r2": 10, "r3": 10, "r4": 70}


def test_a_silent_robot_is_reported_and_still_commanded() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    driver.now += 600 * MILLISECOND
    for robot in ("r1", "r2", "r3"):
        driver.say(topics.odometry(robot), odometry(seq=1))
    commands, state = driver.tick()
    assert [report.state for report in state.roster] == ["present", "present", "present", "silent"]
    assert {command.inputs_age_ns for command in commands.values()} == {600 * MILLISECOND}


def test_absent_robots_are_reported_and_waited_for() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    driver.say(topics.HOST_ALIVE, Alive(node="recorder", node_incarnation=1, alive=False))
    commands, state = driver.tick()
    assert (commands, state.phase) == ({}, "waiting")
    assert [report.state for report in state.roster] == ["present", "absent", "present", "present"]
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=True))
    assert driver.tick(100)[1].phase == "running"


def test_central_avoidance_slows_and_turns_only_the_robot_that_sees_something() -> None:
    free, blocked = Driver(scenario("drive")), Driver(scenario("drive"))
    for driver in (free, blocked):
        driver.odometries()
        driver.scans(**({"r1": scan(0.5, -0.5)} if driver is blocked else {}))
        driver.tick()
    for _ in range(5):
        calm, _ = free.tick(100)
        stirred, _ = blocked.tick(100)
    assert stirred["r1"].values[0] < calm["r1"].values[0] - 1e-3
    assert stirred["r1"].values[1] > calm["r1"].values[1] + 1e-3
    for robot in ("r2", "r3", "r4"):
        assert stirred[robot].values == calm[robot].values


def test_layers_are_advanced_by_the_time_that_passed_but_not_by_a_freeze() -> None:
    hold = Line(start=(0.0, 0.0), end=(0.0, 0.0), speed_mps=0.1, settle_s=100.0)

    def turning(after_ms: float) -> float:
        driver = Driver(scenario("drive", task=hold))
        driver.odometries()
        driver.scans(r1=scan(0.5, -0.5))
        assert driver.tick()[0]["r1"].values == pytest.approx((0.0, 0.0), abs=1e-12)
        return driver.tick(after_ms)[0]["r1"].values[1]

    assert turning(0) == pytest.approx(0.0, abs=1e-12)
    assert 1e-3 < turning(100) < turning(300) < turning(500)
    assert turning(60_000) == turning(500)


def test_at_the_stop_every_robot_is_told_to_stand() -> None:
    driver = Driver(scenario("avoidance"))
    driver.odometries()
    driver.tick()
    sent = driver.node.on_stop(driver.now + 5 * MILLISECOND)
    assert [topic for topic, _ in sent] == [topics.command(robot) for robot in driver.ids]
    for _, message in sent:
        assert isinstance(message, Command)
        assert message.values == (0.0, 0.0)
        assert message.layer == "avoidance"
        assert message.inputs_age_ns == 5 * MILLISECOND


def test_another_timer_is_not_its_business() -> None:
    assert CentralController(scenario()).on_timer("other", T0) == []


def test_the_same_inputs_give_the_same_bytes() -> None:
    def run() -> list[bytes]:
        driver = Driver(scenario("drive"))
        out = []
        for k in range(20):
            driver.odometries({"r3": odometry(Pose(0.01 * k, 0.02, 0.1), seq=k, u=0.1, w=0.2)})
            driver.scans(r2=scan(0.6, 0.3))
            driver.now += 100 * MILLISECOND
            out += [codec.encode(message) for _, message in driver.node.on_timer(CONTROL, driver.now)]
        return out

    assert run() == run()


def test_refused_inputs_are_counted_in_the_state() -> None:
    driver = Driver(scenario())
    for _ in range(3):
        driver.say(topics.HOST_REFUSED, Refused(topic="robot/r1/odometry", sender="r1", reason="old"))
    _, state = driver.tick()
    assert state.refused == 3


@pytest.mark.parametrize("mode", ["waiting", "holding", "stopped", "fault"])
def test_the_reference_waits_for_a_robot_that_does_not_follow(mode: Mode) -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    driver.mode("r3", mode)
    commands, state = driver.tick(100)
    assert (state.task_time_s, state.waits_for) == (0.0, ("r3",))
    assert state.reference_velocity == (0.0, 0.0, 0.0)
    assert set(commands) == set(driver.ids)
    driver.mode("r3", "tracking")
    _, state = driver.tick(100)
    assert state.task_time_s == pytest.approx(0.1)
    assert state.waits_for == ()


def test_the_reference_waits_for_a_silent_robot_and_for_a_dead_one() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    assert driver.tick(600)[1].waits_for == driver.ids
    driver.odometries()
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    assert driver.tick(100)[1].waits_for == ("r2",)
    assert driver.tick(100)[1].task_time_s == 0.0


def test_after_a_freeze_the_reference_does_not_jump() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    driver.now += 60 * SECOND
    driver.odometries()
    _, state = driver.tick()
    assert state.task_time_s <= 0.5


def test_a_later_life_of_a_robot_is_not_believed_once_the_task_runs() -> None:
    """Its odometry frame begins where it stands, and nobody knows where that is."""
    driver = Driver(scenario())
    driver.odometries()
    before, _ = driver.tick()
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=2, alive=True))
    driver.say(topics.odometry("r2"), replace(odometry(Pose(0.5, 0.5, 1.0)), incarnation=2))
    commands, state = driver.tick(100)
    assert state.roster[1].state == "unlocalised"
    assert state.waits_for == ("r2",)
    assert commands["r2"].answers.incarnation == 1
    assert before["r2"].answers.incarnation == 1


def test_before_the_task_a_later_life_of_a_robot_replaces_an_earlier_one() -> None:
    driver = Driver(scenario())
    driver.say(topics.odometry("r2"), odometry())
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=2, alive=True))
    driver.odometries({"r2": replace(odometry(), incarnation=2)})
    _, state = driver.tick()
    assert (state.phase, state.roster[1].state) == ("waiting", "unlocalised")
    driver.mode("r2", "waiting", incarnation=2)
    driver.odometries({"r2": replace(odometry(), incarnation=2)})
    commands, state = driver.tick()
    assert state.phase == "running"
    assert commands["r2"].answers.incarnation == 2


def test_what_was_said_by_a_robot_that_is_gone_does_not_start_the_task() -> None:
    driver = Driver(scenario())
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    driver.odometries()
    assert driver.tick()[1].phase == "waiting"


def test_scattered_robots_build_the_formation_along_straight_lines_first() -> None:
    """Each robot that is where it should be at every tick: the desired places move, the errors stay zero."""
    off = {"r1": Pose(0.3, 0.2, 0.0), "r4": Pose(-0.2, 0.1, 0.0)}
    driver = Driver(scenario(planning=Planning(build="straight", speed_mps=0.1)))
    driver.odometries({robot: odometry(pose) for robot, pose in off.items()})
    commands, state = driver.tick()
    assert (state.phase, state.task_time_s) == ("forming", 0.0)
    assert_allclose(unpack_floats(state.errors), 0.0, atol=1e-6)
    start = unpack_floats(state.points, 2)
    for _ in range(200):
        driver.odometries({robot: odometry(pose) for robot, pose in off.items()})
        commands, state = driver.tick(100)
    assert state.phase == "forming"  # nobody has moved
    assert_allclose(unpack_floats(state.points, 2), PLACES, atol=1e-6)
    assert np.hypot(*(start - PLACES)[0]) > 0.3
    driver.odometries()
    driver.tick(100)
    driver.odometries()
    assert driver.tick(100)[1].phase == "running"
    assert set(commands) == set(driver.ids)


def test_the_planner_decides_who_takes_which_place() -> None:
    """The robots stand at the places in reverse order."""
    swapped = replace(
        scenario(planning=Planning(method="optimal")),
        robots=tuple(
            replace(robot, pose=other.pose)
            for robot, other in zip(scenario().robots, reversed(scenario().robots), strict=True)
        ),
    )
    driver = Driver(swapped)
    driver.odometries()
    _, state = driver.tick()
    assert state.chain == ("r4", "r3", "r2", "r1")
    assert_allclose(unpack_floats(state.errors), 0.0, atol=1e-6)


def goal(driver: Driver, **wanted: Any) -> FormationState:
    driver.say(topics.FORMATION_GOAL, Goal(source="operator", id=f"g{driver.now}", **wanted))
    driver.odometries()
    return driver.tick(100)[1]


def test_the_platoon_holds_and_goes_on_when_told() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    state = goal(driver, hold=True)
    assert (state.phase, state.reason, state.goal_refused) == ("holding", "told to hold", "")
    assert state.goal == f"g{driver.now - 100 * MILLISECOND}"
    before = state.task_time_s
    driver.odometries()
    commands, state = driver.tick(100)
    assert state.task_time_s == before
    assert set(commands) == set(driver.ids)
    state = goal(driver, hold=False)
    assert (state.phase, state.reason) == ("running", "")
    assert state.task_time_s == pytest.approx(before + 0.1)


def test_a_latched_goal_that_comes_again_is_not_taken_twice() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    hold = Goal(source="operator", id="one", hold=True)
    driver.say(topics.FORMATION_GOAL, hold)
    assert goal(driver, hold=False).phase == "running"
    driver.say(topics.FORMATION_GOAL, Goal(source="operator", id=driver.tick(0)[1].goal, hold=True))
    assert driver.tick(100)[1].phase == "running"


def test_another_task_begins_where_the_reference_is() -> None:
    driver = Driver(scenario())
    driver.odometries()
    for _ in range(30):
        driver.odometries()
        driver.tick(100)
    state = goal(driver, task=Line(start=(2.0, 1.0), end=(2.0, 3.0), speed_mps=0.1))
    poses = [state.reference]
    for _ in range(800):
        driver.odometries()
        poses.append(driver.tick(100)[1].reference)
    steps = np.diff(np.array(poses)[:, :2], axis=0)
    assert np.hypot(*steps.T).max() < 0.02
    assert min(math.dist(pose[:2], (2.0, 1.0)) for pose in poses) < 0.01
    assert poses[-1] == pytest.approx((2.0, 3.0, math.pi / 2))
    assert driver.tick(100)[1].phase == "done"


def test_another_task_that_comes_before_everybody_is_there_begins_where_the_first_would_have() -> None:
    driver = Driver(scenario())
    wanted = Line(start=(2.0, 1.0), end=(2.0, 3.0), speed_mps=0.1)
    driver.say(topics.FORMATION_GOAL, Goal(id="early", task=wanted))
    _, state = driver.tick(100)
    assert (state.phase, state.goal_refused, state.reference) == ("waiting", "", (0.0, 0.0, 0.0))
    driver.odometries()
    _, state = driver.tick(100)
    assert state.reference == pytest.approx((0.0, 0.0, 0.0))
    assert state.phase == "running"
    while state.phase == "running":
        driver.odometries()
        _, state = driver.tick(500)
    assert state.reference == pytest.approx((2.0, 3.0, math.pi / 2))


def test_after_the_end_there_may_be_another_task() -> None:
    driver = Driver(scenario())
    for _ in range(150):
        driver.odometries()
        _, state = driver.tick(100)
    assert state.phase == "done"
    state = goal(driver, task=Positioning(target=(1.0, 0.0, 0.0), tolerance_m=5.0, tolerance_rad=3.0))
    assert state.phase in ("running", "done")
    assert state.reference == pytest.approx((1.0, 0.0, 0.0))


def test_positioning_is_over_when_everybody_has_been_there_for_long_enough() -> None:
    task = Positioning(target=(0.0, 0.0, 0.0), settle_s=1.0)
    driver = Driver(scenario(task=task))
    off = {"r4": odometry(Pose(0.05, 0.0, 0.0))}
    for _ in range(30):
        driver.odometries(off)
        assert driver.tick(100)[1].phase == "running"
    phases = []
    for _ in range(15):
        driver.odometries()
        phases.append(driver.tick(100)[1].phase)
    assert phases == ["running"] * 10 + ["done"] * 5


def test_another_shape_is_taken_on_without_a_jump() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    shape = Formation(shape=Shape(kind="polygon", spacing_m=1.5))
    state = goal(driver, formation=shape)
    assert state.goal_refused == ""
    points = [unpack_floats(state.points, 2)]
    for _ in range(400):
        driver.odometries()
        points.append(unpack_floats(driver.tick(100)[1].points, 2))
    assert np.abs(np.diff(points, axis=0)).max() < 0.02
    sides = [math.dist(a, b) for a, b in combinations(points[-1], 2)]
    assert sorted(sides)[:4] == pytest.approx([1.5] * 4, rel=1e-5)


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        ({"formation": Formation(points=PLACES[:3])}, "4"),
        ({"formation": Formation(points=(PLACES[0],) * 4)}, "singular"),
        ({"task": Line(start=(0.0, 0.0), end=(5.0, 0.0), speed_mps=3.0)}, "too fast"),
    ],
)
def test_an_impossible_goal_is_refused_with_the_reason_and_changes_nothing(
    wanted: dict[str, Any], text: str
) -> None:
    driver, same = Driver(scenario()), Driver(scenario())
    for one in (driver, same):
        one.odometries()
        one.tick()
    refused = goal(driver, **wanted)
    same.odometries()
    _, expected = same.tick(100)
    assert text in refused.goal_refused
    assert replace(refused, goal="", goal_refused="", mission=1) == expected


def test_the_reference_slows_for_a_robot_that_cannot_keep_up() -> None:
    waiting = Waiting(enabled=True, free_m=0.1, stop_m=0.5)
    for off, pace in ((0.05, 1.0), (0.3, 0.5), (0.6, 0.0)):
        driver = Driver(scenario(waiting=waiting))
        late = {"r1": odometry(Pose(-off, 0.0, 0.0))}
        driver.odometries(late)
        driver.tick()
        driver.odometries(late)
        _, state = driver.tick(100)
        assert state.rate == pytest.approx(pace)
        assert state.task_time_s == pytest.approx(0.1 * pace)
        assert state.reference_velocity[0] == pytest.approx(0.1 * pace)


def alive_for(driver: Driver, seconds: float, *names: str) -> tuple[dict[str, Command], FormationState]:
    """Go on with only these robots talking."""
    for _ in range(round(seconds * 10)):
        for robot in names:
            driver.say(topics.odometry(robot), odometry())
        heard = driver.tick(100)
    return heard


def test_a_lost_robot_is_left_out_and_taken_in_again() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    commands, state = alive_for(driver, 2.0, "r1", "r3", "r4")
    assert (state.waits_for, state.task_time_s) == (("r2",), 0.0)
    commands, state = alive_for(driver, 3.0, "r1", "r3", "r4")
    assert state.chain == ("r1", "r3", "r4")
    assert [report.state for report in state.roster] == ["present", "lost", "present", "present"]
    assert set(commands) == {"r1", "r3", "r4"}
    assert_allclose(unpack_floats(state.points, 2), [PLACES[0], PLACES[2], PLACES[3]])
    assert len(unpack_floats(state.errors, 6)) == 1
    assert state.task_time_s > 1.0
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=True))
    assert alive_for(driver, 0.9, *driver.ids)[1].chain == ("r1", "r3", "r4")
    commands, state = alive_for(driver, 0.3, *driver.ids)
    assert state.chain == driver.ids
    assert set(commands) == set(driver.ids)


def test_with_fewer_than_three_robots_everybody_stands_and_the_state_says_so() -> None:
    driver = Driver(scenario())
    driver.odometries()
    driver.tick()
    commands, state = alive_for(driver, 6.0, "r1", "r3")
    assert (state.phase, state.chain) == ("holding", ("r1", "r3"))
    assert state.reason == "2 robots are left; a formation needs 3"
    assert {name: command.values for name, command in commands.items()} == {"r1": (0, 0), "r3": (0, 0)}
    assert state.errors == b""
    _, state = alive_for(driver, 1.5, *driver.ids)
    assert state.phase == "running"
    assert state.chain == driver.ids


def test_no_dynamics_are_learnt_from_a_robot_that_is_held_back_or_not_heard() -> None:
    """All are 0.3 m behind their places and do not move."""

    def learnt(state: FormationState) -> list[tuple[float, ...]]:
        return [robot.compensation for robot in state.roster]

    off = Avoidance(enabled=False)
    driver = Driver(scenario("drive", avoidance=off, compensation=Compensation(enabled=True)))
    behind = {name: odometry(Pose(-0.3, 0.0, 0.0)) for name in driver.ids}
    for guard, learns in (
        ("none", True),
        ("acceleration", True),
        ("clearance", False),
        ("age", False),
        ("fence", False),
    ):
        driver.mode("r1", "tracking", guard)
        states = []
        for _ in range(10):
            driver.odometries(behind)
            states.append(learnt(driver.tick(100)[1]))
        assert (states[0][0] != states[-1][0]) is learns, guard
        assert all(a != b for a, b in zip(states[0][1:], states[-1][1:], strict=True))
    driver.mode("r1", "tracking")
    before, after = (learnt(alive_for(driver, 1.2, "r2", "r3", "r4")[1])[0] for _ in range(2))
    assert before == after


def test_after_a_stand_the_layers_begin_anew() -> None:
    steps = []

    class Noting:
        parameters = ()

        def step(self, desired: Velocity, measured: Velocity, free: bool, dt_s: float) -> Velocity:
            steps.append(dt_s)
            return desired

    made = scenario(
        "drive",
        avoidance=Avoidance(enabled=False),
        compensation=Compensation(enabled=True, law="noting"),
    )
    driver = Driver(made, parts=BUILTIN._replace(compensation={"noting": lambda *_: Noting()}))
    driver.tick(100)
    driver.odometries()
    alive_for(driver, 0.2, *driver.ids)
    assert steps == [0.0] * 4 + [0.1] * 4
    alive_for(driver, 6.0, "r1", "r3")
    alive_for(driver, 1.0, *driver.ids)
    steps.clear()
    alive_for(driver, 0.2, *driver.ids)
    assert steps == [0.0] * 4 + [0.1] * 4


@pytest.mark.parametrize("build", ["off", "straight"])
def test_on_a_robot_it_works_in_that_robots_frame_and_tells_everybody_the_same(build: Any) -> None:
    off = {"r1": odometry(Pose(0.1, 0.2, 0.0)), "r3": odometry(Pose(-0.1, 0.1, 0.0))}
    heard = {}
    for host in (None, "r2"):
        driver = Driver(scenario("drive", controller=Controller(host=host), planning=Planning(build=build)))
        for _ in range(10):
            driver.odometries(off)
            driver.scans()
            heard[host] = driver.tick(100)
    for robot in driver.ids:  # the law saturates x and y apart, so the frame is not quite indifferent
        central, onboard = heard[None][0][robot], heard["r2"][0][robot]
        assert onboard.values == pytest.approx(central.values, abs=2e-3)
    assert heard["r2"][1].frame == "r2"
    frame = Pose(*driver.node._roster.frame)
    assert frame.compose(Pose(*heard["r2"][1].reference)) == pytest.approx(heard[None][1].reference)


def test_a_triangle_may_lean_on_its_neighbours() -> None:
    """With r2 off its place, r4, whose triangle leans on it, is told to go elsewhere."""
    told = {}
    for reference in ("formation", "neighbours"):
        driver = Driver(scenario(controller=Controller(reference=reference)))
        driver.odometries({"r2": odometry(Pose(0.3, 0.0, 0.0))})
        told[reference], _ = driver.tick()
    assert told["formation"]["r2"].values == pytest.approx(told["neighbours"]["r2"].values)
    assert told["formation"]["r4"].values != pytest.approx(told["neighbours"]["r4"].values, abs=0.005)


def test_robots_of_one_kind_exchange_their_places_instead_of_passing_each_other() -> None:
    """r3 and r4 stand where the other belongs."""
    swapped = list(scenario().robots)
    swapped[2], swapped[3] = (
        replace(swapped[2], pose=swapped[3].pose),
        replace(swapped[3], pose=swapped[2].pose),
    )
    for allowed, chain in ((True, ("r1", "r2", "r4", "r3")), (False, ("r1", "r2", "r3", "r4"))):
        driver = Driver(scenario(robots=tuple(swapped), supervisor=Supervisor(exchange=allowed)))
        driver.odometries()
        _, state = driver.tick()
        assert state.chain == chain
        assert (np.abs(unpack_floats(state.errors)).max() < 1e-6) == allowed


def test_a_robot_that_does_not_get_to_its_place_is_not_waited_for_for_ever() -> None:
    driver = Driver(scenario(planning=Planning(build="straight", patience_s=5.0)))
    off = {"r1": odometry(Pose(0.1, 0.0, 0.0))}
    driver.odometries(off)
    phases = [driver.tick()[1].phase]
    while phases[-1] == "forming":
        driver.odometries(off)
        phases.append(driver.tick(100)[1].phase)
    lasts = 1.875 * 0.1 / 0.1
    assert len(phases) == pytest.approx(10 * (lasts + 5.0), abs=3)


def test_a_formation_that_is_being_built_is_built_on_when_a_robot_is_lost_and_when_it_is_back() -> None:
    """Along straight ways, from where the robots are then."""
    driver = Driver(scenario(planning=Planning(build="straight", speed_mps=0.01)))
    off = {"r1": odometry(Pose(0.5, 0.0, 0.0)), "r2": odometry(Pose(0.5, 0.0, 0.0))}
    others = tuple(name for name in driver.ids if name != "r4")

    def go_on(seconds: float, names: tuple[str, ...]) -> FormationState:
        for _ in range(round(10 * seconds)):
            for name in names:
                driver.say(topics.odometry(name), off.get(name, odometry()))
            state = driver.tick(100)[1]
        return state

    assert np.abs(unpack_floats(go_on(0.1, driver.ids).errors)).max() < 1e-6
    driver.say(topics.HOST_ALIVE, Alive(node="r4", node_incarnation=1, alive=False))
    state = go_on(3.3, others)
    assert state.chain == ("r1", "r2", "r3")
    assert np.abs(unpack_floats(state.errors)).max() < 0.01
    driver.say(topics.HOST_ALIVE, Alive(node="r4", node_incarnation=1, alive=True))
    state = go_on(1.2, driver.ids)
    assert (state.chain, state.phase) == (driver.ids, "forming")
    assert np.abs(unpack_floats(state.errors)).max() < 0.01
    assert np.abs(unpack_floats(state.points, 2) - PLACES).max() > 0.4


def test_what_stands_because_its_law_has_failed_says_that_it_stands() -> None:
    class Law:
        """Fails at the third step."""

        def __init__(self, parameters: Controller) -> None:
            self.steps = 0

        def rates(self, desired_rates: Any, errors: Any, dt_s: float) -> Any:
            self.steps += 1
            return desired_rates if self.steps < 3 else None

    parts = BUILTIN._replace(formation_laws={"mine": Law})
    driver = Driver(scenario(controller=Controller(law="mine")), parts=parts)
    for _ in range(4):
        driver.odometries()
        commands, state = driver.tick(100)
    assert (state.phase, state.rate, state.reference_velocity) == ("holding", 0.0, (0.0, 0.0, 0.0))
    assert {command.values for command in commands.values()} == {(0.0, 0.0)}
