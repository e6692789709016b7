"""Kinematics of a differential-drive robot seen at its control point, a distance `a` ahead of the axle.

Steering the control point instead of the axle makes the inverse exist: both of its velocity components
can be commanded, at the price of dividing by `a`.
"""

import math

from maniple.core.geometry import Pose


def control_point(pose: Pose, a: float) -> tuple[float, float]:
    """The control point h = (x + a cos psi, y + a sin psi) of a robot, in the frame of its pose (m)."""
    return pose.x + a * math.cos(pose.psi), pose.y + a * math.sin(pose.psi)


def forward(psi: float, a: float, u: float, w: float) -> tuple[float, float]:
    """Velocity of the control point, eq. (1): h' = K (u, w)^T.

    `psi` is the heading (rad), `u` the forward speed (m/s), `w` the turning rate (rad/s). Returns
    (vx, vy) in m/s in the frame `psi` is given in.
    """
    c, s = math.cos(psi), math.sin(psi)
    return u * c - a * w * s, u * s + a * w * c


def inverse(psi: float, a: float, vx: float, vy: float) -> tuple[float, float]:
    """The (u m/s, w rad/s) that give the control point the velocity (vx, vy), eq. (2): (u, w)^T = K^-1 h'.

    The right-hand side of eq. (2) is the velocity h', not the position h as printed.
    """
    c, s = math.cos(psi), math.sin(psi)
    return vx * c + vy * s, (vy * c - vx * s) / a
