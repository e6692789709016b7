"""Which nodes a scenario runs."""

from collections.abc import Callable, Mapping
from functools import partial

from central_controller.node import CentralController
from central_controller.reference import Course
from maniple.cli.extensions import parts_of
from maniple.core.node import Node
from maniple.core.scenario.types import Scenario
from robot_agent.node import RobotAgent
from simulator.node import Simulator

RUNDOWN_S = 1.5
"""How long the simulator goes on after the robots were stopped, so that the recording shows them stand, s."""


def factories(scenario: Scenario) -> Mapping[str, Callable[[int], Node]]:
    """What makes each node of a scenario, given its incarnation, by name; each looks for its layers itself,
    and raises `ScenarioError` if one is not installed."""
    robots: dict[str, Callable[[int], Node]] = {
        robot.id: partial(_agent, scenario, robot.id) for robot in scenario.robots
    }
    return {
        "simulator": lambda _: Simulator(scenario),
        "controller": lambda _: CentralController(scenario, parts_of(scenario)),
        **robots,
    }


def _agent(scenario: Scenario, robot: str, incarnation: int) -> RobotAgent:
    return RobotAgent(scenario, robot, incarnation, parts_of(scenario, on_robot=True))


def time_limit_s(scenario: Scenario, duration_s_asked: float | None) -> float:
    """When a run is ended that has not ended by itself, in simulated time."""
    if duration_s_asked is not None:
        return duration_s_asked
    return 3.0 * Course(scenario.task, scenario.controller).total_s + 60.0
