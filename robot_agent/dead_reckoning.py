"""Dead reckoning: from the counts of the wheel encoders to pose and velocity."""

import math
from operator import mul, sub
from typing import NamedTuple

import numpy as np

from maniple.control.limits import Velocity
from maniple.control.wheels import wheel_ways
from maniple.core.geometry import Pose
from maniple.core.scenario.types import RobotModel
from maniple.core.time import Time, to_seconds

_MARGIN = 2.0
"""Wheels this much faster than the model's limits allow are not believed."""
_SLACK_TICKS = 2.0
"""Rounding of the counts."""
_STANDING = Velocity()


class Wheels(NamedTuple):
    """The robot's geometry as far as its encoders go: how far it goes ahead (m), turns (rad) and goes to the
    left (m; empty for one that can't) with one count of each wheel."""

    ahead: tuple[float, ...]
    turn: tuple[float, ...]
    left: tuple[float, ...]
    ticks_per_second: float
    """The largest rate that is believed."""


class Reckoning(NamedTuple):
    """Where the robot is by its own count, in its own frame, and how fast."""

    pose: Pose = Pose(0.0, 0.0, 0.0)
    velocity: Velocity = Velocity()
    """Mean over the last interval."""
    ticks: tuple[int, ...] | None = None
    """The last counts, as many as there are wheels that count; None before the first."""
    stamp: Time = 0
    """When they were taken, by the driver's clock."""


def wheels_of(model: RobotModel) -> Wheels:
    """The geometry of a type of robot. The motion is the one that fits its wheels' ways best: the columns of
    `wheel_ways` are square to one another, so that each, divided by its square, is a row of the inverse."""
    metres_per_tick = 2.0 * math.pi * model.wheel_radius_m / model.ticks_per_revolution
    ways = wheel_ways(model, model.track_m)
    squares = (ways * ways).sum(axis=0)
    ahead, turn, left = (ways * (metres_per_tick / np.where(squares > 0.0, squares, np.inf))).T.tolist()
    fastest = np.abs(ways) @ (model.u_max_mps, model.w_max_radps, model.v_max_mps or 0.0)
    return Wheels(
        tuple(ahead),
        tuple(turn),
        tuple(left) if any(left) else (),
        _MARGIN * float(fastest.max()) / metres_per_tick,
    )


def step(wheels: Wheels, state: Reckoning, ticks: tuple[int, ...], stamp: Time) -> tuple[Reckoning, bool]:
    """The state after the counts `ticks` taken at `stamp`, and whether they jumped.

    Between two reports all wheels turn at constant rates, so the robot moves on an arc, which is integrated
    exactly. The first counts are the origin. Counts that no wheel could have reached since the last are a
    restart of the encoders: a new origin, and the robot stays where it was.
    """
    if state.ticks is None:
        return Reckoning(state.pose, _STANDING, ticks, stamp), False
    elapsed = to_seconds(stamp - state.stamp)
    counted = tuple(map(sub, ticks, state.ticks))
    if max(map(abs, counted)) > wheels.ticks_per_second * max(elapsed, 0.0) + _SLACK_TICKS:
        return Reckoning(state.pose, _STANDING, ticks, stamp), True
    ahead = sum(map(mul, wheels.ahead, counted))
    turn = sum(map(mul, wheels.turn, counted))
    left = sum(map(mul, wheels.left, counted), 0.0)
    pose = state.pose.advance(ahead, turn, left)
    if elapsed <= 0.0:
        return Reckoning(pose, state.velocity, ticks, state.stamp), False
    return Reckoning(pose, Velocity(ahead / elapsed, turn / elapsed, left / elapsed), ticks, stamp), False
