"""What a simulated body may show itself as."""

from collections.abc import Mapping

from maniple.core.errors import ScenarioError
from maniple.core.scenario.types import Robot, Scenario
from simulator.vehicles import mavlink
from simulator.vehicles.interface import Vehicle, VehicleFactory
from simulator.vehicles.ros2 import Ros2Vehicle

BUILTIN: Mapping[str, VehicleFactory] = {
    "mavlink": mavlink.vehicle,
    "ros2": Ros2Vehicle,
}
"""By the names that scenarios use in `robots.presents`."""


def vehicle_of(scenario: Scenario, robot: Robot, endpoint: str = "") -> Vehicle:
    """The vehicle that a robot of a resolved scenario is presented as.

    Raises:
        ScenarioError: it is presented as nothing, or its parameters do not suit what it is presented as.
    """
    if robot.presents not in BUILTIN:
        known = ", ".join(sorted(BUILTIN))
        raise ScenarioError(
            f"robots: {robot.id}: presents = {robot.presents!r}: it is shown as no vehicle; "
            f"a scenario may choose {known}"
        )
    return BUILTIN[robot.presents](scenario, robot, endpoint)
