"""The layers of one robot in their order, and where the scenario cuts them between controller and robot."""

from collections.abc import Sequence

from maniple.control import avoidance, unicycle
from maniple.control.returns import Returns
from maniple.core.layers import Layer
from maniple.core.scenario.types import Avoidance

PIPELINE: tuple[Layer, ...] = ("kinematics", "avoidance", "compensation", "drive")
"""From the control point's velocity to the wheels."""


def central_layers(robot_from: Layer) -> tuple[Layer, ...]:
    """The layers the controller runs: those before the cut."""
    return PIPELINE[: PIPELINE.index(robot_from)]


def onboard_layers(robot_from: Layer) -> tuple[Layer, ...]:
    """The layers the robot runs: those from the cut on."""
    return PIPELINE[PIPELINE.index(robot_from) :]


class Pipeline:
    """A run of layers of one robot, with their state. A layer that is not among `layers` is left out.

    Of `PIPELINE`, "drive" is the robot's drive itself and "compensation" has no law; both pass values on.
    """

    def __init__(self, layers: Sequence[Layer], control_point_m: float, parameters: Avoidance) -> None:
        self._kinematics = "kinematics" in layers
        self._avoidance = "avoidance" in layers and parameters.enabled
        self._control_point = control_point_m
        self._parameters = parameters
        self._state = avoidance.REST
        self._returns: Returns | None = None
        self._sides = avoidance.CALM

    def step(
        self, values: tuple[float, float], psi: float, returns: Returns | None, dt_s: float
    ) -> tuple[float, float]:
        """What the layers make of `values`.

        `values` is what the layer before the first one left: the velocity (m/s) of the control point in
        the frame the heading `psi` (rad) is given in where "kinematics" is among the layers, else
        (u m/s, w rad/s). `returns` is what the robot senses now, None for nothing known; `dt_s` is the
        time since the step before. Returns (u, w).
        """
        u, w = unicycle.inverse(psi, self._control_point, *values) if self._kinematics else values
        if not self._avoidance:
            return u, w
        if returns is not self._returns:
            self._returns = returns
            self._sides = avoidance.CALM if returns is None else avoidance.forces(self._parameters, returns)
        self._state = avoidance.step(self._parameters, self._state, self._sides, dt_s)
        return u - self._state.u_cor, w + self._state.w_cor
