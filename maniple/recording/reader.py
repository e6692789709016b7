"""Reads a recording, finished or not."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, NoReturn, Self, TypeVar

import msgspec
from mcap.records import Attachment, Channel

from maniple.core import codec, topics
from maniple.core.errors import ManipleError, MessageError, RecordingError
from maniple.core.messages import Message
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.recording.scan import (
    DAMAGE,
    ChunkPlace,
    Damage,
    Layout,
    NothingRecordedError,
    RawMessage,
    open_file,
    read_chunk,
    scan,
)
from maniple.recording.selection import EVERYTHING, Selection
from maniple.recording.split import GOES_ON_NAME
from maniple.recording.writer import LATCHED_NAME, METADATA_NAME, SCENARIO_NAME, Latched, part

if TYPE_CHECKING:
    from maniple.recording.table import Table

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
            MessageError: the topic is unknown, the bytes are not a valid message of it, or its type is of a
                version that this one can't read.
        """
        return codec.decode(self.topic, self.data)


class _Foreign(Recorded):
    """A message of a type or version that this version does not have on its topic."""

    __slots__ = ()

    def decode(self) -> Message:
        """Never.

        Raises:
            MessageError: always.
        """
        known = codec.encoding(self.topic)
        raise MessageError(
            f"{self.topic}: recorded with another encoding than {known}, which this version reads"
        )


