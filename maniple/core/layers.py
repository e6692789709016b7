"""The layers of one robot, and where the scenario cuts them between controller and robot."""

from typing import Literal, TypeAlias

Layer: TypeAlias = Literal["kinematics", "avoidance", "compensation", "drive"]
"""The layers of one robot, in the order of the pipeline."""

PIPELINE: tuple[Layer, ...] = ("kinematics", "avoidance", "compensation", "drive")
"""From the control point's velocity to the wheels."""


def central_layers(robot_from: Layer) -> tuple[Layer, ...]:
    """The layers the controller runs: those before the cut."""
    return PIPELINE[: PIPELINE.index(robot_from)]


def onboard_layers(robot_from: Layer) -> tuple[Layer, ...]:
    """The layers the robot runs: those from the cut on."""
    return PIPELINE[PIPELINE.index(robot_from) :]
