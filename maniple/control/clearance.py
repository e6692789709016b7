"""How fast a robot may go among what it sees, so that it can always stop before it.

The clearance clamp keeps a disc around the robot clear of what its range finder sees, whatever the robot is
told. It keeps one manoeuvre open, to brake and stop turning at once, by two rules for every return at
distance d and bearing beta. With u > 0 (backwards likewise), D the circumscribed circle's radius plus the
margin:

- braking: the way to a stand, u T + u^2 / (2 brake) + lag u', must fit into d - D, here with half of the
  margin, as far as it could lead towards the return: by the cosine of beta less what the robot still turns
  until then. T is how long a command lasts and how old what is known may be; u' is the larger of u and of
  the measured speed, for wheels that follow late: with a first-order lag, x + lag x' moves just as it is
  sent. Where even full braking breaks the rule, because the turn commanded leads nearer, the turn ends too.
- approach: u cos(beta) <= gamma (d - D - lag u' cos(beta)), so that what is left of d shrinks exponentially
  at most. gamma is at most 1 / (3 T), the most that a loop of delay T follows without overshoot. What is
  abeam does not limit, for u does not approach it.

The disc is around the middle of the axle, which does not move while the robot turns on the spot. A car never
does: its disc is around its body, whose middle moves up to `Limits.swing` aside of where the axle goes. A
robot that moves in every direction has the same rules for the speed at which it closes in on each return.

A return of a wide beam may come from anywhere across it: it counts as half of the opening angle nearer to
where the robot goes than its axis.

So the disc without its margin touches nothing that stands still and has been seen, in whatever direction
the robot goes, if the drive brakes and follows no slower than its model says and goes no faster than it,
and if odometry and ranges are no older than their periods. Half of the margin is for what they are off by;
the model's coupling of speed and turning (th3, th5) is not looked at. No promise is made about what moves,
such as other robots.

What the range finder can't see is taken to be right there: a robot with a laser in front does not reverse.
"""

import math
from typing import NamedTuple

import numpy as np

from maniple.control.limits import Limits, Velocity
from maniple.control.returns import Returns
from maniple.core.geometry import Floats, wrap_array
from maniple.core.scenario.types import Guard

_PROJECTIONS = 10
"""Of a velocity onto what is allowed, before the robot stands instead."""


class ClearSpeed(NamedTuple):
    """The largest speeds, m/s in the direction wanted, that the clearance rules allow."""

    comfortable: float
    """By the approach rule, at least 0."""
    stoppable: float
    """By the braking rule; negative where the robot may not even turn as wanted while it comes to a stand."""


def clear_speed(
    parameters: Guard,
    limits: Limits,
    wanted: Velocity,
    measured: Velocity,
    direction: float,
    returns: Returns,
    dt_s: float,
) -> ClearSpeed:
    """What the clearance rules allow of `wanted` in a direction of the robot's frame (rad): 0 is ahead, pi
    backwards. `measured` is how the robot moves, `returns` are seen from the middle of its circle.

    The speeds u of both count in that direction, and turns either way: nothing is negative. `dt_s` is how
    long a command lasts.
    """
    brake, lag = limits.brake, limits.u_lag_s
    speed, rolling = wanted.u, measured.u / limits.gain
    blind_s = dt_s + limits.delay_s
    gamma = min(parameters.gamma_per_s, 1.0 / (3.0 * blind_s))
    keep = limits.radius + parameters.margin_m
    way = lag * max(speed, rolling) + max(speed / gamma, speed * blind_s + 0.5 * speed * speed / brake)
    near = (returns.distance < keep + limits.gain * way).nonzero()[0]
    if not near.size:
        return ClearSpeed(speed, speed)
    turn = limits.gain * (wanted.w * blind_s + 0.5 * wanted.w * wanted.w / limits.w_accel)
    turn += limits.w_lag_s * max(limits.gain * wanted.w, measured.w)
    room = (returns.distance[near] - keep) / limits.gain
    off = np.abs(wrap_array(returns.bearing[near] - direction) if direction else returns.bearing[near])
    if returns.half_cone or limits.swing:
        off = np.maximum(off - returns.half_cone - limits.swing, 0.0)
    left = _way_until(room, off)
    comfortable = min(gamma * (left - lag * rolling), gamma * left / (1.0 + gamma * lag))
    left = _way_until(room + 0.5 * parameters.margin_m / limits.gain, np.maximum(off - turn, 0.0))
    stoppable = min(
        _braked_within(left - lag * rolling, brake, blind_s), _braked_within(left, brake, blind_s + lag)
    )
    return ClearSpeed(min(max(comfortable, 0.0), speed), min(stoppable, speed))


