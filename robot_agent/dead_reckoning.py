"""Dead reckoning: from the counts of the wheel encoders, or the poses of a drive that reckons itself, to pose
and velocity."""

import math
from operator import mul, sub
from typing import NamedTuple

import numpy as np

from maniple.control.limits import Velocity
from maniple.control.wheels import wheel_ways
from maniple.core.geometry import Pose, wrap
from maniple.core.messages import Motion
from maniple.core.scenario.types import RobotModel
from maniple.core.time import Time, to_seconds

_MARGIN = 2.0
"""What is this much faster than the model's limits allow is not believed."""
_SLACK_TICKS = 2.0
"""Rounding of the counts."""
_SLACK_M, _SLACK_RAD = 0.1, 0.1
"""What an estimate of a pose may be corrected by at once, without that being a jump."""
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
    """Where the robot is by its own count, in its odometry frame, and how fast."""

    pose: Pose = Pose(0.0, 0.0, 0.0)
    velocity: Velocity = Velocity()
    """Mean over the last interval, or as the drive says."""
    ticks: tuple[int, ...] | None = None
    """The last counts, as many as there are wheels that count; None before the first."""
    stamp: Time = 0
    """When they were taken, by the driver's clock."""
    reported: Pose | None = None
    """Instead of counts: the last pose that the drive reported, in its own frame."""
    origin: tuple[int, int] | None = None
    """Which frame that was: the life of the driver, and `Motion.origin`; None where it does not tell."""


class Gauge(NamedTuple):
    """What a robot goes by to know how far it went."""

    wheels: Wheels
    speed_mps: float
    """The fastest, in any direction, that a reported pose is believed to move."""
    turning_radps: float
    """And to turn."""
    in_world: bool
    """Whether reported poses are the robot's, in the world frame, as they come. Else the robot's own frame
    begins where the first was reported."""


def gauge_of(model: RobotModel, in_world: bool = False) -> Gauge:
    """What robots of a type go by."""
    fastest = math.hypot(model.u_max_mps, model.v_max_mps or 0.0)
    return Gauge(wheels_of(model), _MARGIN * fastest, _MARGIN * model.w_max_radps, in_world)


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


def follow(
    gauge: Gauge, state: Reckoning, reported: Pose, velocity: Velocity, stamp: Time
) -> tuple[Reckoning, bool]:
    """The state after the drive said at `stamp` that it is at `reported`, and whether that is a jump: farther
    from the last than the robot could have gone, at the most that it can do or at the speeds that the drive
    itself reports, whichever is more (a pilot may drive it faster).

    In a frame of its own the robot goes as the reported pose does, from where it was; a jump is a new origin
    of the driver's frame, and the robot stays where it was. In the world frame it is where it is said to be.
    """
    before, jumped = state.reported, False
    moved = Pose(0.0, 0.0, 0.0) if before is None else before.inverse().compose(reported)
    if before is not None:
        elapsed = max(to_seconds(stamp - state.stamp), 0.0)
        speed = max(
            gauge.speed_mps, *(_MARGIN * math.hypot(one.u, one.v) for one in (velocity, state.velocity))
        )
        turning = max(gauge.turning_radps, *(_MARGIN * abs(one.w) for one in (velocity, state.velocity)))
        jumped = (
            math.hypot(moved.x, moved.y) > speed * elapsed + _SLACK_M
            or abs(moved.psi) > turning * elapsed + _SLACK_RAD
        )
    if gauge.in_world:
        pose = reported._replace(psi=wrap(reported.psi))
    else:
        pose = state.pose if jumped else state.pose.compose(moved)
    return Reckoning(pose, velocity, None, stamp, reported), jumped


def begun_anew(gauge: Gauge, state: Reckoning) -> Reckoning:
    """The state of a robot whose driver may count from a new origin, where it does not tell that itself."""
    keeps = gauge.in_world or state.origin is not None
    return state._replace(ticks=None, reported=state.reported if keeps else None)


def origin_of(incarnation: int, origin: int | None) -> tuple[int, int] | None:
    """Which frame a pose is in, that a life of a driver reported."""
    return None if origin is None else (incarnation, origin)


def advance(gauge: Gauge, state: Reckoning, motion: Motion, stamp: Time) -> tuple[Reckoning, bool]:
    """The state after what a drive reported at `stamp`, by its pose or else by its counts, and whether they
    jumped."""
    if motion.pose is None:
        return step(gauge.wheels, state, motion.ticks, stamp)
    origin = origin_of(motion.incarnation, motion.origin)
    if origin != state.origin and not gauge.in_world:
        state = state._replace(reported=None)
    after, jumped = follow(gauge, state, Pose(*motion.pose), Velocity(*motion.twist), stamp)
    return after._replace(origin=origin), jumped
