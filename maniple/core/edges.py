"""The processes beside a robot's agent that do I/O with its hardware, and who of the robots is simulated."""

from maniple.core.scenario.types import Robot, Scenario

WORLD = "world"
"""`frame_id` of odometry that is given in the world frame."""

SIMULATOR = "simulator"
"""The driver that is no process of its own."""

SUFFIXES = ("-driver", "-scanner", "-vehicle")
"""Of the names of these processes; no robot's id may be another's with one of them."""


def driver_of(robot: str) -> str:
    """The process of a robot's driver."""
    return f"{robot}-driver"


def scanner_of(robot: str) -> str:
    """The process of the driver that brings its scans, where that is another."""
    return f"{robot}-scanner"


def vehicle_of(robot: str) -> str:
    """The process that presents its simulated body as a vehicle."""
    return f"{robot}-vehicle"


def has_driver(robot: Robot) -> bool:
    """Whether a process of its own drives it."""
    return robot.driver != SIMULATOR


def has_scanner(robot: Robot) -> bool:
    """Whether another one brings its scans."""
    return robot.scans not in ("", SIMULATOR, robot.driver)


def has_vehicle(robot: Robot) -> bool:
    """Whether its simulated body shows itself as a vehicle."""
    return robot.presents != "nothing"


def has_body(robot: Robot) -> bool:
    """Whether the simulator has a body for it, so that there is ground truth."""
    return not has_driver(robot) or has_vehicle(robot)


def motion_source(robot: Robot) -> str:
    """The process that says how it moves."""
    return driver_of(robot.id) if has_driver(robot) else SIMULATOR


def scan_source(robot: Robot) -> str:
    """The process that says what its range finder sees."""
    if has_scanner(robot):
        return scanner_of(robot.id)
    return SIMULATOR if robot.scans == SIMULATOR else motion_source(robot)


def simulated(scenario: Scenario) -> tuple[Robot, ...]:
    """The robots that have a body in the simulator."""
    return tuple(robot for robot in scenario.robots if has_body(robot))


def is_wired(scenario: Scenario) -> bool:
    """Whether a driver of its own drives any robot: such a platoon runs by the wall clock only."""
    return any(has_driver(robot) or has_scanner(robot) for robot in scenario.robots)


def preflight_asked(scenario: Scenario) -> bool:
    """Whether the platoon is looked at before it moves."""
    asked = scenario.preflight.enabled
    return is_wired(scenario) if asked is None else asked


def processes_of(robot: Robot) -> tuple[str, ...]:
    """The processes of a robot beside its agent: vehicle, driver and scanner, as far as it has them."""
    asked = (
        (has_vehicle, vehicle_of),
        (has_driver, driver_of),
        (has_scanner, scanner_of),
    )
    return tuple(name(robot.id) for has, name in asked if has(robot))


def robot_of(process: str) -> str:
    """The robot whose process beside its agent this would be; empty where no such one is called so."""
    return next((process.removesuffix(end) for end in SUFFIXES if process.endswith(end)), "")
