"""`maniple vehicle`: the process that shows a robot of the simulator as a vehicle."""

from typing import Any

from maniple.cli.node_commands import joined, robot_named, run_host, scenario_given
from maniple.core import edges
from maniple.core.errors import ScenarioError
from simulator.vehicles import vehicle_of
from simulator.vehicles.process import VehicleHost


def run(robot: str, scenario: str, **options: Any) -> None:
    """Run the vehicle of a robot; `options` are those of `joined`.

    Raises:
        ManipleError: it can't be run.
    """
    resolved, watch = scenario_given(scenario)
    one = robot_named(robot, resolved)
    if not edges.has_vehicle(one):
        shown = [other.id for other in resolved.robots if edges.has_vehicle(other)]
        who = f"those that are: {', '.join(shown)}" if shown else "no robot of this scenario is"
        raise ScenarioError(f"robots.{robot}.presents = {one.presents!r}: it is shown as no vehicle; {who}")
    vehicle = vehicle_of(resolved, one, options["hardware"] or options["connect"])
    name = edges.vehicle_of(robot)
    with joined(name, resolved, **options) as place:
        if place is None:
            return
        life, clock, fleet, hardware = place
        host = VehicleHost(vehicle, robot, life, resolved, clock, fleet, hardware)
        run_host(name, host, fleet, watch)
