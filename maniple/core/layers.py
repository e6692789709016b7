"""The layers of one robot."""

from typing import Literal, TypeAlias

Layer: TypeAlias = Literal["kinematics", "avoidance", "compensation", "drive"]
"""The layers of one robot, in the order of the pipeline."""
