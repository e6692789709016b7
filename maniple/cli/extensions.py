"""Implementations of layers, and drivers, that other packages bring, found by their entry points."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

from central_controller.planning import METHODS
from central_controller.watched import LAWS, WatchedLaw, WatchedPlanner
from maniple.control.builtin import BUILTIN
from maniple.control.limits import limits_of
from maniple.control.parts import Parts
from maniple.control.pipeline import Pipeline
from maniple.core.edges import SIMULATOR, has_scanner
from maniple.core.errors import ManipleError, MissingExtraError, ScenarioError
from maniple.core.layers import PIPELINE
from maniple.core.scenario.types import Robot, Scenario
from robot_agent import drivers
from robot_agent.drivers import capabilities_of
from robot_agent.drivers.interface import Driver, DriverFactory, within

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Kind: TypeAlias = Literal["formation-law", "planner", "kinematics", "avoidance", "compensation"]
"""The layers that can be replaced."""

Extension: TypeAlias = Kind | Literal["driver"]
"""All that other packages may bring."""


class Place(NamedTuple):
    """Where the implementations of one kind come from."""

    group: str
    """Of entry points."""
    builtin: Mapping[str, Any]
    """By the names that scenarios use."""


PLACES: Mapping[Extension, Place] = {
    "formation-law": Place("maniple.formation_laws", LAWS),
    "planner": Place("maniple.planners", METHODS),
    "kinematics": Place("maniple.kinematics", BUILTIN.kinematics),
    "avoidance": Place("maniple.avoidance", BUILTIN.avoidance),
    "compensation": Place("maniple.compensation", BUILTIN.compensation),
    "driver": Place("maniple.drivers", drivers.BUILTIN),
}

KINDS: tuple[Kind, ...] = get_args(Kind)

NEEDS: Mapping[str, tuple[str, ...]] = {
    "mavlink": ("pymavlink", "pyserial"),
    "ros2": ("rosbags", "xxhash"),
}
"""The distributions that the built-in drivers of these names need, and what the simulator presents as such a
vehicle. The extra has the same name. pyserial is for cables only."""


class Installed(NamedTuple):
    """One implementation that scenarios can name."""

    kind: Extension
    name: str
    package: str
    """What brings it, with its version."""
    value: str
    """Where it is: "module:attribute"; empty for a built-in one."""


def installed(kinds: Sequence[Extension] = KINDS) -> list[Installed]:
    """All that there is of some kinds, built-in first; nothing is imported. Whoever takes the name of a
    built-in one is not there: scenarios mean the built-in one."""
    found = []
    for kind in kinds:
        found += [Installed(kind, name, "maniple", "") for name in PLACES[kind].builtin if name]
        others = [point for point in _points(kind) if point.name not in PLACES[kind].builtin]
        for point in sorted(others, key=lambda point: point.name):
            found.append(Installed(kind, point.name, _package(point), point.value))
    return found


def parts_of(scenario: Scenario, on_robot: bool = False) -> Parts:
    """The built-in implementations, and those of others that a resolved scenario names; `on_robot`: without
    those that only the controller needs.

    Raises:
        ScenarioError: one is not installed, is there twice, or can't be imported.
    """
    law = [] if on_robot else [("controller.law", scenario.controller.law)]
    planner = [] if on_robot else [("planning.method", scenario.planning.method)]
    return Parts(
        formation_laws=_named("formation-law", law),
        planners=_named("planner", planner),
        kinematics=_named(
            "kinematics",
            [(f"models.{name}.kinematics", model.kinematics) for name, model in scenario.models.items()],
        ),
        avoidance=_named("avoidance", [("avoidance.law", scenario.avoidance.law)]),
        compensation=_named("compensation", [("compensation.law", scenario.compensation.law)]),
    )


def drivers_of(scenario: Scenario, robots: Sequence[Robot] | None = None) -> Mapping[str, DriverFactory]:
    """The built-in drivers, and those of others that a resolved scenario names for some of its robots, by
    default for all.

    Raises:
        ScenarioError: as for `parts_of`.
    """
    named = [
        (f"robots.{robot.id}.{field}", name)
        for robot in (scenario.robots if robots is None else robots)
        for field, name in (("driver", robot.driver), ("scans", robot.scans))
        if name != SIMULATOR
    ]
    return {
        name: factory if name in drivers.BUILTIN else _heeding(factory, name)
        for name, factory in _named("driver", named).items()
    }


def version_of(distribution: str) -> str | None:
    """The version that is installed; None where it is not."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def require_extras(scenario: Scenario) -> None:
    """Refuse a resolved scenario whose built-in drivers and vehicles could not run on this machine.

    Raises:
        MissingExtraError: says which, and what to install.
    """
    for robot in scenario.robots:
        cable = robot.mavlink.connection.startswith("serial:")
        for field, name in (("driver", robot.driver), ("scans", robot.scans), ("presents", robot.presents)):
            for need in NEEDS.get(name, ()):
                if version_of(need) is None and (cable or need != "pyserial"):
                    raise MissingExtraError(f"robots.{robot.id}.{field} = {name!r} ({need})", name)


