"""Obstacle avoidance of robots whose heading is free, by laws that are made for robots that steer."""

import math

from maniple.control.limits import Velocity
from maniple.control.memory import recall, remembered
from maniple.control.parts import AvoidanceLaw
from maniple.control.returns import Returns
from maniple.core.geometry import Pose, wrap_array

_SLOW_MPS = 0.01
"""Slower than this the direction of travel says nothing."""


class Swerve:
    """Lets an avoidance law drive a robot that moves in every direction.

    The law sees everything as if the robot faced the way it goes. Where it turns, the robot moves sideways
    instead, as far as turning would have moved its control point, `control_point_m` ahead.
    """

    def __init__(self, law: AvoidanceLaw, control_point_m: float) -> None:
        self._law = law
        self._arm = control_point_m
        self._direction = 0.0

    @property
    def memory(self) -> tuple[float, ...]:
        """See `Remembering`: the direction it goes, and what the law remembers."""
        own = remembered(self._law)
        return (self._direction, *own) if own or self._direction else ()

    def recall(self, memory: tuple[float, ...]) -> None:
        """See `Remembering`."""
        self._direction, own = (memory[0], memory[1:]) if memory else (0.0, ())
        recall(self._law, own)

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
        """See `AvoidanceLaw`."""
        u, w, v = wanted
        speed = math.hypot(u, v)
        if speed > _SLOW_MPS:
            self._direction = math.atan2(v, u)
        ahead, aside = Pose(0.0, 0.0, -self._direction).rotate(u, v)
        if returns is not None:
            returns = returns._replace(bearing=wrap_array(returns.bearing - self._direction))
        told = self._law.step(Velocity(ahead, w, aside), returns, dt_s)
        u, v = Pose(0.0, 0.0, self._direction).rotate(told.u, told.v + self._arm * (told.w - w))
        return Velocity(u, w, v)
