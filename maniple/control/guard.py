"""A robot's last word on what it is told: age, speed, acceleration and braking limits, and clearance."""

import math
from typing import Literal, NamedTuple, TypeAlias

from maniple.control.clearance import clear_speed, clear_velocity
from maniple.control.limits import Limits, Velocity
from maniple.control.returns import Returns, moved
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Guard

Reason: TypeAlias = Literal["none", "age", "speed", "acceleration", "clearance", "blind"]
"""Which limit changed the command last."""


_STILL_M = 1e-3
"""A robot that rolls on for less than this stands."""
_STAND = Velocity()


class Verdict(NamedTuple):
    """What may be sent to the drive."""

    velocity: Velocity
    reason: Reason


def step(
    parameters: Guard,
    limits: Limits,
    state: Velocity,
    command: Velocity | None,
    age_s: float,
    returns: Returns | None,
    dt_s: float,
    measured: Velocity,
) -> Verdict:
    """What of `command` may be done, `dt_s` after `state` was sent.

    `command` is None where there is none; `age_s` is the age of what it was computed from; `returns` are
    what the robot senses now, None where that is not known. `state` is within the limits; `measured` is how
    the robot really moves.
    """
    reason: Reason = "none"
    u, w, v = command if command is not None else _STAND
    if command is None or age_s >= limits.stop_s:
        u, w, v, reason = 0.0, 0.0, 0.0, "age"
    elif age_s > limits.hold_s:
        share = (limits.stop_s - age_s) / (limits.stop_s - limits.hold_s)
        u, w, v, reason = u * share, w * share, v * share, "age"
    if limits.needs_ranges and returns is None:
        u, w, v, reason = 0.0, 0.0, 0.0, "blind"
    able = Velocity(u, w, v)
    if not (
        limits.u_min <= u <= limits.u_max
        and abs(w) <= limits.w_max
        and abs(v) <= limits.v_max
        and _steered(limits, u, w) == w
    ):
        u = _clip(u, limits.u_min, limits.u_max)
        w = _steered(limits, u, _clip(w, -limits.w_max, limits.w_max))
        able, reason = Velocity(u, w, _clip(v, -limits.v_max, limits.v_max)), "speed"
    sent = _ramped(limits, state, able, dt_s)
    if reason != "blind" and sent != able:
        reason = "acceleration"
    verdict = Verdict(sent, reason)
    if not parameters.clearance or returns is None:
        return verdict
    if limits.centre:
        returns = moved(returns, Pose(limits.centre, 0.0, 0.0))
    if limits.v_max and returns.sees_ahead and returns.sees_behind:
        clear = clear_velocity(parameters, limits, sent, measured, returns, dt_s)
        if clear != sent:
            verdict = Verdict(_ramped(limits, state, clear, dt_s), "clearance")
    else:
        if sent.v:
            verdict = Verdict(_ramped(limits, state, able._replace(v=0.0), dt_s), "blind")
        for ahead in (True, False):
            verdict = _cleared(parameters, limits, state, verdict, returns, dt_s, measured, ahead)
    (u, w, v), reason = verdict
    return Verdict(Velocity(u, _steered(limits, u, w), v), reason)


def _cleared(
    parameters: Guard,
    limits: Limits,
    state: Velocity,
    wanted: Verdict,
    returns: Returns,
    dt_s: float,
    measured: Velocity,
    ahead: bool,
) -> Verdict:
    """What of `wanted` the clearance rules leave, as far as the robot goes or still rolls that way."""
    (u, w, v), reason = wanted
    going, rolling = (u, measured.u) if ahead else (-u, -measured.u)
    rolls_on = rolling * limits.u_lag_s > _STILL_M
    if not (going > 0.0 or rolls_on):
        return wanted
    if not (returns.sees_ahead if ahead else returns.sees_behind):
        if going <= 0.0:
            return wanted
        return Verdict(Velocity(_ramp(state.u, 0.0, limits.u_accel, limits.brake, dt_s), w, v), "blind")
    heading = Velocity(max(going, 0.0), abs(w))
    wheels = Velocity(max(rolling, 0.0), abs(measured.w))
    direction = 0.0 if ahead else math.pi
    clear = clear_speed(parameters, limits, heading, wheels, direction, returns, dt_s)
    if going > (most := max(min(clear), 0.0)):
        u = _ramp(state.u, most if ahead else -most, limits.u_accel, limits.brake, dt_s)
        going, reason = abs(u), "clearance"
    if (going > 0.0 or rolls_on) and going > clear.stoppable:
        w, reason = _ramp(state.w, 0.0, limits.w_accel, limits.w_accel, dt_s), "clearance"
    return Verdict(Velocity(u, w, v), reason)


def _ramped(limits: Limits, state: Velocity, target: Velocity, dt_s: float) -> Velocity:
    """The nearest to `target` that is reached from `state` in `dt_s`, the steering following the speed."""
    w = _ramp(state.w, target.w, limits.w_accel, limits.w_accel, dt_s)
    if target.v == 0.0 == state.v:
        u = _ramp(state.u, target.u, limits.u_accel, limits.brake, dt_s)
        return Velocity(u, _steered(limits, u, w), 0.0)
    du, dv = target.u - state.u, target.v - state.v
    slower = math.hypot(target.u, target.v) < math.hypot(state.u, state.v)
    most = (limits.brake if slower else limits.u_accel) * dt_s
    share = most / change if (change := math.hypot(du, dv)) > most else 1.0
    return Velocity(state.u + share * du, w, state.v + share * dv) if share < 1.0 else target._replace(w=w)


def _steered(limits: Limits, u: float, w: float) -> float:
    """The turning rate nearest to `w` that the robot can have at the speed `u`."""
    if limits.curvature == math.inf:
        return w
    most = limits.curvature * abs(u)
    return min(max(w, -most), most)


def _clip(value: float, lowest: float, highest: float) -> float:
    """The nearest value within the limits; 0 for what is no number (the layers before may overflow)."""
    return 0.0 if math.isnan(value) else min(max(value, lowest), highest)


def _ramp(now: float, target: float, up: float, down: float, dt_s: float) -> float:
    """The nearest to `target` that is reached from `now` in `dt_s`, gaining at `up`, losing at `down`."""
    if now < 0.0 or (now == 0.0 and target < 0.0):
        return -_ramp(-now, -target, up, down, dt_s)
    if target >= now:
        return min(target, now + up * dt_s)
    slowed = now - down * dt_s
    if slowed >= 0.0:
        return max(target, slowed)
    return max(target, slowed * up / down)
