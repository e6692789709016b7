"""What a node is: a state machine without I/O. It is told what happens and when, and returns what to send."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from maniple.core.messages import Message
from maniple.core.time import Duration, Time


class Outgoing(NamedTuple):
    """A message to send. The host fills in `source`, `incarnation`, `seq` and `stamp_ns`."""

    topic: str
    message: Message


class Received(NamedTuple):
    """A message that arrived: decoded, finite, newer than the one before it from the same source."""

    topic: str
    message: Message


class Node(Protocol):
    """A participant of the platoon. It reads no clock, does no I/O and draws from no global randomness.

    `subscriptions` are topic names, `timers` maps a timer's name to its period in ns. `now` is the
    node's own clock in ns; it never goes back within one life of the node.
    """

    @property
    def name(self) -> str:
        """Unique in the platoon: "r1", "controller", "simulator"."""
        ...

    @property
    def subscriptions(self) -> frozenset[str]:
        """Topic names the node receives."""
        ...

    @property
    def timers(self) -> Mapping[str, Duration]:
        """Period of each timer in ns, by name. After a freeze a timer skips, it does not catch up."""
        ...

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        """Called once, before anything else."""
        ...

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        """Called for every valid message of a subscribed topic."""
        ...

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        """Called when a timer is due."""
        ...

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        """Called once, last. What it returns is still sent: the zero command among them."""
        ...
