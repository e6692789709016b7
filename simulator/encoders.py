"""Wheel encoders: true motion to counts."""

import math
from collections.abc import Sequence

import numpy as np

from maniple.core.geometry import Floats
from maniple.core.scenario.types import RobotModel


class Encoders:
    """The two encoders of each of n robots, which count whole ticks of the wheels' exact travel.

    Args:
        models: the type of each robot.
        heading: unwrapped headings at power-up, rad, shape (n,).
    """

    def __init__(self, models: Sequence[RobotModel], heading: Floats) -> None:
        self._ticks_per_metre = np.array(
            [m.ticks_per_revolution / (2.0 * math.pi * m.wheel_radius_m) for m in models]
        )
        half_track = np.array([0.5 * m.track_m for m in models])
        self._side = np.stack([-half_track, half_track])
        self._heading = heading.copy()

    def ticks(self, travel: Floats) -> list[tuple[int, int]]:
        """Left and right counts of each robot after `travel`: path length (m) and unwrapped heading (rad),
        shape (2, n). A wheel travels s -/+ turn * track / 2."""
        wheels = self._side * (travel[1] - self._heading)
        wheels += travel[0]
        wheels *= self._ticks_per_metre
        left, right = np.floor(wheels).astype(np.int64).tolist()
        return list(zip(left, right, strict=True))
