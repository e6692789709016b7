"""`maniple vehicle ID`: the process that shows a robot of the simulator as a vehicle."""

from typing import Any

ABOUT = "Show a robot of the simulator as the vehicle that its scenario says it presents."


def run(robot: str, scenario: str, **options: Any) -> None:
    """Run the vehicle of one robot.

    Raises:
        ManipleError: it can't be run.
    """
    from maniple.cli import node_commands as shared
    from maniple.cli.interrupt import on_interrupt
    from maniple.core import edges
    from maniple.core.errors import ScenarioError
    from maniple.host.ending import end_when_asked
    from maniple.host.fate import say
    from maniple.host.joining import await_router, claim, clock_of
    from simulator.vehicles import vehicle_of
    from simulator.vehicles.process import VehicleHost

    resolved, watch = shared._scenario(scenario)
    shown = {one.id: one for one in resolved.robots if edges.has_vehicle(one)}
    if robot not in shown:
        there = f"robots that are: {', '.join(shown)}" if shown else "none is"
        raise ScenarioError(f"robot {robot!r} is not presented as a vehicle (robots.presents); {there}")
    name = edges.vehicle_of(robot)
    hardware = options["hardware"] or options["connect"]
    vehicle = vehicle_of(resolved, shown[robot], hardware)
    told = shared._clock(options["anchor"])
    with shared._networks(resolved, options["connect"], hardware, options["wait"]) as (fleet, wired):
        await_router(fleet)
        life = claim(fleet, name, options["incarnation"], resolved.network.lease_s + shared.CUT_OFF_S)
        host = VehicleHost(vehicle, robot, life, resolved, told or clock_of(fleet), fleet, wired)
        if watch is shared._nobody:
            end_when_asked(fleet, name, host.stop)
        with on_interrupt(host.stop):
            watch(host.stop)
            host.run()
    if host.refused:
        counts = ", ".join(f"{number} {why}" for why, number in sorted(host.refused.items()))
        say(f"refused: {counts}")
