"""What viewers draw, derived from what is recorded. Recording goes first: where there is no time to draw, or
drawing fails, nothing is lost but the picture."""

from collections.abc import Iterable, Sequence
from typing import Protocol

from maniple.core import codec
from maniple.core.errors import MessageError
from maniple.core.messages import Message
from maniple.core.time import MILLISECOND, Duration, Time
from maniple.host.fate import say
from maniple.recording.rolling import RollingWriter
from maniple.recording.split import PartsWriter, ViewerChannel

LATE: Duration = 200 * MILLISECOND
"""What has waited longer for its turn to be recorded is not drawn, wall time."""


class Picture(Protocol):
    """Something to draw, on one of the channels."""

    @property
    def key(self) -> str:
        """Of the channel."""

    @property
    def data(self) -> bytes:
        """As the channel's schema has it."""

    @property
    def time_ns(self) -> Time:
        """Log time."""


class Draws(Protocol):
    """Makes pictures of messages."""

    def wants(self, topic: str) -> bool:
        """Whether messages of a topic matter."""

    def see(self, topic: str, message: Message, log_time_ns: Time) -> Sequence[Picture]:
        """What a message gives to draw."""


class Drawing:
    """Records what a viewer makes of the messages, on these channels."""

    def __init__(
        self, viewer: Draws, channels: Iterable[ViewerChannel], writer: PartsWriter | RollingWriter
    ) -> None:
        self._viewer = viewer
        self._writer = writer
        self._wanted: dict[str, bool] = {}
        self.late = 0
        """Messages that were not drawn as recording had no time to lose,"""
        self.failed = 0
        """and those that could not be."""
        for channel in channels:
            writer.add_viewer_channel(channel)

    def draw(self, topic: str, data: bytes, log_time_ns: Time, waited: Duration) -> None:
        """Draw a message that was just recorded, and has waited for that so long.

        Raises:
            RecordingError: the file can't grow.
        """
        wanted = self._wanted.get(topic)
        if wanted is None:
            wanted = self._wanted[topic] = self._viewer.wants(topic)
        if not wanted:
            return
        if waited > LATE:
            self.late += 1
            return
        try:
            pictures = self._viewer.see(topic, codec.decode(topic, data), log_time_ns)
        except MessageError:
            return
        except Exception as error:  # noqa: BLE001 - whatever a picture does, the message is recorded
            self.failed += 1
            if self.failed == 1:
                say(
                    f"a message on {topic} can't be drawn for viewers: {error!r}; it is recorded all the same"
                )
            return
        for picture in pictures:
            self._writer.draw(picture.key, picture.data, picture.time_ns, picture.time_ns)

    def summary(self) -> str:
        """What was not drawn, in words; empty where all was."""
        parts = [
            f"{count} {why}"
            for count, why in ((self.late, "to keep up"), (self.failed, "as that failed"))
            if count
        ]
        return f"messages not drawn for viewers: {', '.join(parts)}" if parts else ""