def clear_velocity(
    parameters: Guard,
    limits: Limits,
    wanted: Velocity,
    measured: Velocity,
    returns: Returns,
    dt_s: float,
) -> Velocity:
    """What near `wanted` the rules allow a robot that moves in every direction.

    Here they bound how fast it closes in on each return: what is too fast is taken off in its direction, so
    that the robot slides along a thing. The braking rule counts that the whole velocity is braked evenly, and
    that what still turns may turn it towards the thing; where it still rolls too fast even so, it stops
    turning.
    """
    brake, lag = limits.brake, limits.u_lag_s
    u, w, v = wanted
    speed = max(math.hypot(u, v), math.hypot(measured.u, measured.v) / limits.gain)
    blind_s = dt_s + limits.delay_s
    gamma = min(parameters.gamma_per_s, 1.0 / (3.0 * blind_s))
    keep = limits.radius + parameters.margin_m
    way = lag * speed + max(speed / gamma, speed * blind_s + 0.5 * speed * speed / brake)
    near = (returns.distance < keep + limits.gain * way).nonzero()[0]
    if not near.size:
        return wanted
    bearing = returns.bearing[near]
    x, y = np.cos(bearing), np.sin(bearing)
    room = (returns.distance[near] - keep) / limits.gain
    rolling = (measured.u * x + measured.v * y) / limits.gain
    comfortable = gamma * np.minimum(room - lag * np.maximum(rolling, 0.0), room / (1.0 + gamma * lag))
    turn = limits.gain * (abs(w) * blind_s + 0.5 * w * w / limits.w_accel)
    turn += limits.w_lag_s * max(limits.gain * abs(w), abs(measured.w)) + returns.half_cone
    astray = math.sin(min(turn, 0.5 * math.pi))
    room += 0.5 * parameters.margin_m / limits.gain
    rolling += astray * math.hypot(measured.u, measured.v) / limits.gain
    left = room - lag * np.maximum(rolling, 0.0)
    if ((left < 0.0) & (rolling > 0.0)).any():
        w = 0.0
    stoppable = np.minimum(
        left / (blind_s + 0.5 * speed / brake),
        room / (blind_s + lag + 0.5 * speed / brake),
    )
    comfortable, stoppable = np.maximum(comfortable, 0.0), np.maximum(stoppable, 0.0)
    for _ in range(_PROJECTIONS):
        closing = u * x + v * y
        excess = np.maximum(closing - comfortable, closing + astray * math.hypot(u, v) - stoppable)
        worst = int(excess.argmax())
        if excess[worst] <= 1e-9:
            return Velocity(u, w, v)
        u -= float(excess[worst] * x[worst])
        v -= float(excess[worst] * y[worst])
    return Velocity(0.0, w, 0.0)


def _way_until(room: Floats, off: Floats) -> float:
    """The way (m) in directions `off` by these angles (rad) that uses up the first `room` (m)."""
    approach = np.cos(off)
    closing = approach > 1e-9
    return float((room[closing] / approach[closing]).min(initial=math.inf))


def _braked_within(way: float, brake: float, delay_s: float) -> float:
    """The speed from which a robot that begins to brake after a delay stands after `way` (m); negative if
    there is none."""
    if way < 0.0:
        return -1.0
    return math.sqrt(brake * brake * delay_s * delay_s + 2.0 * brake * way) - brake * delay_s
