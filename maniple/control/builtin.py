"""The built-in layers of a robot, by the names that scenarios use."""

from maniple.control.avoidance import Impedances
from maniple.control.compensation import Adaptive
from maniple.control.kinematics import kinematics_of
from maniple.control.parts import Parts

BUILTIN = Parts(
    kinematics={"": kinematics_of},
    avoidance={"impedance": Impedances},
    compensation={"adaptive": Adaptive},
)
"""Formation laws and planners are the controller's. "" is the kinematics of the robot's own drive."""
