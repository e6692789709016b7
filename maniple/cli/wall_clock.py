"""Scenarios with hardware go by the wall clock only."""

from collections.abc import Iterator

from maniple.core import edges
from maniple.core.errors import ArgumentError
from maniple.core.scenario.types import Robot, Scenario


def require_simulated(scenario: Scenario, what: str) -> None:
    """Refuse what can't be done with hardware, nor with vehicles that behave like it.

    Raises:
        ArgumentError: a driver of its own drives a robot of the scenario; says which one, and what would make
            it a simulated one.
    """
    wired = [robot for robot in scenario.robots if edges.has_driver(robot) or edges.has_scanner(robot)]
    if not wired:
        return
    told = ", ".join(f"{robot.id} ({', '.join(_drivers(robot))})" for robot in wired)
    changes = " ".join(f"--set robots.{robot.id}.{change}" for robot in wired for change in _changes(robot))
    raise ArgumentError(
        f"{what}: drivers of their own go by the wall clock, at its speed: of {told}; "
        f"run it as it is, or simulate these robots: {changes}"
    )


def _drivers(robot: Robot) -> Iterator[str]:
    if edges.has_driver(robot):
        yield f"driver = {robot.driver!r}"
    if edges.has_scanner(robot):
        yield f"scans = {robot.scans!r}"


def _changes(robot: Robot) -> Iterator[str]:
    """What makes it a simulated one."""
    if edges.has_driver(robot):
        yield f"driver={edges.SIMULATOR}"
    if edges.has_vehicle(robot):
        yield "presents=nothing"
    if robot.scans:
        yield f"scans={edges.SIMULATOR}"
