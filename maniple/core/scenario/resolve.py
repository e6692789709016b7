"""A scenario with everything filled in that it leaves to catalogues, defaults and chance."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Pose, wrap
from maniple.core.presets import with_preset
from maniple.core.scenario.parse import type_problems
from maniple.core.scenario.places import start_pose
from maniple.core.scenario.shapes import pointed
from maniple.core.scenario.types import (
    Fault,
    Mavlink,
    Parameters,
    PoseXY,
    RangeFinder,
    Robot,
    RobotModel,
    Scenario,
    Start,
)
from maniple.core.streams import stream

P = TypeVar("P", bound=Parameters)


def resolve(
    scenario: Scenario, models: Mapping[str, RobotModel], sensors: Mapping[str, RangeFinder]
) -> Scenario:
    """The scenario with every referenced type of robot and range finder in it, a place and a pose for every
    robot, and the numbers of every preset.

    Entries of the scenario win over those of the catalogues `models` and `sensors`. A scenario that is
    resolved already comes back unchanged.

    Raises:
        ScenarioError: wrong types or numbers that are not finite, a type that is in neither, a robot
            with neither a pose nor a point of the formation, a preset that there
            is not, or a task whose file has not been loaded.
    """
    if found := type_problems(scenario):
        raise ScenarioError("\n".join(found))
    scenario = msgspec.convert(
        msgspec.to_builtins(scenario), Scenario
    )  # lists given for tuples, and the like
    scenario = replace(scenario, formation=pointed(scenario.formation, len(scenario.robots)))
    if any(robot.pose is None for robot in scenario.robots):
        require_points(scenario)
    known_models = _referenced("model", scenario, scenario.models, models)
    known_sensors = _referenced("sensor", scenario, scenario.sensors, sensors)
    frame = start_pose(scenario.task)
    robots = tuple(
        replace(robot, pose=initial_pose(scenario, index, frame), mavlink=_connected(robot, index))
        for index, robot in enumerate(scenario.robots)
    )
    return replace(
        scenario, robots=robots, models=known_models, sensors=known_sensors, faults=_filled(scenario.faults)
    )


FIRST_PORT, PORT_STEP = 5760, 10
"""Where presented MAVLink vehicles listen: ArduPilot's simulator numbers its instances likewise."""


def _connected(robot: Robot, index: int) -> Mavlink:
    """A presented vehicle is on this machine, unless said otherwise."""
    link = robot.mavlink
    if robot.presents != "mavlink" or link.connection:
        return link
    return replace(link, connection=f"tcp:127.0.0.1:{FIRST_PORT + PORT_STEP * index}")


def _filled(faults: Sequence[Fault]) -> tuple[Fault, ...]:
    """The rules with the numbers of their presets."""
    rules = []
    for index, rule in enumerate(faults):
        try:
            rules.append(with_preset(rule))
        except ScenarioError as error:
            raise ScenarioError(f"faults[{index}].{error}") from None
    return tuple(rules)


def require_points(scenario: Scenario) -> None:
    """Refuse a formation that has not one point for each robot.

    Raises:
        ScenarioError: it has not.
    """
    points, robots = len(scenario.formation.points), len(scenario.robots)
    if points != robots:
        what = f"has {points} points" if points else "missing, and so is a shape"
        raise ScenarioError(f"formation.points: {what}; must be {robots}, one for each robot")


def initial_pose(scenario: Scenario, index: int, frame: Pose) -> PoseXY:
    """Pose (m, m, rad) of the middle of the axle of one robot at the start, the formation's frame at `frame`.

    Without a pose of its own, the robot's control point is at its place in the formation, scattered by
    `start`, evenly over a disc.
    """
    robot = scenario.robots[index]
    if robot.pose is not None:
        x, y, psi = robot.pose
        return float(x), float(y), float(psi)
    place = frame.compose(Pose(*scenario.formation.points[index], 0.0))
    dx, dy, turn = _scatter(scenario.seed, scenario.start, robot)
    psi = wrap(place.psi + turn)
    a = robot.control_point_m
    return place.x + dx - a * math.cos(psi), place.y + dy - a * math.sin(psi), psi


def _scatter(seed: int, start: Start, robot: Robot) -> tuple[float, float, float]:
    share, direction, turn = stream(seed, f"start/{robot.id}").random(3).tolist()
    distance = start.scatter_m * math.sqrt(share)
    angle = 2.0 * math.pi * direction
    return distance * math.cos(angle), distance * math.sin(angle), start.scatter_rad * (2.0 * turn - 1.0)


def _referenced(
    field: str, scenario: Scenario, own: Mapping[str, P], catalogue: Mapping[str, P]
) -> dict[str, P]:
    """The scenario's own entries and those of the catalogue that its robots refer to."""
    entries = dict(own)
    for index, robot in enumerate(scenario.robots):
        name = getattr(robot, field)
        if name in entries:
            continue
        if name not in catalogue:
            known = ", ".join(sorted({*own, *catalogue}))
            raise ScenarioError(f"robots[{index}].{field} = {name!r}: must be one of {known}")
        entries[name] = catalogue[name]
    return entries
