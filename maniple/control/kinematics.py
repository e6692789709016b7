"""K and K^-1 of each kind of robot, eqs. (1) and (2): between the velocity of the control point, a distance
`a` ahead of the middle of the axle, and what the drive is told.
"""

import math
from typing import Protocol

from maniple.control import unicycle
from maniple.control.limits import Velocity, curvature_max
from maniple.core.geometry import Pose
from maniple.core.scenario.types import RobotModel


class Kinematics(Protocol):
    """How one robot moves its control point. It may have a state of its own: one for each robot."""

    def point(self, pose: Pose) -> tuple[float, float]:
        """The control point (m) of a robot at `pose`, in the frame of the pose."""
        ...

    def forward(self, psi: float, velocity: Velocity) -> tuple[float, float]:
        """Velocity (vx, vy) in m/s of the control point of a robot that moves at `velocity`, in the frame
        that its heading `psi` (rad) is given in."""
        ...

    def inverse(self, psi: float, vx: float, vy: float, turn: float) -> Velocity:
        """What the drive is told, so that the control point moves at (vx, vy) m/s in the frame that the
        heading `psi` (rad) is given in, or as near to that as the robot can. `turn` (rad/s) is how the
        formation turns, for robots whose heading is free."""
        ...


class _Rigid:
    """What is the same for every robot: the control point is fixed to its body."""

    def __init__(self, a: float) -> None:
        self._a = a

    def point(self, pose: Pose) -> tuple[float, float]:
        """See `Kinematics`."""
        return unicycle.control_point(pose, self._a)

    def forward(self, psi: float, velocity: Velocity) -> tuple[float, float]:
        """See `Kinematics`: R(psi) (u, v + a w)."""
        u, w, v = velocity
        return Pose(0.0, 0.0, psi).rotate(u, v + self._a * w)


class Differential(_Rigid):
    """Two driven wheels: the heading follows from where the control point is to go."""

    def inverse(self, psi: float, vx: float, vy: float, turn: float) -> Velocity:  # noqa: ARG002
        """See `Kinematics`: exact."""
        return Velocity(*unicycle.inverse(psi, self._a, vx, vy))


class Omnidirectional(_Rigid):
    """Moves in every direction, and turns as the formation turns."""

    def inverse(self, psi: float, vx: float, vy: float, turn: float) -> Velocity:
        """See `Kinematics`: exact."""
        u, v = Pose(0.0, 0.0, -psi).rotate(vx, vy)
        return Velocity(u, turn, v - self._a * turn)


class Car(_Rigid):
    """Steered front wheels: |w| <= curvature |u|, and no turning on the spot.

    So the control point moves only in directions within an angle g of straight ahead or of straight back,
    tan g = a curvature. Outside, the robot goes in the nearest of these directions, at the speed that is
    wanted: on the tightest arc. It stays with its gear until the wanted direction is 90 degrees + g / 2 away
    from it. The angle between what is wanted and what is done is then at most 90 degrees - g / 2, so that a
    point that is pulled straight to its target always gets nearer, in as many strokes ahead and back as it
    takes.
    """

    def __init__(self, a: float, curvature: float) -> None:
        super().__init__(a)
        self._curvature = curvature
        self._edge = math.atan(a * curvature)
        self._gear = 1.0

    @property
    def memory(self) -> tuple[float, ...]:
        """See `Remembering`: -1 in reverse."""
        return () if self._gear > 0.0 else (self._gear,)

    def recall(self, memory: tuple[float, ...]) -> None:
        """See `Remembering`."""
        (gear,) = memory or (1.0,)
        self._gear = math.copysign(1.0, gear)

    def inverse(self, psi: float, vx: float, vy: float, turn: float) -> Velocity:  # noqa: ARG002
        """See `Kinematics`: exact within g of straight ahead, or back while in reverse."""
        ahead, aside = Pose(0.0, 0.0, -psi).rotate(vx, vy)
        speed = math.hypot(ahead, aside)
        if self._gear * ahead < -math.sin(0.5 * self._edge) * speed:
            self._gear = -self._gear
        if abs(aside) <= math.tan(self._edge) * self._gear * ahead:
            return Velocity(ahead, aside / self._a)
        along = speed * math.cos(self._edge)
        return Velocity(self._gear * along, math.copysign(self._curvature * along, aside))


def kinematics_of(model: RobotModel, control_point_m: float) -> Kinematics:
    """The kinematics of a robot of this type whose control point is `control_point_m` ahead of its axle."""
    if model.drive == "omnidirectional":
        return Omnidirectional(control_point_m)
    if model.drive == "car":
        return Car(control_point_m, curvature_max(model))
    return Differential(control_point_m)
