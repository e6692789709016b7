"""The journal of a node: what it was called with, in order, so that it can be run again."""

from maniple.core.envelope import Envelope
from maniple.core.messages import Call
from maniple.core.time import Time


class JournalBuffer:
    """Collects the calls into one node until they are sent."""

    def __init__(self) -> None:
        self._calls: list[Call] = []

    def started(self, now: Time, scenario: str) -> None:
        """`on_start` is about to be called, under the scenario with this digest."""
        self._calls.append(Call("start", now, scenario))

    def received(self, envelope: Envelope, now: Time) -> None:
        """`on_message` is about to be called with what the envelope holds."""
        self._calls.append(
            Call(
                "message",
                now,
                envelope.topic,
                envelope.source,
                envelope.incarnation,
                envelope.seq,
                envelope.crc32,
                envelope.data if envelope.altered else None,
            )
        )

    def timer(self, name: str, now: Time) -> None:
        """`on_timer` is about to be called."""
        self._calls.append(Call("timer", now, name))

    def stopped(self, now: Time) -> None:
        """`on_stop` is about to be called."""
        self._calls.append(Call("stop", now))

    def take(self) -> tuple[Call, ...]:
        """The calls since the last take."""
        calls = tuple(self._calls)
        self._calls.clear()
        return calls
