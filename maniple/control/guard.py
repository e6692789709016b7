"""A robot's last word on what it is told: age, speed, acceleration and braking, clearance and fence."""

import math
from typing import Literal, NamedTuple, TypeAlias

from maniple.control.clearance import clear_speed, clear_velocity
from maniple.control.geofence import is_out
from maniple.control.limits import Limits, Velocity
from maniple.control.returns import Returns, joined, moved
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Guard

Reason: TypeAlias = Literal["none", "age", "speed", "acceleration", "clearance", "blind", "fence"]
"""Which limit changed the command last."""


_STILL_M = 1e-3
"""A robot that rolls on for less than this stands."""
_RETURN_MPS = 0.1
"""How fast a robot that is not inside its fence goes back."""
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
    fence: Returns | None = None,
) -> Verdict:
    """What of `command` may be done, `dt_s` after `state` was sent.

    `command` is None where there is none; `age_s` is the age of what it was computed from; `returns` are
    what the robot senses now, None where that is not known. `state` is within the limits; `measured` is how
    the robot really moves; `fence` is what `geofence.seen_from` gives for the middle of its circle, where
    there is a fence.
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
    bounds = limits
    if fence is not None and is_out(fence, limits.radius):
        slow = _slowed(sent, _RETURN_MPS)
        if limits.curvature < math.inf:  # straight: it could not turn back in on the spot
            slow, bounds = slow._replace(w=0.0), limits._replace(swing=0.0)
        if slow != sent:
            sent, reason = _ramped(limits, state, slow, dt_s), "fence"
    verdict = Verdict(sent, reason)
    seen = returns if parameters.clearance else None
    if seen is None and fence is None:
        return verdict
    if seen is not None and limits.centre:
        seen = moved(seen, Pose(limits.centre, 0.0, 0.0))
    if limits.v_max and (seen is None or (seen.sees_ahead and seen.sees_behind)):
        verdict = _cleared_all_round(parameters, limits, state, verdict, seen, fence, dt_s, measured)
    else:
        if seen is not None:
            if sent.v:
                verdict = Verdict(_ramped(limits, state, able._replace(v=0.0), dt_s), "blind")
            for ahead in (True, False):
                verdict = _cleared(
                    parameters, limits, state, verdict, seen, "clearance", dt_s, measured, ahead
                )
        if fence is not None:
            for ahead in (True, False):
                verdict = _cleared(parameters, bounds, state, verdict, fence, "fence", dt_s, measured, ahead)
    (u, w, v), reason = verdict
    return Verdict(Velocity(u, _steered(limits, u, w), v), reason)


def _cleared_all_round(
    parameters: Guard,
    limits: Limits,
    state: Velocity,
    wanted: Verdict,
    seen: Returns | None,
    fence: Returns | None,
    dt_s: float,
    measured: Velocity,
) -> Verdict:
    """What of `wanted` the clearance rules leave a robot that moves in every direction, for what it sees and
    its fence together: what slides along the one may not go into the other."""
    around = fence if seen is None else seen if fence is None else joined(seen, fence)
    assert around is not None, "there is something"
    sent = wanted.velocity
    clear = clear_velocity(parameters, limits, sent, measured, around, dt_s)
    if clear == sent:
        return wanted
    free = seen is None or clear_velocity(parameters, limits, sent, measured, seen, dt_s) == sent
    return Verdict(_ramped(limits, state, clear, dt_s), "fence" if free else "clearance")


def _cleared(
    parameters: Guard,
    limits: Limits,
    state: Velocity,
    wanted: Verdict,
    returns: Returns,
    why: Reason,
    dt_s: float,
    measured: Velocity,
    ahead: bool,
) -> Verdict:
    """What of `wanted` the clearance rules leave, as far as the robot goes or still rolls that way; `why` is
    what `returns` are of."""
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
        going, reason = abs(u), why
    if (going > 0.0 or rolls_on) and going > clear.stoppable:
        w, reason = _ramp(state.w, 0.0, limits.w_accel, limits.w_accel, dt_s), why
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


def _slowed(velocity: Velocity, most: float) -> Velocity:
    """The same way, no faster than `most` (m/s)."""
    u, w, v = velocity
    speed = math.hypot(u, v)
    return velocity if speed <= most else Velocity(u * most / speed, w, v * most / speed)


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
