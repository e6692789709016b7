"""What a robot can do and how old its commands may be, from its model and the scenario."""

import math
from typing import NamedTuple

from maniple.core.layers import onboard_layers
from maniple.core.scenario import outline
from maniple.core.scenario.places import fastest_place_mps
from maniple.core.scenario.types import Robot, RobotModel, Scenario


class Limits(NamedTuple):
    """What a robot can do and how old its commands may be."""

    u_min: float
    """m/s; negative is backwards, 0 for a robot that can't."""
    u_max: float
    """m/s."""
    w_max: float
    """rad/s, either way."""
    u_accel: float
    """m/s^2, gaining speed."""
    w_accel: float
    """rad/s^2, gaining and losing."""
    brake: float
    """m/s^2, losing speed."""
    radius: float
    """Of the circle around the body, m."""
    gain: float
    """The drive goes at most this much faster than it is told, at least 1."""
    u_lag_s: float
    """Its speed follows what it is told with a first-order lag of at most this."""
    w_lag_s: float
    """So does its turning rate."""
    delay_s: float
    """How old odometry and ranges may be."""
    needs_ranges: bool
    """Whether its own layers or its guard go by ranges: without any it stands."""
    hold_s: float
    """From this age of a command on it slows down."""
    stop_s: float
    """At this age it stands."""
    v_max: float = 0.0
    """m/s, sideways either way; 0 for a robot that can't."""
    curvature: float = math.inf
    """1/m, the most it turns for each metre it drives."""
    centre: float = 0.0
    """m, how far ahead of the middle of the axle the middle of that circle is."""
    swing: float = 0.0
    """rad, the most its way differs from ahead or backwards where the robot drives an arc."""


class Velocity(NamedTuple):
    """Of a robot: what was last sent to its drive, or what is measured."""

    u: float = 0.0
    """m/s."""
    w: float = 0.0
    """rad/s."""
    v: float = 0.0
    """Sideways to the left, of a robot that can, m/s."""


def limits_of(scenario: Scenario, robot: Robot) -> Limits:
    """The limits of a robot of a resolved scenario."""
    model, rates = scenario.model_of(robot), scenario.rates
    th1, th2, _, th4, _, th6 = model.theta
    hold_s, stop_s = age_limits(scenario, robot)
    curvature = curvature_max(model)
    centre, radius = outline.circle(model)
    avoids = "avoidance" in onboard_layers(scenario.placement.robot_from)
    return Limits(
        u_min=-model.u_max_mps,
        u_max=model.u_max_mps,
        w_max=model.w_max_radps,
        u_accel=model.u_accel_mps2,
        w_accel=model.w_accel_radps2,
        brake=model.brake_mps2,
        radius=radius,
        gain=max(1.0, 1.0 / th4, 1.0 / th6),
        u_lag_s=th1 / th4,
        w_lag_s=th2 / th6,
        delay_s=1.0 / min(rates.motion_hz, rates.scan_hz),
        needs_ranges=scenario.guard.clearance or (avoids and scenario.avoidance.enabled),
        hold_s=hold_s,
        stop_s=stop_s,
        v_max=model.v_max_mps or 0.0,
        curvature=curvature,
        centre=centre,
        swing=math.atan(curvature * abs(centre)) if centre else 0.0,
    )


def aged(limits: Limits, stop_s: float) -> Limits:
    """`limits` with a robot that stands at the age `stop_s` of its commands (0: as it is) and slows down from
    as much earlier in proportion, where that is less than its own."""
    if not 0.0 < stop_s < limits.stop_s:
        return limits
    return limits._replace(hold_s=limits.hold_s * stop_s / limits.stop_s, stop_s=stop_s)


def curvature_max(model: RobotModel) -> float:
    """The most a robot turns per metre it drives (1/m): tan(steer_max) / wheelbase of a car, or infinite."""
    if model.drive != "car":
        return math.inf
    assert model.wheelbase_m is not None, "the scenario was checked"
    assert model.steer_max_rad is not None, "the scenario was checked"
    return math.tan(model.steer_max_rad) / model.wheelbase_m


def age_limits(scenario: Scenario, robot: Robot) -> tuple[float, float]:
    """(hold_after_s, stop_after_s) of a robot: the scenario's, else from the delay its loop tolerates.

    A first-order loop of gain k stays stable with delays up to pi / (2 k), its delay margin.

    - With the inverse kinematics in the centre, the stale heading is fed back with gain v/a, eq. (2), and
      the drive's own lag th1/th4 uses up a part: (pi/2) (a/v) - lag, v the larger of the reference's speed
      and the largest correction, eq. (7).
    - With the inverse kinematics on the robot the heading is fresh and what is left is the position error,
      fed back with gain kappa: pi / (2 kappa), of which 0.8 is used.

    Never less than three control periods: no command could be younger. `hold` defaults to half of `stop`
    and is at most `stop`.
    """
    law, placed = scenario.guard, scenario.placement.robot_from
    if law.stop_after_s is not None:
        stop = law.stop_after_s
    else:
        gains = scenario.controller
        if placed == "kinematics":
            tolerated = 0.8 * math.pi / (2.0 * _planar(gains.kappa))
        else:
            theta = scenario.model_of(robot).theta
            speed = max(fastest_place_mps(scenario), _planar(gains.saturation))
            tolerated = 0.5 * math.pi * robot.control_point_m / speed - theta[0] / theta[3]
        stop = max(tolerated, 3.0 / scenario.rates.control_hz)
    return min(law.hold_after_s if law.hold_after_s is not None else 0.5 * stop, stop), stop


def _planar(gain: float | tuple[float, ...]) -> float:
    """The larger of the x and y entries of a diagonal gain."""
    return max(gain[:2]) if isinstance(gain, tuple) else gain
