"""The layers of one robot in their order, with their state."""

import math
from collections.abc import Sequence
from contextlib import suppress

from maniple.control.builtin import BUILTIN
from maniple.control.kinematics import Kinematics
from maniple.control.limits import Velocity
from maniple.control.memory import recall, remembered
from maniple.control.parts import AvoidanceLaw, CompensationLaw, Parts, chosen, made
from maniple.control.returns import Returns
from maniple.control.swerve import Swerve
from maniple.core.layers import PIPELINE, Layer, central_layers, onboard_layers
from maniple.core.scenario.types import Robot, Scenario

__all__ = ["PIPELINE", "Pipeline", "central_layers", "onboard_layers"]

_STANDING = Velocity()


class Pipeline:
    """A run of layers of one robot of a resolved scenario. A layer that is not among `layers`, or that the
    scenario switches off, passes values on; "drive" is the robot's drive itself.

    A layer that raises, or gives anything but three finite numbers, ends the pipeline: from then on it gives
    zero, and `fault` says why.

    Raises:
        ScenarioError: the scenario names a layer that is not among `parts`, or one that refuses its options.
    """

    def __init__(
        self, layers: Sequence[Layer], scenario: Scenario, robot: Robot, parts: Parts = BUILTIN
    ) -> None:
        model = scenario.model_of(robot)
        self.fault = ""
        """Why the pipeline has ended; empty while it has not."""
        self.compensation: tuple[float, ...] = ()
        """What the compensation has learnt of the drive; empty without one and after a failure."""
        self.memory: tuple[tuple[float, ...], ...] = ()
        """The state of kinematics and avoidance; empty where neither has one."""
        self._kinematics: Kinematics | None = None
        self._avoidance: AvoidanceLaw | None = None
        self._compensation: CompensationLaw | None = None
        if "kinematics" in layers:
            path = f"models.{robot.model}.kinematics"
            kind = chosen(parts.kinematics, model.kinematics, path)
            self._kinematics = made(path, kind, model, robot.control_point_m)
        if "avoidance" in layers and scenario.avoidance.enabled:
            avoid = chosen(parts.avoidance, scenario.avoidance.law, "avoidance.law")
            self._avoidance = made("avoidance", avoid, scenario.avoidance, model)
            if model.drive == "omnidirectional":
                self._avoidance = Swerve(self._avoidance, robot.control_point_m)
        if "compensation" in layers and scenario.compensation.enabled:
            compensate = chosen(parts.compensation, scenario.compensation.law, "compensation.law")
            self._compensation = made("compensation", compensate, scenario.compensation, model)
            self.compensation = made("compensation", learnt, self._compensation)

    def recall(self, memory: tuple[tuple[float, ...], ...], compensation: tuple[float, ...]) -> None:
        """Go on with `memory` and `compensation` of a pipeline like this. A layer that can't begins anew, as
        all do after a stand."""
        kinematics, avoidance = memory if len(memory) == 2 else ((), ())
        with suppress(Exception):
            recall(self._kinematics, kinematics)
        with suppress(Exception):
            recall(self._avoidance, avoidance)
        if compensation and self._compensation is not None:
            with suppress(Exception):
                recall(self._compensation, compensation)
                self.compensation = learnt(self._compensation)
        with suppress(Exception):
            self.memory = self._remembered()

    def step(
        self,
        values: tuple[float, float, float],
        psi: float,
        returns: Returns | None,
        measured: Velocity,
        dt_s: float,
        free: bool = True,
    ) -> Velocity:
        """What the layers make of `values`.

        `values` is what the layer before the first one left: where "kinematics" is among the layers, the
        velocity (vx, vy m/s) of the control point in the frame the heading `psi` (rad) is given in, and the
        turning rate (rad/s) of the formation; else (u m/s, w rad/s, v m/s). `returns` is what the robot
        senses now, None for nothing known; `measured` is its velocity by odometry; `free` says that the
        drive was told what the step before gave; `dt_s` is the time since then.
        """
        if self.fault:
            return _STANDING
        layer = "kinematics"
        try:
            velocity = Velocity(*values)
            if self._kinematics is not None:
                velocity = sound(self._kinematics.inverse(psi, *values))
            if self._avoidance is not None:
                layer = "avoidance"
                velocity = sound(self._avoidance.step(velocity, returns, dt_s))
            if self._compensation is not None:
                layer = "compensation"
                velocity = sound(self._compensation.step(velocity, measured, free, dt_s))
                self.compensation = learnt(self._compensation)
            layer = "memory"
            self.memory = self._remembered()
        except Exception as error:  # noqa: BLE001 - a user's layer may raise anything
            self.fault = f"{layer} failed: {type(error).__name__}: {error}"
            self.compensation, self.memory = (), ()
            return _STANDING
        return velocity

    def _remembered(self) -> tuple[tuple[float, ...], ...]:
        found = remembered(self._kinematics), remembered(self._avoidance)
        return found if any(found) else ()


def sound(velocity: Velocity) -> Velocity:
    """What a layer gave, as a velocity of plain numbers.

    Raises:
        ValueError: it is not three finite numbers.
    """
    try:
        u, w, v = map(float, velocity)
    except (TypeError, ValueError):
        raise ValueError(f"gave {velocity!r}; must be three numbers") from None
    if not math.isfinite(u + w + v) and not all(map(math.isfinite, (u, w, v))):
        raise ValueError(f"gave u = {u}, w = {w}, v = {v}; must be finite")
    return Velocity(u, w, v)


def learnt(law: CompensationLaw) -> tuple[float, ...]:
    """What a compensation has learnt, as plain numbers.

    Raises:
        ValueError: its `parameters` are no numbers.
    """
    try:
        return tuple(map(float, law.parameters))
    except (TypeError, ValueError):
        raise ValueError(f"has the parameters {law.parameters!r}; must be numbers") from None
