"""`maniple vehicle ID`: the process that shows a robot of the simulator as a vehicle."""

from typing import Any

ABOUT = "Show a robot of the simulator as the vehicle that its scenario says it presents."


def run(robot: str, scenario: str, **options: Any) -> None:
    """Run the vehicle of one robot.

    Raises:
        ManipleError: it can't be run.
    """
    from maniple.cli import node_commands as shared
    from maniple.core import edges
    from maniple.core.errors import ScenarioError
    from maniple.host.fate import say
    from simulator.vehicles import vehicle_of
    from simulator.vehicles.process import VehicleHost

    resolved, watch = shared.scenario_given(scenario)
    shown = {one.id: one for one in resolved.robots if edges.has_vehicle(one)}
    if robot not in shown:
        there = f"robots that are: {', '.join(shown)}" if shown else "none is"
        raise ScenarioError(f"robot {robot!r} is not presented as a vehicle (robots.presents); {there}")
    name = edges.vehicle_of(robot)
    vehicle = vehicle_of(resolved, shown[robot], options["hardware"] or options["connect"])
    with shared.joined(name, resolved, **options) as place:
        if place is None:
            return
        life, clock, fleet, wired = place
        host = VehicleHost(vehicle, robot, life, resolved, clock, fleet, wired)
        shared.run_host(name, host, fleet, watch)
    if host.refused:
        counts = ", ".join(f"{number} {why}" for why, number in sorted(host.refused.items()))
        say(f"refused: {counts}")