class Recording:
    """An open recording, of one file or several parts. Messages are read from the files as they are asked
    for, a chunk or two at a time."""

    def __init__(self, layouts: Sequence[Layout], passed_over: Sequence[str] = (), lacking: str = "") -> None:
        first = layouts[0]
        self.path = first.path
        """Of its first part."""
        self.paths = tuple(layout.path for layout in layouts)
        """Of all parts, in order."""
        self.passed_over = tuple(passed_over)
        """What there is to say of parts without any message."""
        self.lacking = lacking
        """What there is to say of a part that ought to follow and is not there; empty where none ought to."""
        self.complete = all(layout.complete for layout in layouts)
        """False where the recorder was killed, or the file is cut: then all that is whole can be read."""
        self.metadata: Mapping[str, str] = first.metadata[METADATA_NAME]
        """How it came about: maniple (the version), scenario (its name), mode, seed, ..."""
        self.all_metadata = tuple(layout.metadata for layout in layouts)
        """All metadata records of each part, by name."""
        self.scenario_json = first.attachments[SCENARIO_NAME].data
        """The resolved scenario as it was attached."""
        self.prefix = self.metadata.get("prefix", "")
        self.damage = tuple(damage for layout in layouts for damage in layout.damage)
        """What is known to be damaged before a chunk has been read."""
        self.layouts = tuple(layouts)
        """Where things are in each part."""
        self._chunks = sorted(place for layout in layouts for place in layout.chunks)

    @cached_property
    def scenario(self) -> Scenario:
        """The resolved scenario.

        Raises:
            RecordingError: this version can't read it.
        """
        try:
            return msgspec.json.decode(self.scenario_json, type=Scenario)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ManipleError) as error:
            made_by = self.metadata.get("maniple", "unknown")
            raise RecordingError(
                f"{self.path}: its scenario can't be read ({error}); it was made by version {made_by}"
            ) from None

    @cached_property
    def topics(self) -> tuple[str, ...]:
        """The topics that it has channels for, sorted; what is derived for viewers is not among them."""
        keys = {channel.topic for layout in self.layouts for channel in layout.channels.values()}
        return tuple(sorted(name for name in map(self.topic_of, keys) if name))

    @property
    def attachments(self) -> tuple[Attachment, ...]:
        """What is attached to its first part, but for what is latched."""
        files = self.layouts[0].attachments
        return tuple(file for name, file in files.items() if not name.startswith(LATCHED_NAME))

    @cached_property
    def latched(self) -> tuple[Latched, ...]:
        """The last message of each latched topic from before it begins, as far as the recorder knew."""
        return tuple(
            Latched(name.removeprefix(LATCHED_NAME), file.data, file.log_time, file.create_time)
            for name, file in self.layouts[0].attachments.items()
            if name.startswith(LATCHED_NAME)
        )

    @cached_property
    def viewer_keys(self) -> tuple[str, ...]:
        """The keys of the channels that are only there for viewers, sorted."""
        keys = {channel.topic for layout in self.layouts for channel in layout.channels.values()}
        return tuple(sorted(key for key in keys if not self.topic_of(key)))

    @cached_property
    def start_ns(self) -> Time:
        """Log time of the first message; 0 without any.

        Raises:
            RecordingError: it is damaged.
        """
        return next((entry.log_time_ns for entry in self.messages()), 0)

    @cached_property
    def end_ns(self) -> Time:
        """Log time of the last message, or of what was derived for viewers after it; 0 without any."""
        return max((place.end_ns for place in self._chunks), default=0)

    def messages(
        self,
        wanted: Callable[[str], bool] | None = None,
        start_ns: Time | None = None,
        end_ns: Time | None = None,
        skipped: Callable[[Damage], None] | None = None,
    ) -> Iterator[Recorded]:
        """All messages in the order of (log time, part, place in the file); only those of `wanted` topics
        and of log times from `start_ns` on and before `end_ns`. What was derived for viewers is left out.

        `skipped` is told what can't be read; without it that is an error.

        Raises:
            RecordingError: it is damaged.
        """

        def choose(channel: Channel) -> tuple[str, type[Recorded]] | None:
            name = self.topic_of(channel.topic)
            if not name or not (wanted is None or wanted(name)):
                return None
            return name, _Foreign if is_foreign(name, channel) else Recorded

        tell = skipped or self._refuse
        chosen = [_Chosen(layout, choose, tell) for layout in self.layouts]
        for raw in self._in_order(chosen, start_ns, end_ns, tell):
            log_time, part_index, _, _, channel, sequence, publish_time, data = raw
            name, kind = chosen[part_index][channel]
            yield kind(name, data, log_time, publish_time, sequence)

    def selected(self, selection: Selection) -> Iterator[Recorded]:
        """What a selection takes, in the same order.

        Raises:
            RecordingError: it is damaged.
        """
        return self.messages(selection.takes, selection.start_ns, selection.end_ns)

    def raw(
        self, wanted: Callable[[str], bool], selection: Selection = EVERYTHING
    ) -> Iterator[tuple[Layout, RawMessage, str]]:
        """Messages as they are in the files, each with its part and topic, in the same order: those of
        `wanted` keys, in the time of a selection. The topic is empty for what was derived for viewers.

        Raises:
            RecordingError: it is damaged.
        """

        def choose(channel: Channel) -> tuple[str] | None:
            return (self.topic_of(channel.topic),) if wanted(channel.topic) else None

        chosen = [_Chosen(layout, choose, self._refuse) for layout in self.layouts]
        for raw in self._in_order(chosen, selection.start_ns, selection.end_ns, self._refuse):
            yield self.layouts[raw.part], raw, chosen[raw.part][raw.channel][0]

    def decoded(self, kind: type[M]) -> Iterator[tuple[Recorded, M]]:
        """The valid messages of one type, whatever the topic, each with its record, in the same order.

        Raises:
            RecordingError: it is damaged.
        """
        for record in self.messages(lambda name: _type_of(name) is kind):
            message = record.message
            if isinstance(message, kind):
                yield record, message

    def table(
        self, wanted: str | type[Message], each: str = "", selection: Selection | None = None
    ) -> "Table":
        """The messages of the `wanted` topics ("robot/*/odometry"), or of one type, as columns: NumPy arrays,
        pandas, Arrow. A row is a message, or with `each` one of what it has several of; see `table.table`.

        Raises:
            ArgumentError: nothing like `wanted` is there, it means topics of several types, or they have no
                such elements.
            RecordingError: it is damaged.
        """
        from maniple.recording.table import table

        return table(self, wanted, each, selection)

    def topic_of(self, key: str) -> str:
        """The topic of a key on the network; empty for one that is only there for viewers."""
        return topic_under(self.prefix, key)

    def _refuse(self, damage: Damage) -> NoReturn:
        raise RecordingError(f"{damage}; `maniple log recover {damage.path}` saves the rest")

    def _in_order(
        self,
        wanted: Sequence[Mapping[int, object]],
        start_ns: Time | None,
        end_ns: Time | None,
        skipped: Callable[[Damage], None],
    ) -> Iterator[RawMessage]:
        """Merges chunks whose times overlap: a message is out as soon as no later chunk can precede it."""
        for damage in self.damage:
            skipped(damage)
        first, end = start_ns or 0, 1 << 64 if end_ns is None else end_ns
        chunks = [place for place in self._chunks if place.start_ns < end and place.end_ns >= first]
        held: list[RawMessage] = []
        with _Files(self.paths) as files:
            for following, place in enumerate(chunks, 1):
                try:
                    channels = self.layouts[place.part].channels
                    held += read_chunk(files.file(place.part), place, channels, wanted[place.part])
                except DAMAGE as error:
                    skipped(damage_of(self.paths[place.part], place, error))
                held.sort()
                ready = len(held)
                if following < len(chunks):
                    ready = bisect_left(held, chunks[following].start_ns, key=_LOG_TIME)
                low = bisect_left(held, first, 0, ready, key=_LOG_TIME)
                yield from held[low : bisect_left(held, end, low, ready, key=_LOG_TIME)]
                del held[:ready]


