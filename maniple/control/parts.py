"""What each replaceable layer is to the rest, and which implementations there are to choose from.

A layer is an object with state of its own. The scenario names it; its constructor takes the parameters of
its part of the scenario, and `options` among them is the layer's own. A constructor that can't use its
options raises `ValueError`, with what would be valid. `step` may keep state, but must not read a clock, do
I/O or draw from a global random source: a recording has to give the same bytes when it is run again.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, ParamSpec, Protocol, TypeAlias, TypeVar

from maniple.control.kinematics import Kinematics
from maniple.control.limits import Velocity
from maniple.control.returns import Returns
from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Avoidance, Compensation, Controller, RobotModel


class Remembering(Protocol):
    """What a layer may offer besides, kinematics or avoidance: a state that outlives the process. With it the
    controller that is started again goes on where the one before it ended; without it, from the layer's
    beginning."""

    @property
    def memory(self) -> tuple[float, ...]:
        """Its state as finite numbers; empty at its beginning."""
        ...

    def recall(self, memory: tuple[float, ...]) -> None:
        """Go on from this state. Raises `ValueError` if it is none."""
        ...


class AvoidanceLaw(Protocol):
    """Keeps one robot away from what it senses."""

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
        """What of `wanted` to do. `returns` is what the robot senses now, None for nothing known; `dt_s` (s)
        is the time since the step before, 0 at the first."""
        ...


class CompensationLaw(Protocol):
    """Makes the drive of one robot follow the desired velocity. With a method `recall` that takes what
    `parameters` were, it keeps what it has learnt when the process is started again."""

    @property
    def parameters(self) -> tuple[float, ...]:
        """What it has learnt of the drive, for the recording; empty if nothing."""
        ...

    def step(self, desired: Velocity, measured: Velocity, free: bool, dt_s: float) -> Velocity:
        """What to tell the drive. `measured` is the velocity by the robot's odometry; `free` says that the
        drive was told what the step before gave, with nothing cut off; `dt_s` (s) is the time since then, 0
        at the first step and after a stand."""
        ...


class FormationLaw(Protocol):
    """The rates of the triangles that bring them where they are to be."""

    def rates(self, desired_rates: Floats, errors: Floats, dt_s: float) -> Floats:
        """q_ref' from q_des' and the errors q_des - q, all of shape (triangles, 6): x, y, psi_F, p, q, beta
        in m, rad and s. `dt_s` (s) is the time since the step before, 0 at the first. The number of
        triangles changes when robots are lost and come back."""
        ...


class Planner(Protocol):
    """Who takes which place."""

    def __call__(self, positions: Floats, places: Floats) -> Sequence[int]:
        """The robot that takes each place, by its index: robots at `positions`, places (m) in the order of
        the chain, both of shape (n, 2), in one frame."""
        ...


AvoidanceFactory: TypeAlias = Callable[[Avoidance, RobotModel], AvoidanceLaw]
CompensationFactory: TypeAlias = Callable[[Compensation, RobotModel], CompensationLaw]
KinematicsFactory: TypeAlias = Callable[[RobotModel, float], Kinematics]
"""From the type of robot and the distance (m) of the control point ahead of its axle."""
FormationFactory: TypeAlias = Callable[[Controller], FormationLaw]

T = TypeVar("T")
P = ParamSpec("P")


class Parts(NamedTuple):
    """Implementations by the names that scenarios use: built-in ones, and those of the user."""

    formation_laws: Mapping[str, FormationFactory] = {}
    avoidance: Mapping[str, AvoidanceFactory] = {}
    compensation: Mapping[str, CompensationFactory] = {}
    planners: Mapping[str, Planner] = {}
    kinematics: Mapping[str, KinematicsFactory] = {}


def chosen(parts: Mapping[str, T], name: str, path: str) -> T:
    """The part that the scenario names at `path`.

    Raises:
        ScenarioError: there is none of this name; says which there are.
    """
    if name not in parts:
        known = ", ".join(sorted(filter(None, parts))) or "none"
        raise ScenarioError(f"{path} = {name!r}: not installed; there are {known}")
    return parts[name]


def refuse_options(options: Mapping[str, object]) -> None:
    """For a layer that has none.

    Raises:
        ValueError: there are some.
    """
    if options:
        raise ValueError(f"options {', '.join(sorted(options))}: it takes none")


def made(path: str, factory: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """What `factory` makes of the parameters at `path` of the scenario.

    Raises:
        ScenarioError: it can't use them, by its own account.
    """
    try:
        return factory(*arguments, **named)
    except Exception as error:
        raise ScenarioError(
            f"{path}: the law refuses its parameters: {type(error).__name__}: {error}"
        ) from error
