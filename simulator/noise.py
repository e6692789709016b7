"""Errors of range finders: each robot's own stream, so that no robot's noise depends on another's."""

from collections.abc import Sequence

import numpy as np

from maniple.core.geometry import Floats
from maniple.core.scenario.types import RangeFinder
from maniple.core.streams import stream


class RangeNoise:
    """Gaussian errors, then quantisation, then the limits of the sensor.

    Args:
        seed: of the scenario.
        robots: ids, in the order of the rows.
        sensor: the type all of them carry.
    """

    def __init__(self, seed: int, robots: Sequence[str], sensor: RangeFinder) -> None:
        self._sensor = sensor
        self._generators = tuple(stream(seed, f"scan/{robot}") for robot in robots)
        self._errors = np.zeros((len(robots), sensor.readings))

    def apply(self, ranges: Floats) -> Floats:
        """Readings of true `ranges` (m, shape (robots, readings)); what is at `range_max_m` or beyond stays
        exactly there. A sweep draws the same number of errors whatever is seen."""
        sensor = self._sensor
        readings = self._errors
        if sensor.sigma_m > 0.0:
            for generator, row in zip(self._generators, self._errors, strict=True):
                generator.standard_normal(out=row)
            readings = readings * sensor.sigma_m
        readings = readings + ranges
        if sensor.resolution_m > 0.0:
            readings *= 1.0 / sensor.resolution_m
            np.rint(readings, out=readings)
            readings *= sensor.resolution_m
        np.maximum(readings, 0.0, out=readings)
        np.minimum(readings, sensor.range_max_m, out=readings)
        np.copyto(readings, sensor.range_max_m, where=ranges >= sensor.range_max_m)
        return readings