class _Files:
    """The files of a recording, one of them open at a time."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self._part = -1
        self._open: BinaryIO | None = None

    def file(self, part: int) -> BinaryIO:
        """The file of a part.

        Raises:
            RecordingError: it can't be opened any more.
        """
        if self._open is None or part != self._part:
            self.__exit__()
            self._part, self._open = part, open_file(self._paths[part])
        return self._open

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            self._open.close()


class _Chosen(dict[int, Any]):
    """By channel of a part, what `choose` makes of it; None for those that are not chosen."""

    def __init__(
        self, layout: Layout, choose: Callable[[Channel], object], skipped: Callable[[Damage], None]
    ) -> None:
        super().__init__()
        self._layout, self._choose, self._skipped = layout, choose, skipped

    def __missing__(self, id: int) -> object:
        """What that is.

        Raises:
            RecordingError: there is no such channel, and what can't be read is an error.
        """
        channel = self._layout.channels.get(id)
        if channel is None:
            what = f"messages are of channel {id}, which is not in the file"
            self._skipped(Damage(self._layout.path, 0, 0, what))
        self[id] = found = None if channel is None else self._choose(channel)
        return found


def read(path: str | Path) -> Recording:
    """Open a recording: one file, or several parts. With LOG.mcap come LOG-2.mcap, LOG-3.mcap ... as far as
    they are there and of the same run; with LOG-2.mcap, those after it. A recorder steps over a file of
    another recording, and so does this.

    Raises:
        RecordingError: it can't be opened, is not a recording made by maniple, or ends too early.
    """
    path = Path(path)
    first, number = _numbered(path)
    layouts: list[Layout] = []
    last = 0
    passed_over: list[NothingRecordedError] = []
    while not layouts or path.exists():
        try:
            layout = _opened(path, len(layouts))
            if not layouts and number > 1 and layout.metadata[METADATA_NAME].get("part") != str(number):
                first, number = path, 1
            if not layouts or _continues(layouts[0], layout, number):
                layouts.append(layout)
            last = number
        except NothingRecordedError as error:
            passed_over.append(error)
        number += 1
        path = part(first, number)
        if not layouts and not path.exists():
            raise passed_over[0]
    goes_on, lacking = layouts[-1].metadata.get(GOES_ON_NAME), ""
    if goes_on is not None and number == last + 1:
        following = goes_on.get("file", "")
        lacking = f"{layouts[-1].path} goes on in {following}, which is not there"
    return Recording(layouts, [str(error) for error in passed_over], lacking)


def _opened(path: Path, index: int) -> Layout:
    layout = scan(path, index)
    if METADATA_NAME in layout.metadata and SCENARIO_NAME in layout.attachments:
        return layout
    if layout.damage:
        raise RecordingError(
            f"{layout.damage[0]}; its scenario is lost: "
            f"`maniple log recover {path} --scenario FILE` saves the rest"
        )
    if layout.complete or layout.chunks:
        raise RecordingError(f"{path} is an MCAP file, but not one that maniple made (it holds no scenario)")
    raise NothingRecordedError(f"{path} ends before its first message; there is nothing to read")


def _numbered(path: Path) -> tuple[Path, int]:
    """The first part of a recording, and the number of the part that a path names."""
    stem, dash, number = path.stem.rpartition("-")
    if dash and number.isascii() and number.isdecimal() and not number.startswith("0") and int(number) > 1:
        first = path.with_name(f"{stem}{path.suffix}")
        if stem and first.exists():
            return first, int(number)
    return path, 1


def _continues(first: Layout, later: Layout, number: int) -> bool:
    """Whether a file is the part of this number of the same run."""
    if first.attachments[SCENARIO_NAME].data != later.attachments[SCENARIO_NAME].data:
        return False
    was, now = first.metadata[METADATA_NAME], later.metadata[METADATA_NAME]
    return was.get("anchor") == now.get("anchor") and now.get("part") == str(number)


def topic_under(prefix: str, key: str) -> str:
    """The topic of a key on a network with this prefix; empty for another network's."""
    return key.removeprefix(f"{prefix}/") if key.startswith(f"{prefix}/") else ""


def damage_of(path: Path, place: ChunkPlace, error: Exception) -> Damage:
    """What there is to say of a chunk that can't be read."""
    what = f"the chunk at byte {place.offset} is damaged: {error}"
    return Damage(path, place.offset, place.length, what)


def is_foreign(name: str, channel: Channel) -> bool:
    """Whether a channel says that its messages are of a type or version that this version does not have."""
    said = channel.metadata.get("encoding")
    return said is not None and _type_of(name) is not None and said != codec.encoding(name)


def _type_of(name: str) -> type[Message] | None:
    try:
        return topics.topic(name).type
    except MessageError:
        return None
