"""How a run is recorded: the options of `maniple recorder`, which `maniple run` passes on."""

import re
from collections.abc import Sequence
from typing import cast, get_args

import msgspec

from maniple.core.errors import ArgumentError
from maniple.core.scenario.types import Scenario
from maniple.core.time import from_seconds
from maniple.host.recorder_space import LEAST_FREE, megabytes
from maniple.recording.selection import Selection, matches
from maniple.recording.split import LEAST_BYTES, LEAST_DURATION, Splits
from maniple.recording.writer import Compression

_SIZE = re.compile(r"(\d+(?:\.\d+)?) ?([kMGT]?)(i?)B?")
_POWERS = {"": 0, "k": 1, "M": 2, "G": 3, "T": 4}
_NAMED = 3
"""Topics that a notice names."""


class RecordingOptions(msgspec.Struct, frozen=True):
    """How a run is recorded.

    Raises:
        ArgumentError: a value that is not valid.
    """

    split_bytes: int | None = None
    """A part is over once it has so many; the next is LOG-2.mcap, then LOG-3.mcap, ..."""
    split_s: float | None = None
    """A part is over after so much time of the run."""
    compression: Compression = "zstd"
    topics: tuple[str, ...] = ()
    """Patterns of the topics that are recorded; all without any."""
    without: tuple[str, ...] = ()
    """Patterns of topics that are not."""
    min_free_bytes: int = LEAST_FREE
    """The recording ends before less is free on the disk."""
    viz: bool | None = None
    """Whether there are channels for viewers, too: by default in realtime, not in virtual time."""

    def __post_init__(self) -> None:
        if self.split_bytes is not None and self.split_bytes < LEAST_BYTES:
            raise ArgumentError(f"split size: must be at least {megabytes(LEAST_BYTES)}")
        if self.split_s is not None and not LEAST_DURATION <= self.split_s * 1e9 < 1e18:
            raise ArgumentError(f"split time = {self.split_s:g} s: must be from 1 to 1e9")
        if self.compression not in get_args(Compression):
            raise ArgumentError(
                f"compression {self.compression!r}: must be {' or '.join(get_args(Compression))}"
            )
        if self.min_free_bytes < 0:
            raise ArgumentError("min free: must not be negative")
        for pattern in (*self.topics, *self.without):
            matches(pattern, "")
        if "**" in self.without:
            raise ArgumentError("without **: nothing would be recorded")

    @property
    def splits(self) -> Splits:
        """Where a part ends."""
        return Splits(self.split_bytes, None if self.split_s is None else from_seconds(self.split_s))

    @property
    def selection(self) -> Selection:
        """Which topics are recorded."""
        return Selection(topics=self.topics, without=self.without)

    @property
    def metadata(self) -> dict[str, str]:
        """What the recording says of what was left out on purpose."""
        chosen = {"topics": " ".join(self.topics), "without": " ".join(self.without)}
        return {name: value for name, value in chosen.items() if value}

    def arguments(self) -> tuple[str, ...]:
        """The same, as `maniple recorder` takes it."""
        found: list[str] = []
        if self.split_bytes is not None:
            found += ["--split-size", str(self.split_bytes)]
        if self.split_s is not None:
            found += ["--split-time", repr(self.split_s)]
        if self.compression != "zstd":
            found += ["--compression", self.compression]
        for name, patterns in (("--topic", self.topics), ("--without", self.without)):
            found += [f"{name}={pattern}" for pattern in patterns]
        if self.min_free_bytes != LEAST_FREE:
            found += ["--min-free", str(self.min_free_bytes)]
        if self.viz is False:
            found.append("--no-viz")
        return tuple(found)


EVERYTHING = RecordingOptions()


def options_of(
    split_size: str | None,
    split_time: float | None,
    compression: str,
    topic: Sequence[str],
    without: Sequence[str],
    min_free: str | None,
    viz: bool | None,
) -> RecordingOptions:
    """The same from the options of a command line.

    Raises:
        ArgumentError: a value that is not valid.
    """
    if compression not in get_args(Compression):
        raise ArgumentError(f"--compression {compression}: must be {' or '.join(get_args(Compression))}")
    return RecordingOptions(
        split_bytes=None if split_size is None else _size_of("--split-size", split_size),
        split_s=split_time,
        compression=cast(Compression, compression),
        topics=tuple(topic),
        without=tuple(without),
        min_free_bytes=LEAST_FREE if min_free is None else _size_of("--min-free", min_free),
        viz=viz,
    )


def _size_of(option: str, text: str) -> int:
    try:
        return size_of(text)
    except ArgumentError as error:
        raise ArgumentError(f"{option}: {error}") from None


def size_of(text: str) -> int:
    """A number of bytes from "500MB", "2 GiB", "100000".

    Raises:
        ArgumentError: it is none.
    """
    found = _SIZE.fullmatch(text.strip())
    if found is None or (found[3] and not found[2]):
        raise ArgumentError(f"{text!r} is no size; 500MB, 2GiB and 100000 (bytes) are valid")
    unit: int = (1024 if found[3] else 1000) ** _POWERS[found[2]]
    return round(float(found[1]) * unit)


def notices(options: RecordingOptions, scenario: Scenario) -> list[str]:
    """What is to be said of a choice of topics before it is too late."""
    from maniple.host.recorder import keys_of

    robots = {robot.id for robot in scenario.robots}
    keys = [
        key
        for key in sorted(keys_of(scenario))
        if not key.startswith(("hw/", "robot/")) or key.split("/")[1] in robots
    ]
    selection = options.selection
    found = [
        f"{name} {pattern} matches no topic of the scenario's nodes: it is for others only"
        for name, patterns in (("--topic", options.topics), ("--without", options.without))
        for pattern in patterns
        if not any(matches(pattern, key) for key in keys)
    ]
    left_out = [key for key in keys if not selection.takes(key)]
    if left_out:
        more = f" and {len(left_out) - _NAMED} more" if len(left_out) > _NAMED else ""
        found.append(
            f"not recorded, as asked: {', '.join(left_out[:_NAMED])}{more}; maniple log verify can't prove "
            "nodes that say or hear what is not there"
        )
    return found
