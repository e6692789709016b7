import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.testing import assert_allclose

from central_controller.node import CONTROL, PHASES, CentralController
from maniple.control import unicycle
from maniple.core import codec, topics
from maniple.core.geometry import Pose
from maniple.core.messages import (
    Alive,
    Command,
    FormationState,
    Layer,
    Mode,
    Odometry,
    Refused,
    Scan,
    Stamp,
    Status,
    pack_floats,
    unpack_floats,
)
from maniple.core.node import Node, Outgoing, Received
from maniple.core.scenario.types import Avoidance, Formation, Line, Placement, Robot, Scenario
from maniple.core.time import MILLISECOND, SECOND, Time

T0 = 1000 * SECOND
A = 0.3
PLACES = ((1.0, 0.0), (0.0, 0.8), (0.0, -0.8), (-1.0, 0.8))
HEADINGS = (0.0, 0.5, -2.0, 3.0)
"""Of the robots at the start."""
ORIGIN = Pose(0.0, 0.0, 0.0)


def scenario(robot_from: Layer = "kinematics", **changes: Any) -> Scenario:
    """Four robots whose control points stand at their places, each with a heading of its own."""
    robots = tuple(
        Robot(
            id=f"r{k + 1}",
            control_point_m=A,
            pose=(x - A * math.cos(psi), y - A * math.sin(psi), psi),
        )
        for k, ((x, y), psi) in enumerate(zip(PLACES, HEADINGS, strict=True))
    )
    made = Scenario(
        name="test",
        robots=robots,
        formation=Formation(points=PLACES),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1, settle_s=2.0),
        placement=Placement(robot_from=robot_from),
    )
    return replace(made, **changes)


def odometry(own: Pose = ORIGIN, seq: int = 0, **velocity: float) -> Odometry:
    return Odometry(
        incarnation=1,
        seq=seq,
        stamp_ns=40 + seq,
        frame_id="own",
        x_m=own.x,
        y_m=own.y,
        psi_rad=own.psi,
        u_mps=velocity.get("u", 0.0),
        w_radps=velocity.get("w", 0.0),
    )


def scan(nearest_m: float = 8.0, bearing_rad: float = 0.0) -> Scan:
    bearings = np.linspace(-math.pi / 2, math.pi / 2, 181)
    ranges = np.where(np.abs(bearings - bearing_rad) < 0.2, nearest_m, 8.0)
    return Scan(
        first_angle_rad=-math.pi / 2,
        increment_rad=math.radians(1.0),
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.0, 0.0, 0.0),
        ranges=pack_floats(ranges),
    )


class Driver:
    """Speaks for all robots and listens to the controller."""

    def __init__(self, made: Scenario, now: Time = T0) -> None:
        self.node = CentralController(made)
        self.ids = tuple(robot.id for robot in made.robots)
        self.now = now
        for robot in self.ids:
            self.say(topics.HOST_ALIVE, Alive(node=robot, node_incarnation=1, alive=True))
            self.mode(robot, "tracking")

    def odometries(self, poses: Mapping[str, Odometry] | None = None) -> None:
        for robot in self.ids:
            self.say(topics.odometry(robot), (poses or {}).get(robot, odometry()))

    def scans(self, **scans: Scan) -> None:
        for robot in self.ids:
            self.say(topics.ranges(robot), scans.get(robot, scan()))

    def mode(self, robot: str, mode: Mode) -> None:
        status = Status(
            mode=mode,
            guard="none",
            command_age_s=-1.0,
            command_age_max_s=-1.0,
            driver="active",
            reason="",
            counters={},
        )
        self.say(topics.status(robot), status)

    def say(self, topic: str, message: Any) -> None:
        assert self.node.on_message(Received(topic, message), self.now) == []

    def tick(self, after_ms: float = 0.0) -> tuple[dict[str, Command], FormationState]:
        self.now += round(after_ms * MILLISECOND)
        return heard(self.node.on_timer(CONTROL, self.now))


def heard(sent: list[Outgoing]) -> tuple[dict[str, Command], FormationState]:
    """Commands by robot and the state, each a valid message of its topic."""
    commands = {}
    for topic, message in sent[:-1]:
        assert isinstance(message, Command)
        assert codec.decode(topic, codec.encode(message)) == message
        commands[topic.split("/")[1]] = message
    topic, state = sent[-1]
    assert topic == topics.FORMATION_STATE
    assert isinstance(state, FormationState)
    assert codec.decode(topic, codec.encode(state)) == state
    return commands, state


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
    wanted |= {"host/alive", "host/refused"}
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
    assert len(unpack_floats(state.errors, 6)) == 2
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


@pytest.mark.parametrize("event", ["ready", "ended"])
@pytest.mark.parametrize("phase", ["waiting", "running", "done"])
def test_phases_only_go_forward(phase: Any, event: Any) -> None:
    order = ["waiting", "running", "done"]
    following = {("waiting", "ready"): "running", ("running", "ended"): "done"}
    assert PHASES.get((phase, event)) == following.get((phase, event))
    assert order.index(PHASES.get((phase, event), phase)) >= order.index(phase)


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
    assert commands["r2"].answers == Stamp(incarnation=1, seq=2, stamp_ns=42)
    assert commands["r4"].answers == Stamp(incarnation=1, seq=0, stamp_ns=40)
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
    commands, state = driver.tick()
    assert state.phase == "running"
    assert commands["r2"].answers.incarnation == 2


def test_what_was_said_by_a_robot_that_is_gone_does_not_start_the_task() -> None:
    driver = Driver(scenario())
    driver.say(topics.HOST_ALIVE, Alive(node="r2", node_incarnation=1, alive=False))
    driver.odometries()
    assert driver.tick()[1].phase == "waiting"
