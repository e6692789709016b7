"""One robot with a laser drives along a line past a disc, steered by the formation law and the avoidance."""

import math
from typing import NamedTuple

import numpy as np

from maniple.control import avoidance, unicycle
from maniple.control.returns import Returns
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Avoidance

ROBOT_M, DISC_M = 0.25, 0.15
"""Radii of the robot and of the disc."""
AHEAD_M, BEHIND_M = 3.0, 3.0
"""How far before the disc the robot starts, and how far behind it ends."""
KAPPA, SATURATION = 0.25, 0.10
DT_S = 0.1
LAG_S = 0.3
"""Time constant of the robot's velocities."""
BEAMS: Floats = np.radians(np.arange(-90.0, 91.0))


class Passage(NamedTuple):
    """How it went."""

    clearance_m: float
    """Smallest distance of the outlines; negative is a collision."""
    off_line_m: float
    """Distance of the control point from the line at the end."""


def seen(pose: Pose, disc: tuple[float, float]) -> Returns:
    """What a laser of 181 beams sees of the disc centred at `disc` (m), from the robot's centre."""
    dx, dy = disc[0] - pose.x, disc[1] - pose.y
    distance, bearing = math.hypot(dx, dy), math.atan2(dy, dx) - pose.psi
    off = BEAMS - bearing
    miss = distance * np.sin(off)
    hits = ((np.abs(miss) < DISC_M) & (np.cos(off) > 0.0)).nonzero()[0]
    ranges = distance * np.cos(off[hits]) - np.sqrt(DISC_M**2 - miss[hits] ** 2)
    return Returns(ranges, BEAMS[hits], True, False)


def drive_past(parameters: Avoidance, speed_mps: float, a_m: float, beside_m: float) -> Passage:
    """Drive at `speed_mps` with the control point `a_m` ahead of the axle; the disc's centre is `beside_m`
    left of the line."""
    disc = (AHEAD_M, beside_m)
    pose, u, w, state, clearance = Pose(-a_m, 0.0, 0.0), 0.0, 0.0, avoidance.REST, math.inf
    decay = -math.expm1(-DT_S / LAG_S)
    for step in range(math.ceil((AHEAD_M + BEHIND_M) / speed_mps / DT_S)):
        x, y = unicycle.control_point(pose, a_m)
        vx = speed_mps + SATURATION * math.tanh(KAPPA / SATURATION * (speed_mps * step * DT_S - x))
        vy = SATURATION * math.tanh(KAPPA / SATURATION * -y)
        state = avoidance.step(parameters, state, avoidance.forces(parameters, seen(pose, disc)), DT_S)
        wanted_u, wanted_w = unicycle.inverse(pose.psi, a_m, vx, vy)
        u += decay * (wanted_u - state.u_cor - u)
        w += decay * (wanted_w + state.w_cor - w)
        pose = pose.advance(u * DT_S, w * DT_S)
        clearance = min(clearance, math.dist(pose[:2], disc) - ROBOT_M - DISC_M)
    return Passage(clearance, abs(unicycle.control_point(pose, a_m)[1]))
