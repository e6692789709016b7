"""Stamps of nodes whose clocks are off, set right: reports compare what several nodes said when."""

from msgspec.structs import replace

from maniple.core.clocks import node_clock
from maniple.core.envelope import Header
from maniple.core.messages import Decisions, Journal, Message
from maniple.core.scenario.types import Scenario
from maniple.core.time import VIRTUAL_EPOCH, Time
from maniple.recording.reader import Recording


class TrueTime:
    """The clocks of a scenario that are off since `epoch`, the start of the run in true scenario time."""

    def __init__(self, scenario: Scenario, epoch: Time = VIRTUAL_EPOCH) -> None:
        self._clocks = {error.node: node_clock(scenario, error.node, epoch) for error in scenario.clocks}

    def of(self, message: Message) -> Message:
        """The message, stamped by a clock that is right. Journals and decisions are only ever compared with
        others of the same node, and stay as they are."""
        clock = self._clocks.get(message.source)
        if clock is None or isinstance(message, Journal | Decisions):
            return message
        return replace(message, stamp_ns=clock.true(message.stamp_ns))

    def header(self, header: Header) -> Header:
        """The same for what identifies a message."""
        clock = self._clocks.get(header.source)
        return header if clock is None else replace(header, stamp_ns=clock.true(header.stamp_ns))


def epoch_of(recording: Recording) -> Time:
    """About when the run of a recording started, in true scenario time: when its first message arrived."""
    if recording.metadata.get("mode") == "virtual":
        return VIRTUAL_EPOCH
    return next((entry.log_time_ns for entry in recording.messages()), VIRTUAL_EPOCH)
