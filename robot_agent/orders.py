"""The command a robot holds, and how old what it was computed from is by the robot's own clock."""

from typing import Literal, TypeAlias

from maniple.core.layers import Layer
from maniple.core.messages import Command, Stamp
from maniple.core.time import Time, to_seconds

Refusal: TypeAlias = Literal["layer", "incarnation", "earlier", "future", "absurd"]
"""Why a command is not taken: cut at another layer; computed from what another life of this agent said;
from what this one said before it was armed or knew its frame; from what it has not said yet; with values
that no robot can mean."""

_ABSURD = 1000.0
"""Nothing here moves this fast (m/s) or turns this fast (rad/s). What is merely too fast is up to the guard;
this much would only bring a layer before it down."""


class Orders:
    """Holds the last command for a robot that runs its layers from `layer` on.

    A command carries back the stamp of the odometry it was computed from. That stamp is by this robot's own
    clock, so the age needs no clocks in step.
    """

    def __init__(self, layer: Layer, incarnation: int) -> None:
        self._layer = layer
        self._incarnation = incarnation
        self._since: Time = 0
        self.command: Command | None = None
        self.arrived: Time = 0
        """When it did."""

    def take(self, command: Command, now: Time) -> Refusal | None:
        """Hold `command` from now on, or say why not."""
        if command.layer != self._layer:
            return "layer"
        if command.answers.incarnation != self._incarnation:
            return "incarnation"
        if command.answers.stamp_ns < self._since:
            return "earlier"
        if command.answers.stamp_ns > now:
            return "future"
        if not _is_sane(command):
            return "absurd"
        self.command = command
        self.arrived = now
        return None

    def begin(self, now: Time) -> None:
        """Hold nothing, and take only what is computed from what the agent says from now on."""
        self.command = None
        self._since = now

    def age_s(self, now: Time) -> float:
        """Age of what the command was computed from, s: since the odometry it answers was sent, or what the
        controller says of its oldest input if that makes it older. -1 without a command."""
        command = self.command
        if command is None:
            return -1.0
        return to_seconds(max(now - command.answers.stamp_ns, now - self.arrived + command.inputs_age_ns))

    def stamp(self) -> Stamp:
        """Points at the command that is held."""
        assert self.command is not None
        return Stamp(self.command.incarnation, self.command.seq, self.command.stamp_ns)


def _is_sane(command: Command) -> bool:
    """Whether what a command says can be meant."""
    fastest = max(map(abs, (*command.values, command.third)))
    return fastest <= _ABSURD and command.inputs_age_ns >= 0 and command.stop_after_s >= 0.0
