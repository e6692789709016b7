"""Reads a recording, finished or not."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from maniple.core import codec, topics
from maniple.core.errors import MessageError, RecordingError
from maniple.core.messages import Message
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.recording.scan import DAMAGE, ChunkPlace, Layout, RawMessage, open_file, read_chunk, scan
from maniple.recording.writer import METADATA_NAME, SCENARIO_NAME

M = TypeVar("M", bound=Message)

_LOG_TIME = attrgetter("log_time_ns")


class Recorded(NamedTuple):
    """One recorded message, not decoded yet."""

    topic: str
    """Without the prefix."""
    data: bytes
    """The wire bytes, verbatim."""
    log_time_ns: Time
    """When it reached the recorder."""
    publish_time_ns: Time
    """When it was sent, on the sender's clock."""
    sequence: int

    @property
    def message(self) -> Message | None:
        """The decoded message; None where the topic is unknown or the bytes are not a valid message of it."""
        try:
            return self.decode()
        except MessageError:
            return None

    def decode(self) -> Message:
        """The decoded message.

        Raises:
            MessageError: the topic is unknown, or the bytes are not a valid message of it.
        """
        return codec.decode(self.topic, self.data)


class Recording:
    """An open recording. Messages are read from the file as they are asked for, a chunk or two at a time."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self.path = path
        self.complete = layout.complete
        """False where the recorder was killed, or the file is cut: then all that is whole can be read."""
        self.metadata: Mapping[str, str] = layout.metadata[METADATA_NAME]
        """How it came about: maniple (the version), scenario (its name), mode, seed, ..."""
        self.scenario_json = layout.attachments[SCENARIO_NAME]
        """The resolved scenario as it was attached."""
        self.prefix = self.metadata.get("prefix", "")
        self._channels = layout.channels
        self._chunks = sorted(layout.chunks)

    @cached_property
    def scenario(self) -> Scenario:
        """The resolved scenario.

        Raises:
            RecordingError: this version can't read it.
        """
        try:
            return msgspec.json.decode(self.scenario_json, type=Scenario)
        except msgspec.MsgspecError as error:
            made_by = self.metadata.get("maniple", "unknown")
            raise RecordingError(
                f"{self.path}: its scenario can't be read ({error}); it was made by version {made_by}"
            ) from None

    def messages(self, wanted: Callable[[str], bool] | None = None) -> Iterator[Recorded]:
        """All messages in the order of (log time, place in the file); only those of `wanted` topics. What was
        derived for viewers is not among them.

        Raises:
            RecordingError: the file is damaged.
        """
        names: dict[int, str] = {}
        for raw in self._in_order():
            name = names.get(raw.channel)
            if name is None:
                name = names[raw.channel] = self._name(raw.channel, wanted)
            if name:
                yield Recorded(name, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)

    def decoded(self, kind: type[M]) -> Iterator[tuple[Recorded, M]]:
        """The valid messages of one type, whatever the topic, each with its record, in the same order.

        Raises:
            RecordingError: the file is damaged.
        """
        for record in self.messages(lambda name: _type_of(name) is kind):
            message = record.message
            if isinstance(message, kind):
                yield record, message

    def _name(self, channel: int, wanted: Callable[[str], bool] | None) -> str:
        """The topic of a channel; empty where it is not wanted, or one that is only there for viewers."""
        if channel not in self._channels:
            raise RecordingError(
                f"{self.path} is damaged: a message is of channel {channel}, not in the file"
            )
        key, prefix = self._channels[channel].topic, f"{self.prefix}/"
        name = key.removeprefix(prefix)
        return name if key.startswith(prefix) and (wanted is None or wanted(name)) else ""

    def _in_order(self) -> Iterator[RawMessage]:
        """Merges chunks whose times overlap: a message is out as soon as no later chunk can precede it."""
        held: list[RawMessage] = []
        with open_file(self.path) as file:
            for following, place in enumerate(self._chunks, 1):
                try:
                    held += read_chunk(file, place, self._channels)
                except DAMAGE as error:
                    raise RecordingError(f"{self.path}: {_where(place)} is damaged: {error}") from None
                held.sort()
                ready = len(held)
                if following < len(self._chunks):
                    ready = bisect_left(held, self._chunks[following].start_ns, key=_LOG_TIME)
                yield from held[:ready]
                del held[:ready]


def read(path: str | Path) -> Recording:
    """Open a recording.

    Raises:
        RecordingError: it can't be opened, is not a recording made by maniple, or ends too early.
    """
    path = Path(path)
    layout = scan(path)
    if METADATA_NAME in layout.metadata and SCENARIO_NAME in layout.attachments:
        return Recording(path, layout)
    if layout.complete or layout.chunks:
        raise RecordingError(f"{path} is an MCAP file, but not one that maniple made (it holds no scenario)")
    raise RecordingError(f"{path} ends before its first message; there is nothing to read")


def _type_of(name: str) -> type[Message] | None:
    try:
        return topics.topic(name).type
    except MessageError:
        return None


def _where(place: ChunkPlace) -> str:
    return f"the chunk at byte {place.offset}"
