"""Which nodes a scenario runs."""

import math
from collections.abc import Callable, Mapping
from functools import partial

from central_controller.node import CentralController
from central_controller.planning import STRAIGHT
from central_controller.reference import Course
from maniple.cli.extensions import drivers_of, parts_of
from maniple.control.unicycle import control_point
from maniple.core.edges import simulated
from maniple.core.geometry import Pose
from maniple.core.node import Node
from maniple.core.scenario.places import start_pose
from maniple.core.scenario.types import Positioning, Robot, Scenario
from robot_agent.node import RobotAgent
from simulator.node import Simulator

RUNDOWN_S = 1.5
"""How long the simulator goes on after the robots were stopped, so that the recording shows them stand, s."""


def factories(scenario: Scenario, digest: str = "") -> Mapping[str, Callable[[int], Node]]:
    """What makes each node of a scenario, given its incarnation, by name; each looks for its layers and
    drivers itself, and raises `ScenarioError` if one is not installed. Where no robot has a body in it there
    is no simulator. `digest` is what the nodes call their scenario among each other; by default its own."""
    robots: dict[str, Callable[[int], Node]] = {
        robot.id: partial(_agent, scenario, robot, digest) for robot in scenario.robots
    }
    world: dict[str, Callable[[int], Node]] = {"simulator": lambda _: Simulator(scenario)}
    return {
        **(world if simulated(scenario) else {}),
        "controller": lambda incarnation: CentralController(
            scenario, parts_of(scenario), incarnation, digest
        ),
        **robots,
    }


def _agent(scenario: Scenario, robot: Robot, digest: str, incarnation: int) -> RobotAgent:
    parts, drivers = parts_of(scenario, on_robot=True), drivers_of(scenario, (robot,))
    return RobotAgent(scenario, robot.id, incarnation, parts, drivers, digest)


def time_limit_s(scenario: Scenario, duration_s_asked: float | None) -> float:
    """When a run of a resolved scenario is ended that has not ended by itself, in simulated time."""
    if duration_s_asked is not None:
        return duration_s_asked
    task_s = Course(scenario.task, scenario.controller).total_s
    return 3.0 * (_building_s(scenario) + task_s) + 60.0


def _building_s(scenario: Scenario) -> float:
    """How long the formation may take to be built, whoever takes which place."""
    planning = scenario.planning
    if planning.build == "off":
        return 0.0
    frame = start_pose(scenario.task)
    places = [frame.compose(Pose(x, y, 0.0)) for x, y in scenario.formation.points]
    starts = [
        control_point(Pose(*robot.pose), robot.control_point_m) for robot in scenario.robots if robot.pose
    ]
    longest_m = max(math.dist(start, place[:2]) for start in starts for place in places)
    if planning.build == "straight":
        return STRAIGHT * longest_m / planning.speed_mps + planning.patience_s
    way = Positioning(
        target=(longest_m, 0.0, math.pi),
        tolerance_m=planning.tolerance_m,
        tolerance_rad=planning.tolerance_rad,
    )
    return Course(way, scenario.controller).total_s
