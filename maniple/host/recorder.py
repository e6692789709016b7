"""The recorder process: everything that is said, as it arrives, into a recording."""

import time
from collections.abc import Sequence
from queue import Empty, SimpleQueue

from maniple.core.envelope import envelope_of
from maniple.core.errors import MessageError
from maniple.core.time import Time
from maniple.host.clock import Anchor
from maniple.recording.writer import RecordingWriter
from maniple.transport.zenoh import ZenohSession

QUIET_S = 0.3
"""After a request to stop it goes on until nothing has arrived for this long,"""
PATIENCE_S = 3.0
"""but no longer than this."""


class RecorderHost:
    """Subscribes to everything and writes it down until it is stopped."""

    def __init__(self, writer: RecordingWriter, clock: Anchor, sessions: Sequence[ZenohSession]) -> None:
        self._writer = writer
        self._clock = clock
        self._sessions = sessions
        self._inbox: SimpleQueue[tuple[str, bytes, Time] | None] = SimpleQueue()

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.put(None)

    def run(self, poll_s: float = 0.1) -> None:
        """Record until `stop`, and then what is still on its way."""
        for session in self._sessions:
            session.subscribe("**", self._arrived)
            session.settle()
        self._sessions[0].announce("recorder", 1)
        stop_by = float("inf")
        quiet_since = time.monotonic()
        while True:
            try:
                item = self._inbox.get(timeout=poll_s)
            except Empty:
                self._writer.tick(time.monotonic_ns())
            else:
                quiet_since = time.monotonic()
                if item is None:
                    stop_by = min(stop_by, quiet_since + PATIENCE_S)
                else:
                    self._write(*item)
                    self._writer.tick(time.monotonic_ns())
            now = time.monotonic()
            if now >= stop_by or (stop_by < float("inf") and now - quiet_since >= QUIET_S):
                return

    def _arrived(self, topic: str, data: bytes) -> None:
        self._inbox.put((topic, data, self._clock.now()))

    def _write(self, topic: str, data: bytes, arrival: Time) -> None:
        try:
            envelope = envelope_of(topic, data)
        except MessageError:
            self._writer.write(topic, data, arrival, arrival, 0)
        else:
            self._writer.write(topic, data, arrival, envelope.stamp_ns, envelope.seq)
