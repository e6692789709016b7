"""What stands between an agent and its hardware."""

from maniple.core.scenario.types import Robot, Scenario
from robot_agent.drivers import simulator
from robot_agent.drivers.interface import Capabilities

_CAPABILITIES = {"simulator": simulator.capabilities}


def capabilities_of(scenario: Scenario, robot: Robot) -> Capabilities:
    """What the driver of a robot of a resolved scenario can do, known before it is connected."""
    return _CAPABILITIES[robot.driver](scenario, robot)
