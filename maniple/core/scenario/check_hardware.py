"""What types can't say of the hardware behind the robots: whether each can be driven, and none takes what is
another's."""

import re
from collections.abc import Iterator

from maniple.core.connections import FORMS, parse_connection
from maniple.core.edges import SIMULATOR, SUFFIXES, has_body, has_vehicle
from maniple.core.errors import ArgumentError
from maniple.core.scenario.types import Robot, Scenario

MAVLINK, ROS2 = "mavlink", "ros2"
_BUILTIN = (SIMULATOR, MAVLINK, ROS2)
_EXCLUSIVE = ("serial", "udpin", "tcpin")
"""Connections that one process has for itself."""
_ROUTER = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[0-9A-Fa-f:.]+\]|[^\s/:\[\]]+):[0-9]{1,5}")


def hardware_problems(scenario: Scenario) -> Iterator[str]:
    """What is wrong with the drivers of a resolved scenario: path, value, what would be valid."""
    yield from _names(scenario)
    for index, robot in enumerate(scenario.robots):
        yield from _drivers(f"robots[{index}]", robot, scenario.model_of(robot).drive)
        if robot.mavlink.connection or uses(robot, MAVLINK):
            yield from _vehicle(f"robots[{index}].mavlink", robot)
        if robot.ros2.router and not _is_router(robot.ros2.router):
            yield (
                f"robots[{index}].ros2.router = {robot.ros2.router!r}: is no address of a router; must be as "
                "'tcp/192.168.1.12:7447'"
            )
    yield from _connections(scenario)
    yield from _origins(scenario)
    yield from _ros2_topics(scenario)


def uses(robot: Robot, driver: str) -> bool:
    """Whether a driver brings anything of a robot."""
    return driver in (robot.driver, robot.scans)


def _names(scenario: Scenario) -> Iterator[str]:
    """Ids that are those of another robot's processes."""
    ids = {robot.id for robot in scenario.robots}
    for index, robot in enumerate(scenario.robots):
        for suffix in SUFFIXES:
            if robot.id.endswith(suffix) and (other := robot.id.removesuffix(suffix)) in ids:
                yield (
                    f"robots[{index}].id = {robot.id!r}: names a process of {other}; must not be the id of "
                    f"another robot with {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
                )


def _drivers(path: str, robot: Robot, drive: str) -> Iterator[str]:
    """Parts that do not fit each other, of a robot whose model has this `drive`."""
    shown = robot.presents
    if shown == MAVLINK and drive != "differential":
        yield (
            f"{path}.presents = 'mavlink': its model is {drive}; must be differential, as an ArduPilot Rover "
            "that turns on the spot"
        )
    if has_vehicle(robot) and robot.driver in _BUILTIN and robot.driver != shown:
        yield (
            f"{path}.presents = {shown!r}: its driver is {robot.driver!r}, which does not connect to such a "
            f"vehicle; must be 'nothing', or driver = {shown!r}"
        )
    if robot.scans == SIMULATOR and not has_body(robot):
        yield (
            f"{path}.scans = 'simulator': the simulator has no body for it; must be another driver, or left "
            f"out for scans by {robot.driver!r}"
        )
    elif robot.scans == robot.driver != SIMULATOR:
        yield f"{path}.scans = {robot.scans!r}: is its driver; must be another one, or left out"
    if robot.options and robot.driver in _BUILTIN and robot.scans in ("", *_BUILTIN):
        given = ", ".join(sorted(robot.options))
        yield (
            f"{path}.options: has {given}, but driver = {robot.driver!r} takes none; must be left out (those "
            "of a MAVLink vehicle are in mavlink, those of a ROS 2 robot in ros2)"
        )


