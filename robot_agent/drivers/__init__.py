"""What stands between an agent and its hardware."""

from collections.abc import Mapping

from maniple.core.edges import SIMULATOR
from maniple.core.errors import ScenarioError
from maniple.core.scenario.types import Robot, Scenario
from robot_agent.drivers import simulator
from robot_agent.drivers.interface import Capabilities, DriverFactory
from robot_agent.drivers.mavlink.driver import MavlinkDriver
from robot_agent.drivers.ros2.driver import Ros2Driver

BUILTIN: Mapping[str, DriverFactory] = {
    "mavlink": MavlinkDriver,
    "ros2": Ros2Driver,
}
"""Drivers that are part of this program, by the names that scenarios use. The simulator is a node."""


def capabilities_of(
    scenario: Scenario, robot: Robot, drivers: Mapping[str, DriverFactory] = BUILTIN
) -> Capabilities:
    """What the driver of a robot of a resolved scenario can do, known before it is connected.

    Raises:
        ScenarioError: there is no such driver among `drivers`, or the robot's parameters do not suit it.
    """
    if robot.driver == SIMULATOR:
        return simulator.capabilities(scenario, robot)
    if robot.driver not in drivers:
        known = ", ".join(sorted({SIMULATOR, *drivers}))
        raise ScenarioError(
            f"robots: {robot.id}: driver = {robot.driver!r}: not installed; there are {known}"
        )
    return drivers[robot.driver](scenario, robot).capabilities
