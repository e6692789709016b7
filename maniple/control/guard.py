"""A robot's last word on what it is told: age, speed, acceleration and braking limits, and clearance."""

import math
from typing import Literal, NamedTuple, TypeAlias

from maniple.control.clearance import clear_speed
from maniple.control.limits import Limits, Velocity
from maniple.control.returns import Returns
from maniple.core.scenario.types import Guard

Reason: TypeAlias = Literal["none", "age", "speed", "acceleration", "clearance", "blind"]
"""Which limit changed the command last."""


_STILL_M = 1e-3
"""A robot that rolls on for less than this stands."""


class Verdict(NamedTuple):
    """What may be sent to the drive."""

    u: float
    """m/s."""
    w: float
    """rad/s."""
    reason: Reason


def step(
    parameters: Guard,
    limits: Limits,
    state: Velocity,
    command: tuple[float, float] | None,
    age_s: float,
    returns: Returns | None,
    dt_s: float,
    measured: Velocity,
) -> Verdict:
    """What of `command` (u m/s, w rad/s) may be done, `dt_s` after `state` was sent.

    `command` is None where there is none; `age_s` is the age of what it was computed from; `returns` are
    what the robot senses now, None where that is not known. `state` is within the limits; `measured` is how
    the robot really moves.
    """
    reason: Reason = "none"
    u, w = command if command is not None else (0.0, 0.0)
    if command is None or age_s >= limits.stop_s:
        u, w, reason = 0.0, 0.0, "age"
    elif age_s > limits.hold_s:
        share = (limits.stop_s - age_s) / (limits.stop_s - limits.hold_s)
        u, w, reason = u * share, w * share, "age"
    if limits.needs_ranges and returns is None:
        u, w, reason = 0.0, 0.0, "blind"
    if not (limits.u_min <= u <= limits.u_max and abs(w) <= limits.w_max):
        u = _clip(u, limits.u_min, limits.u_max)
        w = _clip(w, -limits.w_max, limits.w_max)
        reason = "speed"
    w_now = _ramp(state.w, w, limits.w_accel, limits.w_accel, dt_s)
    u_now = _ramp(state.u, u, limits.u_accel, limits.brake, dt_s)
    if reason != "blind" and (u_now != u or w_now != w):
        reason = "acceleration"
    verdict = Verdict(u_now, w_now, reason)
    if not parameters.clearance or returns is None:
        return verdict
    for ahead in (True, False):
        verdict = _cleared(parameters, limits, state, verdict, returns, dt_s, measured, ahead)
    return verdict


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
    u, w, reason = wanted
    going, rolling = (u, measured.u) if ahead else (-u, -measured.u)
    rolls_on = rolling * limits.u_lag_s > _STILL_M
    if not (going > 0.0 or rolls_on):
        return wanted
    if not (returns.sees_ahead if ahead else returns.sees_behind):
        if going <= 0.0:
            return wanted
        return Verdict(_ramp(state.u, 0.0, limits.u_accel, limits.brake, dt_s), w, "blind")
    heading = Velocity(max(going, 0.0), abs(w))
    wheels = Velocity(max(rolling, 0.0), abs(measured.w))
    clear = clear_speed(parameters, limits, heading, wheels, ahead, returns, dt_s)
    if going > (most := max(min(clear), 0.0)):
        u = _ramp(state.u, most if ahead else -most, limits.u_accel, limits.brake, dt_s)
        going, reason = abs(u), "clearance"
    if (going > 0.0 or rolls_on) and going > clear.stoppable:
        w, reason = _ramp(state.w, 0.0, limits.w_accel, limits.w_accel, dt_s), "clearance"
    return Verdict(u, w, reason)


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