def _heeding(factory: DriverFactory, name: str) -> DriverFactory:
    """A driver of others: what its constructor raises is about its parameters."""

    def make(scenario: Scenario, robot: Robot, endpoint: str = "") -> Driver:
        try:
            return factory(scenario, robot, endpoint)
        except ManipleError:
            raise
        except Exception as error:
            raise ScenarioError(
                f"robots.{robot.id}: the driver {name!r} refuses its parameters: "
                f"{type(error).__name__}: {error}"
            ) from error

    return make


def require_layers(scenario: Scenario) -> None:
    """Refuse a resolved scenario with layers or drivers that are not installed on this machine, or that can't
    use their parameters.

    Raises:
        ScenarioError: says which, and which there are.
    """
    parts = parts_of(scenario)
    WatchedLaw(scenario.controller, parts)
    WatchedPlanner(scenario.planning, parts)
    known = drivers_of(scenario)
    for robot in scenario.robots:
        Pipeline(PIPELINE, scenario, robot, parts)
        within(limits_of(scenario, robot), capabilities_of(scenario, robot, known), robot.id)
        if has_scanner(robot):
            known[robot.scans](scenario, robot)


def implementation(kind: Extension, name: str, path: str) -> Any:
    """The implementation of a name; messages call where it is named `path`.

    Raises:
        ScenarioError: as for `parts_of`.
    """
    builtin = PLACES[kind].builtin
    if name in builtin:
        return builtin[name]
    points = [point for point in _points(kind) if point.name == name]
    if not points:
        own = {SIMULATOR} if kind == "driver" else set()
        known = sorted({name for name in builtin if name} | {point.name for point in _points(kind)} | own)
        names = ", ".join(known) or "none"
        raise ScenarioError(f"{path} = {name!r}: no such {kind} is installed; there are {names}")
    if len(points) > 1:
        owners = sorted(_package(point) for point in points)
        raise ScenarioError(f"{path} = {name!r}: installed more than once, by {', '.join(owners)}")
    try:
        return points[0].load()
    except Exception as error:
        raise ScenarioError(
            f"{path} = {name!r}: {points[0].value} can't be imported: {type(error).__name__}: {error}"
        ) from error


def _named(kind: Extension, used: Iterable[tuple[str, str]]) -> Mapping[str, Any]:
    """The built-in ones and those that are used."""
    return {
        **PLACES[kind].builtin,
        **{name: implementation(kind, name, path) for path, name in used if name},
    }


def _package(point: "EntryPoint") -> str:
    """What brings an entry point, with its version."""
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unnamed package"


def _points(kind: Extension) -> Iterable["EntryPoint"]:
    from importlib.metadata import entry_points  # 4 MB that a node with built-in layers does without

    return entry_points(group=PLACES[kind].group)
