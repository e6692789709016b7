"""`maniple driver run`: the process of a robot's driver."""

from typing import Any

from maniple.cli.extensions import drivers_of
from maniple.cli.node_commands import joined, robot_named, run_host, scenario_given
from maniple.core import edges
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.types import Robot
from robot_agent.drivers.process import DriverHost


def run(robot: str, scans: bool, scenario: str, **options: Any) -> None:
    """Run the driver of a robot, or the one that only brings its `scans`; `options` are those of `joined`.

    Raises:
        ManipleError: it can't be run.
    """
    resolved, watch = scenario_given(scenario)
    one = robot_named(robot, resolved)
    kind = _kind(one, scans)
    factory = drivers_of(resolved, (one,))[kind]
    endpoint = options["hardware"] or options["connect"]
    name = edges.scanner_of(robot) if scans else edges.driver_of(robot)
    with joined(name, resolved, **options) as place:
        if place is None:
            return
        life, clock, fleet, hardware = place
        if clock.speed != 1.0:
            raise ArgumentError(
                f"{name}: the run goes at {clock.speed:g} times the wall clock; hardware goes at 1"
            )
        host = DriverHost(
            lambda: factory(resolved, one, endpoint), one, name, life, resolved, clock, fleet, hardware
        )
        run_host(name, host, fleet, watch)


def _kind(robot: Robot, scans: bool) -> str:
    """The name of the driver that is asked for."""
    if scans:
        if edges.has_scanner(robot):
            return robot.scans
        raise ScenarioError(
            f"robots.{robot.id}.scans = {robot.scans!r}: no driver of its own brings its scans"
        )
    if edges.has_driver(robot):
        return robot.driver
    raise ScenarioError(
        f"robots.{robot.id}.driver = {robot.driver!r}: the simulator is no process of its own; "
        "must be another driver to run one (see maniple driver list)"
    )
