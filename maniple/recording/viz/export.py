"""What viewers draw of a recording, for those who write it into one file."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Generic, Protocol, TypeVar

import msgspec

from maniple.core.errors import ArgumentError, ManipleError, MessageError
from maniple.core.messages import Message
from maniple.core.time import VIRTUAL_EPOCH, Time
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection
from maniple.recording.viz.channels import Drawn
from maniple.recording.viz.viewer import Viewer

EVERYTHING = Selection()

_FIRST_BYTES = 256


class ExportedFile(msgspec.Struct, frozen=True, kw_only=True):
    """What was written."""

    recordings: tuple[str, ...]
    out: str
    format: str
    scenario: str
    messages: int
    """Messages of the recording that there was something to draw of."""
    drawn: int
    """Messages for viewers that were made of them."""
    unreadable: dict[str, int]
    """Messages that are left out because they are no valid ones of their topic, by topic."""
    complete: bool
    """Whether the recording was finished."""


T_co = TypeVar("T_co", covariant=True)
T = TypeVar("T")


class Derives(Protocol[T_co]):
    """Makes something of messages, in order of their log times."""

    def wants(self, topic: str) -> bool:
        """Whether messages of a topic matter."""

    def begin(self) -> None:
        """Tell all anew that has not changed."""

    def see(self, topic: str, message: Message, log_time_ns: Time, /) -> Iterable[T_co]:
        """What a message gives."""


class Derived(Generic[T]):
    """What is made of a selection of a recording, in order of time; counted on the way.

    It is derived from the messages, whether or not the recording holds what an earlier version derived. What
    was said before the selection begins is known in it, but told only from there on.
    """

    def __init__(self, recording: Recording, selection: Selection, maker: Derives[T]) -> None:
        self._recording = recording
        self._selection = selection
        self._maker = maker
        self._messages = 0
        self._drawn = 0
        self._unreadable: Counter[str] = Counter()

    def __iter__(self) -> Iterator[T]:
        """
        Raises:
            RecordingError: the recording is damaged.
        """
        maker, selection = self._maker, self._selection
        start = self._recording.start_ns if selection.start_ns is None else selection.start_ns
        begun = False
        for record in self._recording.messages(
            lambda topic: selection.takes(topic) and maker.wants(topic), None, selection.end_ns
        ):
            if not begun and record.log_time_ns >= start:
                begun = True
                maker.begin()
            try:
                made = [*maker.see(record.topic, record.decode(), record.log_time_ns)]
            except MessageError:
                self._unreadable[record.topic] += begun
                continue
            if begun:
                self._messages += 1
                self._drawn += len(made)
                yield from made

    def exported(self, out: Path, format: str) -> ExportedFile:
        """What has become of them."""
        recording = self._recording
        return ExportedFile(
            recordings=tuple(map(str, recording.paths)),
            out=str(out),
            format=format,
            scenario=recording.metadata.get("scenario", ""),
            messages=self._messages,
            drawn=self._drawn,
            unreadable={topic: count for topic, count in sorted(self._unreadable.items()) if count},
            complete=recording.complete,
        )


class Pictures(Derived[Drawn]):
    """What there is to draw of a selection of a recording."""

    def __init__(self, recording: Recording, selection: Selection) -> None:
        viewer = Viewer(recording.scenario, epoch_of(recording))
        self.channels = viewer.channels
        super().__init__(recording, selection, viewer)


def epoch_of(recording: Recording) -> Time | None:
    """The start of a run in which nobody says the fault plan; None where somebody does."""
    return VIRTUAL_EPOCH if recording.metadata.get("mode") == "virtual" else None


@contextmanager
def new_file(out: Path, force: bool, viewer: str, earlier: Callable[[bytes], bool]) -> Iterator[Path]:
    """A file to write that does not exist yet; it becomes `out` when all has gone well, and goes when it has
    not. `earlier` tells by the first bytes of a file whether it is an earlier export to `viewer`: nothing
    else is ever replaced.

    Raises:
        ArgumentError: `out` exists and is not to be replaced, or is no file.
        ManipleError: it can't be written.
    """
    if out.is_dir():
        raise ArgumentError(f"{out} is a folder; --out must name a file")
    try:
        if out.exists():
            with out.open("rb") as file:
                if not earlier(file.read(_FIRST_BYTES)):
                    raise ArgumentError(
                        f"{out} exists and is no earlier export to {viewer}; --out must name another file"
                    )
            if not force:
                raise ArgumentError(f"{out} holds an export; another --out, or --force to replace it")
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
            new = Path(scratch) / out.name
            yield new
            new.replace(out)
    except OSError as error:
        raise ManipleError(f"{out}: can't write the export: {error.strerror or error}") from None
