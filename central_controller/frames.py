"""From the frame of a robot's odometry (its own, which starts at (0, 0, 0), or the world) to the formation
frame and back."""

from typing import NamedTuple

from maniple.control.unicycle import control_point
from maniple.core.geometry import Pose, wrap
from maniple.core.messages import Odometry


class Mounting(NamedTuple):
    """Where the frame of a robot's odometry is in the formation frame, and which of its points is led."""

    origin: Pose
    """Of its own frame, its initial pose."""
    control_point_m: float

    def point(self, own: Pose) -> tuple[float, float]:
        """The control point (m) in the formation frame of the robot at `own` in the frame of its odometry."""
        return control_point(self.origin.compose(own), self.control_point_m)

    def velocity_in_own(self, vx: float, vy: float) -> tuple[float, float]:
        """A velocity given in the formation frame, in the frame of the odometry."""
        return Pose(0.0, 0.0, -self.origin.psi).rotate(vx, vy)


def propagated(odometry: Odometry, age_s: float) -> Pose:
    """Where the robot is in the frame of its odometry `age_s` after that: straight on with its speed, and
    turned with its turning rate, which is not kept for long. On an arc of several seconds a robot that swings
    would be thought aside by up to (u w / 2) age_s^2, and be steered after that: the loop loses half its
    margin."""
    pose = Pose(odometry.x_m, odometry.y_m, odometry.psi_rad)
    x, y, _ = pose.advance(odometry.u_mps * age_s, 0.0, odometry.v_mps * age_s)
    return Pose(x, y, wrap(pose.psi + odometry.w_radps * age_s))
