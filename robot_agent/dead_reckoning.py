"""Dead reckoning: from the counts of the wheel encoders to pose and velocity."""

import math
from typing import NamedTuple

from maniple.core.geometry import Pose
from maniple.core.scenario.types import RobotModel
from maniple.core.time import Time, to_seconds

_MARGIN = 2.0
"""Wheels this much faster than the model's limits allow are not believed."""
_SLACK_TICKS = 2.0
"""Rounding of the counts."""


class Wheels(NamedTuple):
    """The robot's geometry as far as its encoders go."""

    metres_per_tick: float
    track: float
    """m."""
    ticks_per_second: float
    """The largest rate that is believed."""


class Reckoning(NamedTuple):
    """Where the robot is by its own count, in its own frame, and how fast."""

    pose: Pose = Pose(0.0, 0.0, 0.0)
    u: float = 0.0
    """m/s, mean over the last interval."""
    w: float = 0.0
    """rad/s, likewise."""
    ticks: tuple[int, int] | None = None
    """The last counts, left and right; None before the first."""
    stamp: Time = 0
    """When they were taken, by the driver's clock."""


def wheels_of(model: RobotModel) -> Wheels:
    """The geometry of a type of robot."""
    metres_per_tick = 2.0 * math.pi * model.wheel_radius_m / model.ticks_per_revolution
    fastest = model.u_max_mps + 0.5 * model.track_m * model.w_max_radps
    return Wheels(metres_per_tick, model.track_m, _MARGIN * fastest / metres_per_tick)


def step(wheels: Wheels, state: Reckoning, ticks: tuple[int, int], stamp: Time) -> tuple[Reckoning, bool]:
    """The state after the counts `ticks` (left, right) taken at `stamp`, and whether they jumped.

    Between two reports both wheels turn at constant rates, so the robot moves on an arc, which is
    integrated exactly. The first counts are the origin. Counts that no wheel could have reached since the
    last are a restart of the encoders: a new origin, and the robot stays where it was.
    """
    if state.ticks is None:
        return Reckoning(state.pose, 0.0, 0.0, ticks, stamp), False
    elapsed = to_seconds(stamp - state.stamp)
    left, right = ticks[0] - state.ticks[0], ticks[1] - state.ticks[1]
    if max(abs(left), abs(right)) > wheels.ticks_per_second * max(elapsed, 0.0) + _SLACK_TICKS:
        return Reckoning(state.pose, 0.0, 0.0, ticks, stamp), True
    forward = 0.5 * (left + right) * wheels.metres_per_tick
    turn = (right - left) * wheels.metres_per_tick / wheels.track
    pose = state.pose.advance(forward, turn)
    if elapsed <= 0.0:
        return Reckoning(pose, state.u, state.w, ticks, state.stamp), False
    return Reckoning(pose, forward / elapsed, turn / elapsed, ticks, stamp), False
