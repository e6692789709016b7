"""The node with ideal unicycles: exact motion, no delay, every robot dead-reckoning in its own frame."""

import math

import numpy as np
import pytest

from central_controller.node import CONTROL, CentralController
from maniple.control import unicycle
from maniple.core import topics
from maniple.core.geometry import Floats, Pose
from maniple.core.layers import Layer
from maniple.core.messages import Alive, Command, FormationState, Odometry, Status, unpack_floats
from maniple.core.node import Received
from maniple.core.scenario.types import Avoidance, Formation, Line, Placement, Robot, Scenario
from maniple.core.streams import stream
from maniple.core.time import SECOND
from tests.pioneer import PIONEER

A = 0.2
DT_S = 0.1
END = (4.0, 3.0)
TRACKING = Status(
    mode="tracking",
    guard="none",
    command_age_s=0.0,
    command_age_max_s=0.0,
    driver="active",
    reason="",
    counters={},
)


def scattered(n: int, robot_from: Layer) -> Scenario:
    """n robots, two abreast, up to 0.5 m and 0.6 rad off."""
    rng = stream(n, "start")
    places = tuple((-0.8 * k, 0.6 if k % 2 else -0.6) for k in range(n))
    start = Pose(0.0, 0.0, math.atan2(END[1], END[0]))
    robots = []
    for k, (x, y) in enumerate(places):
        place = start.compose(Pose(x, y, 0.0))
        dx, dy, turn = rng.uniform((-0.35, -0.35, -0.6), (0.35, 0.35, 0.6)).tolist()
        robots.append(
            Robot(id=f"r{k}", control_point_m=A, pose=(place.x + dx, place.y + dy, start.psi + turn))
        )
    return Scenario(
        name="loop",
        robots=tuple(robots),
        formation=Formation(points=places),
        task=Line(start=(0.0, 0.0), end=END, speed_mps=0.1, settle_s=40.0),
        avoidance=Avoidance(enabled=False),
        placement=Placement(robot_from=robot_from),
        models={"pioneer-3dx": PIONEER},
    )


def run(scenario: Scenario) -> tuple[Floats, FormationState]:
    """Until the controller says it is done: the control points as they really are, and its last state."""
    node = CentralController(scenario)
    own = {robot.id: (Pose(0.0, 0.0, 0.0), 0.0, 0.0) for robot in scenario.robots}
    for robot in own:
        there = Alive(node=robot, node_incarnation=0, alive=True)
        node.on_message(Received(topics.HOST_ALIVE, there), 0)
        node.on_message(Received(topics.status(robot), TRACKING), 0)
    for k in range(1200):
        now = 10 * SECOND + k * round(DT_S * SECOND)
        for robot, (pose, u, w) in own.items():
            said = Odometry(
                seq=k,
                stamp_ns=now,
                frame_id=robot,
                x_m=pose.x,
                y_m=pose.y,
                psi_rad=pose.psi,
                u_mps=u,
                w_radps=w,
            )
            node.on_message(Received(topics.odometry(robot), said), now)
        *sent, (_, state) = node.on_timer(CONTROL, now)
        commands = [command for _, command in sent if isinstance(command, Command)]
        for command, robot in zip(commands, own, strict=True):
            pose, u, w = own[robot][0], *command.values
            if command.layer == "kinematics":
                u, w = unicycle.inverse(pose.psi, A, u, w)
            own[robot] = (pose.advance(u * DT_S, w * DT_S), u, w)
        assert isinstance(state, FormationState)
        if state.phase == "done":
            return control_points(scenario, {robot: pose for robot, (pose, _, _) in own.items()}), state
    raise AssertionError("never done")


def control_points(scenario: Scenario, own: dict[str, Pose]) -> Floats:
    """Where they are in the formation frame, from where each robot is in its own."""
    initial = [Pose(*robot.pose) for robot in scenario.robots if robot.pose is not None]
    here = [start.compose(pose) for start, pose in zip(initial, own.values(), strict=True)]
    return np.array([unicycle.control_point(pose, A) for pose in here])


@pytest.mark.parametrize("n", [3, 6])
@pytest.mark.parametrize("robot_from", ["kinematics", "drive"])
def test_scattered_unicycles_end_in_formation(n: int, robot_from: Layer) -> None:
    scenario = scattered(n, robot_from)
    points, state = run(scenario)
    end = Pose(*END, math.atan2(END[1], END[0]))
    expected = [end.compose(Pose(x, y, 0.0))[:2] for x, y in scenario.formation.points]
    assert state.phase == "done"
    assert np.abs(points - expected).max() < 1e-3
    assert np.abs(unpack_floats(state.errors, 6)).max() < 1e-3


def test_a_robot_that_starts_on_the_other_side_changes_sides() -> None:
    """A mirrored leader triangle unfolds into the desired one."""
    scenario = scattered(3, "kinematics")
    first, second, third = scenario.robots
    swapped = (
        first,
        Robot(id=second.id, control_point_m=A, pose=third.pose),
        Robot(id=third.id, control_point_m=A, pose=second.pose),
    )
    mirrored = Scenario(
        name="mirrored",
        robots=swapped,
        formation=scenario.formation,
        task=scenario.task,
        avoidance=scenario.avoidance,
        placement=scenario.placement,
        models=scenario.models,
    )
    points, _ = run(mirrored)
    end = Pose(*END, math.atan2(END[1], END[0]))
    expected = [end.compose(Pose(x, y, 0.0))[:2] for x, y in scenario.formation.points]
    assert np.abs(points - expected).max() < 0.01
