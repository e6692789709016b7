"""The modes of a robot's agent, as a literal table."""

from collections.abc import Mapping
from typing import Literal, TypeAlias

from maniple.core.messages import Mode

Event: TypeAlias = Literal[
    "contrary",
    "layer_failed",
    "driver_lost",
    "driver_ready",
    "driver_active",
    "blind",
    "fresh",
    "aging",
    "old",
    "emergency",
    "armed",
    "displaced",
    "stop",
]
"""What a tick finds of the robot: it has moved against what it was told. Of its own layers: one has failed,
for good. What it finds of the driver: silent, faulty or not controllable; there but not active; active. If it
is active: no ranges known where they are needed. What it finds of the command, if it sees: young enough; old
enough to slow down; too old to move. What an operator says: everything stands; it may move again. That the
robot turns out to be elsewhere than was believed. And the end of the agent."""

TRANSITIONS: Mapping[tuple[Mode, Event], Mode] = {
    ("waiting", "contrary"): "fault",
    ("waiting", "layer_failed"): "fault",
    ("waiting", "driver_lost"): "waiting",
    ("waiting", "driver_ready"): "waiting",
    ("waiting", "driver_active"): "waiting",
    ("waiting", "blind"): "waiting",
    ("waiting", "fresh"): "tracking",
    ("waiting", "aging"): "holding",
    ("waiting", "old"): "waiting",
    ("waiting", "emergency"): "emergency",
    ("waiting", "armed"): "waiting",
    ("waiting", "displaced"): "waiting",
    ("waiting", "stop"): "stopped",
    ("tracking", "contrary"): "fault",
    ("tracking", "layer_failed"): "fault",
    ("tracking", "driver_lost"): "fault",
    ("tracking", "driver_ready"): "waiting",
    ("tracking", "driver_active"): "tracking",
    ("tracking", "blind"): "holding",
    ("tracking", "fresh"): "tracking",
    ("tracking", "aging"): "holding",
    ("tracking", "old"): "holding",
    ("tracking", "emergency"): "emergency",
    ("tracking", "armed"): "tracking",
    ("tracking", "displaced"): "waiting",
    ("tracking", "stop"): "stopped",
    ("holding", "contrary"): "fault",
    ("holding", "layer_failed"): "fault",
    ("holding", "driver_lost"): "fault",
    ("holding", "driver_ready"): "waiting",
    ("holding", "driver_active"): "holding",
    ("holding", "blind"): "holding",
    ("holding", "fresh"): "tracking",
    ("holding", "aging"): "holding",
    ("holding", "old"): "holding",
    ("holding", "emergency"): "emergency",
    ("holding", "armed"): "holding",
    ("holding", "displaced"): "waiting",
    ("holding", "stop"): "stopped",
    ("emergency", "contrary"): "emergency",
    ("emergency", "layer_failed"): "emergency",
    ("emergency", "driver_lost"): "emergency",
    ("emergency", "driver_ready"): "emergency",
    ("emergency", "driver_active"): "emergency",
    ("emergency", "blind"): "emergency",
    ("emergency", "fresh"): "emergency",
    ("emergency", "aging"): "emergency",
    ("emergency", "old"): "emergency",
    ("emergency", "emergency"): "emergency",
    ("emergency", "armed"): "waiting",
    ("emergency", "displaced"): "emergency",
    ("emergency", "stop"): "stopped",
    ("stopped", "contrary"): "stopped",
    ("stopped", "layer_failed"): "stopped",
    ("stopped", "driver_lost"): "stopped",
    ("stopped", "driver_ready"): "stopped",
    ("stopped", "driver_active"): "stopped",
    ("stopped", "blind"): "stopped",
    ("stopped", "fresh"): "stopped",
    ("stopped", "aging"): "stopped",
    ("stopped", "old"): "stopped",
    ("stopped", "emergency"): "stopped",
    ("stopped", "armed"): "stopped",
    ("stopped", "displaced"): "stopped",
    ("stopped", "stop"): "stopped",
    ("fault", "contrary"): "fault",
    ("fault", "layer_failed"): "fault",
    ("fault", "driver_lost"): "fault",
    ("fault", "driver_ready"): "waiting",
    ("fault", "driver_active"): "waiting",
    ("fault", "blind"): "fault",
    ("fault", "fresh"): "fault",
    ("fault", "aging"): "fault",
    ("fault", "old"): "fault",
    ("fault", "emergency"): "emergency",
    ("fault", "armed"): "fault",
    ("fault", "displaced"): "fault",
    ("fault", "stop"): "stopped",
}
"""The mode after an event, for every mode and event."""

MOVES: Mapping[Mode, bool] = {
    "waiting": False,
    "tracking": True,
    "holding": True,
    "emergency": False,
    "stopped": False,
    "fault": False,
}
"""Whether the drive gets anything but zero. (A holding robot slows down and stands by its guard.)"""

WANTS_DRIVER: Mapping[Mode, bool | None] = {
    "waiting": True,
    "tracking": True,
    "holding": True,
    "emergency": None,
    "stopped": False,
    "fault": False,
}
"""Whether the driver is asked to be active; None: as before, so that a drive that is active brakes and holds
the robot, and one that is not stays off."""
