"""How much delay the loop through the network tolerates, linearised about going straight in formation."""

import math

import numpy as np

from maniple.core.scenario.places import fastest_place_mps
from maniple.core.scenario.types import Robot, Scenario

NEWTON = 40
"""Steps; few are needed."""


def delay_margin_s(scenario: Scenario, robot: Robot) -> float | None:
    """The age of data (s) at which the loop of a robot of a resolved scenario loses its stability; None for
    a robot without a differential drive.

    Of the control point, with psi its heading error, y its offset sideways and w delayed by the age T,
    y' = v psi + a w and psi' = w. The controller carries odometry forward over its age, taken for T/2 (both
    ways are alike). With the inverse kinematics in the centre, w = -(v psi + kappa y)/a behind the drive's
    lag tau, the open loop is

        L(s) = (1 + s T/2) ((v/a + kappa) s + kappa v/a) e^(-s T) / (s^2 (1 + tau s));

    with it on the robot the heading is fresh, and L(s) = (1 + s T/2) kappa e^(-s T) / (s (1 + tau s)). The
    margin is the least T with which L passes -1. If nothing were carried forward and kappa were small
    against v/a, the first would be about (pi/2)(a/v) - tau.
    """
    model = scenario.model_of(robot)
    if model.drive != "differential":
        return None
    th1, th2, _, th4, _, th6 = model.theta
    kappa = scenario.controller.kappa
    kappa = max(kappa[:2]) if isinstance(kappa, tuple) else kappa
    if scenario.placement.robot_from == "kinematics":
        return margin(kappa, 0.0, th1 / th4)
    turning = fastest_place_mps(scenario) / robot.control_point_m
    return margin(turning + kappa, turning * kappa, th2 / th6)


def margin(first: float, second: float, lag_s: float, carried: float = 0.5) -> float:
    """Delay margin T (s) of L(s) = (1 + carried T s) (first s + second) e^(-s T) / (s^2 (1 + lag_s s)).

    `first` > 0 in 1/s, `second` >= 0 in 1/s^2; 0 where the loop is unstable without any delay.

    At each frequency one T gives L the phase -pi; the least of those with which it has the size 1.
    """
    w = np.geomspace(1e-3, 1e3, 20_001) * max(first, second / first)
    angle = np.arctan2(first * w, second) - np.arctan(lag_s * w)
    w, angle = w[angle > 0.0], angle[angle > 0.0]
    turn = angle.copy()  # w T, from w T - arctan(carried w T) = angle
    for _ in range(NEWTON):
        lead = carried * turn
        turn -= (turn - np.arctan(lead) - angle) / (1.0 - carried / (1.0 + lead**2))
    size = np.hypot(1.0, carried * turn) * np.hypot(first * w, second) / (w**2 * np.hypot(1.0, lag_s * w))
    crossings = np.flatnonzero((size[:-1] > 1.0) & (size[1:] <= 1.0))
    return float((turn / w)[crossings].min(initial=math.inf)) if crossings.size else 0.0
