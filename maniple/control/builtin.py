"""The built-in layers of a robot, by the names that scenarios use."""

from maniple.control.avoidance import Impedances
from maniple.control.compensation import Adaptive
from maniple.control.kinematics import kinematics_of
from maniple.control.parts import Parts

BUILTIN = Parts(
    avoidance={"impedance": Impedances},
    compensation={"adaptive": Adaptive},
    kinematics={"": kinematics_of},
)
"""Formation laws and planners are the controller's."""