def _vehicle(path: str, robot: Robot) -> Iterator[str]:
    """One MAVLink vehicle."""
    link = robot.mavlink
    if not link.connection:
        yield f"{path}.connection: missing; must be given for driver = 'mavlink', as {FORMS}"
    else:
        try:
            kind = parse_connection(link.connection).kind
        except ArgumentError as error:
            yield f"{path}.connection: {error}"
        else:
            if kind == "serial" and robot.presents == MAVLINK:
                yield (
                    f"{path}.connection = {link.connection!r}: a presented vehicle has no serial port; must "
                    "be a 'tcp:', 'tcpin:', 'udpin:' or 'udpout:' one"
                )
    if link.gcs_system_id == link.system_id:
        yield (
            f"{path}.gcs_system_id = {link.gcs_system_id}: is the vehicle's own system_id; must be another, "
            "its MAV_GCS_SYSID (255 as delivered)"
        )
    if link.origin is not None:
        latitude, longitude, altitude = link.origin
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(altitude) <= 10_000.0):
            yield (
                f"{path}.origin = {list(link.origin)}: is nowhere on Earth; must be [latitude, longitude, "
                "altitude], within 90 and 180 degrees and 10000 m"
            )


def _connections(scenario: Scenario) -> Iterator[str]:
    """Robots that would hear the same vehicle, or open the same port."""
    opened: dict[tuple[str, str, int], list[int]] = {}
    for index, robot in enumerate(scenario.robots):
        if not uses(robot, MAVLINK) or not robot.mavlink.connection:
            continue
        try:
            kind, where, number = parse_connection(robot.mavlink.connection)
        except ArgumentError:
            continue
        # A serial port at two rates is one port.
        opened.setdefault((kind, where.lower(), 0 if kind == "serial" else number), []).append(index)
    for (how, _, _), users in opened.items():
        first: dict[int, int] = {}
        for index in users:
            robot = scenario.robots[index]
            link, alone = robot.mavlink, how in _EXCLUSIVE or robot.presents == MAVLINK
            before = users[0] if alone else first.setdefault(link.system_id, index)
            if before == index:
                continue
            other = scenario.robots[before].id
            path = f"robots[{index}].mavlink"
            if alone:
                yield (
                    f"{path}.connection = {link.connection!r}: robots[{before}] ({other}) has it, and only "
                    "one process can open it; must be another"
                )
            else:
                yield (
                    f"{path}.system_id = {link.system_id}: robots[{before}] ({other}) has it on the same "
                    f"connection, {link.connection!r}; must be another vehicle's, or on another connection"
                )


def _origins(scenario: Scenario) -> Iterator[str]:
    """MAVLink vehicles in different frames."""
    vehicles = [(i, robot) for i, robot in enumerate(scenario.robots) if robot.driver == MAVLINK]
    given = [(i, robot) for i, robot in vehicles if robot.mavlink.origin is not None]
    if not given:
        return
    first, known = given[0]
    assert known.mavlink.origin is not None, "it is given"
    for index, robot in vehicles:
        origin = robot.mavlink.origin
        if origin != known.mavlink.origin:
            what = ": missing;" if origin is None else f" = {list(origin)}:"
            yield (
                f"robots[{index}].mavlink.origin{what} must be {list(known.mavlink.origin)}, as of "
                f"robots[{first}] ({known.id}), or left out for all: one world has one origin"
            )


def _ros2_topics(scenario: Scenario) -> Iterator[str]:
    """ROS 2 robots that would take the same commands, or go by the same odometry."""
    taken: dict[tuple[str, str, int, str], int] = {}
    for index, robot in enumerate(scenario.robots):
        if robot.driver != ROS2:
            continue
        ros2 = robot.ros2
        for field, name in (("cmd_vel", ros2.cmd_vel), ("odom", ros2.odom)):
            key = ros2.router, ros2.layout, ros2.domain_id, _absolute(name, ros2.namespace or robot.id)
            before = taken.setdefault(key, index)
            if before != index:
                yield (
                    f"robots[{index}].ros2.{field} = {name!r}: is {key[3]} of domain {ros2.domain_id}, as "
                    f"that of robots[{before}] ({scenario.robots[before].id}) on the same router; must be in "
                    "another namespace or domain, or on another router"
                )
                break


def _absolute(name: str, namespace: str) -> str:
    """The full name of a topic."""
    parts = name if name.startswith("/") else f"{namespace}/{name}"
    return "/" + "/".join(part for part in parts.split("/") if part)


def _is_router(text: str) -> bool:
    found = _ROUTER.fullmatch(text)
    return found is not None and 1 <= int(text.rpartition(":")[2]) <= 65535
