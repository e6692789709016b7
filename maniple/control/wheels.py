"""How the wheels that count turn when a robot moves: what an encoder sees, and what dead reckoning undoes."""

import math

import numpy as np

from maniple.core.geometry import Floats
from maniple.core.scenario.types import RobotModel

OMNI_WHEELS = (math.pi / 3.0, math.pi, 5.0 * math.pi / 3.0)
"""Where the wheels of an omnidirectional robot are, seen from its middle, rad."""


def wheel_ways(model: RobotModel, track_m: float) -> Floats:
    """The way (m) each wheel rolls while the robot goes 1 m ahead, turns by 1 rad, or goes 1 m to the left.

    The wheels are left and right, of a car those behind; of an omnidirectional robot each rolls square to its
    arm, counter-clockwise. Shape (wheels, 3); the columns are square to one another.
    """
    half = 0.5 * track_m
    if model.drive == "omnidirectional":
        return np.array([[-math.sin(angle), half, math.cos(angle)] for angle in OMNI_WHEELS])
    return np.array([[1.0, -half, 0.0], [1.0, half, 0.0]])
