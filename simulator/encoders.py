"""Wheel encoders: true motion to counts, with what wheels get wrong.

The drive moves the robot as its model says; slip and wheels that are not as large as believed are in what the
encoders count, as on a real robot whose wheels turn farther than it gets.
"""

import math
from collections.abc import Sequence

import numpy as np

from maniple.control.wheels import wheel_ways
from maniple.core.geometry import Floats
from maniple.core.scenario.types import RobotModel
from maniple.core.streams import stream

_DRAWN = 256
"""Slips of a wheel that are drawn at once."""


class Encoders:
    """The encoders of each of n robots, which count whole ticks of their wheels' exact turns.

    Args:
        models: the type of each robot.
        heading: unwrapped headings at power-up, rad, shape (n,).
        seed: of the scenario.
        robots: ids.
    """

    def __init__(
        self, models: Sequence[RobotModel], heading: Floats, seed: int, robots: Sequence[str]
    ) -> None:
        ways = [wheel_ways(m, m.track_m * (1.0 + m.track_error)) for m in models]
        counts = [len(rows) for rows in ways]
        ends = np.cumsum(counts).tolist()
        self._spans = [(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self._robot = np.repeat(np.arange(len(models)), counts)
        self._ahead, self._turn, self._left = np.concatenate(ways).T
        self._per_metre = np.concatenate(
            [_ticks_per_metre(m, len(w)) for m, w in zip(models, ways, strict=True)]
        )
        self._sideways = bool(self._left.any())
        self._heading = heading.copy()
        self._slips = [
            (wheel, Slip(model, seed, f"slip/{robot}/{wheel - start}"))
            for model, robot, (start, end) in zip(models, robots, self._spans, strict=True)
            if model.slip_sigma > 0.0
            for wheel in range(start, end)
        ]
        self._slipped = np.zeros(len(self._robot))

    def roll(self, arcs: Floats) -> None:
        """Steps were taken: ways ahead (m), turns (rad) and, where some robot can, ways to the left (m),
        shape (k, 2 or 3, n)."""
        for wheel, slip in self._slips:
            arc = arcs[..., self._robot[wheel]]
            way = self._ahead[wheel] * arc[:, 0] + self._turn[wheel] * arc[:, 1]
            if self._sideways:
                way += self._left[wheel] * arc[:, 2]
            self._slipped[wheel] += slip.roll(way)

    def ticks(self, travel: Floats) -> list[tuple[int, ...]]:
        """Counts of each robot's wheels after `travel`: way ahead (m), unwrapped heading (rad) and, where
        some robot can, way to the left (m), shape (2 or 3, n)."""
        wheels = self._turn * (travel[1] - self._heading)[self._robot]
        wheels += self._ahead * travel[0][self._robot]
        if self._sideways:
            wheels += self._left * travel[2][self._robot]
        if self._slips:
            wheels += self._slipped
        wheels *= self._per_metre
        counts = np.floor(wheels).astype(np.int64).tolist()
        return [tuple(counts[start:end]) for start, end in self._spans]


class Slip:
    """How much farther than it rolls one wheel turns.

    The share is drawn anew from the wheel's own stream every `slip_length_m` that the wheel has rolled, ahead
    or back. So what it amounts to depends on the way alone, not on the length of the steps.
    """

    def __init__(self, model: RobotModel, seed: int, name: str) -> None:
        self._generator = stream(seed, name)
        self._length = model.slip_length_m
        self._step = model.slip_sigma * model.slip_length_m
        self._rolled = 0.0
        self._sums = np.zeros(1)
        """What the slips of the lengths up to each sum up to, m."""

    def roll(self, ways: Floats) -> float:
        """What a wheel turns (m) more than it rolls along these ways (m)."""
        rolled = np.concatenate([[0.0], np.abs(ways)]).cumsum()
        rolled += self._rolled
        self._rolled = float(rolled[-1])
        places = rolled / self._length
        while places[-1] >= len(self._sums) - 1:
            drawn = self._step * self._generator.standard_normal(_DRAWN)
            self._sums = np.concatenate([self._sums, self._sums[-1] + drawn.cumsum()])
        first = places.astype(np.int64)
        below = self._sums[first]
        slipped = below + (places - first) * (self._sums[first + 1] - below)
        return float(np.sign(ways) @ np.diff(slipped))


def _ticks_per_metre(model: RobotModel, wheels: int) -> Floats:
    errors = np.array(model.wheel_error or (0.0,) * wheels)
    circumference = 2.0 * math.pi * model.wheel_radius_m * (1.0 + errors)
    return np.asarray(model.ticks_per_revolution / circumference)
