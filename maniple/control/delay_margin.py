"""How much delay the loop through the network tolerates, linearised about going straight in formation."""

import math

import numpy as np

from maniple.core.scenario.places import fastest_place_mps
from maniple.core.scenario.types import Robot, Scenario


def delay_margin_s(scenario: Scenario, robot: Robot) -> float | None:
    """The age of data (s) at which the loop of a robot of a resolved scenario loses its stability; None for
    a robot without a differential drive.

    Of the control point, with psi its heading error, y its offset sideways and w delayed by the age T,
    y' = v psi + a w and psi' = w. With the inverse kinematics in the centre, w = -(v psi + kappa y)/a behind
    the drive's lag tau, the open loop is

        L(s) = ((v/a + kappa) s + kappa v/a) e^(-s T) / (s^2 (1 + tau s));

    with it on the robot the heading is fresh, and L(s) = kappa e^(-s T) / (s (1 + tau s)). The margin is
    the T at which L passes -1. For kappa small against v/a the first is about (pi/2)(a/v) - tau.
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


def margin(first: float, second: float, lag_s: float) -> float:
    """Delay margin (s) of L(s) = (first s + second) / (s^2 (1 + lag_s s)): `first` > 0 in 1/s, `second` >= 0
    in 1/s^2. Negative where the loop is unstable without any delay."""
    roots = np.roots([lag_s**2, 1.0, -(first**2), -(second**2)])  # |L| = 1, in the square of the frequency
    crossover = math.sqrt(max(roots[abs(roots.imag) < 1e-9].real))
    return (math.atan2(first * crossover, second) - math.atan(lag_s * crossover)) / crossover
