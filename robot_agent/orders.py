"""The command a robot holds, and how old what it was computed from is by the robot's own clock."""

from typing import Literal, TypeAlias

from maniple.core.layers import Layer
from maniple.core.messages import Command, Stamp
from maniple.core.time import Time, to_seconds

Refusal: TypeAlias = Literal["layer", "incarnation", "future"]
"""Why a command is not taken: cut at another layer; computed from what an earlier life of this agent said;
computed from what this agent has not said yet."""


class Orders:
    """Holds the last command for a robot that runs its layers from `layer` on.

    A command carries back the stamp of the odometry it was computed from. That stamp is by this robot's own
    clock, so the age needs no clocks in step.
    """

    def __init__(self, layer: Layer, incarnation: int) -> None:
        self._layer = layer
        self._incarnation = incarnation
        self._arrived: Time = 0
        self.command: Command | None = None

    def take(self, command: Command, now: Time) -> Refusal | None:
        """Hold `command` from now on, or say why not."""
        if command.layer != self._layer:
            return "layer"
        if command.answers.incarnation != self._incarnation:
            return "incarnation"
        if command.answers.stamp_ns > now:
            return "future"
        self.command = command
        self._arrived = now
        return None

    def age_s(self, now: Time) -> float:
        """Age of what the command was computed from, s: since the odometry it answers was sent, or what the
        controller says of its oldest input if that makes it older. -1 without a command."""
        command = self.command
        if command is None:
            return -1.0
        return to_seconds(max(now - command.answers.stamp_ns, now - self._arrived + command.inputs_age_ns))

    def stamp(self) -> Stamp:
        """Points at the command that is held."""
        assert self.command is not None
        return Stamp(self.command.incarnation, self.command.seq, self.command.stamp_ns)
