"""Which part of a recording is meant: a span of time, and topics."""

import re
from functools import lru_cache

import msgspec

from maniple.core.errors import ArgumentError
from maniple.core.time import Time


class Selection(msgspec.Struct, frozen=True):
    """What is taken of a recording. Patterns are topic names without the prefix of the network, in which `*`
    stands for one level, or part of one, and `**` for any number of levels, none among them.

    Raises:
        ArgumentError: a pattern that can't match any topic, or a span that ends before it begins.
    """

    start_ns: Time | None = None
    """By log time; from the beginning without it."""
    end_ns: Time | None = None
    """The first log time that is not taken any more; up to the end without it."""
    topics: tuple[str, ...] = ()
    """Patterns of what is taken; all without any."""
    without: tuple[str, ...] = ()
    """Patterns of what is left out of that."""

    def __post_init__(self) -> None:
        for pattern in (*self.topics, *self.without):
            _compiled(pattern)
        if self.start_ns is not None and self.end_ns is not None and self.end_ns <= self.start_ns:
            raise ArgumentError("the span of time is empty: it must end after it begins")

    def takes(self, topic: str) -> bool:
        """Whether a topic is taken."""
        if self.topics and not any(matches(pattern, topic) for pattern in self.topics):
            return False
        return not any(matches(pattern, topic) for pattern in self.without)

    def holds(self, log_time_ns: Time) -> bool:
        """Whether a moment is in the span of time."""
        if self.start_ns is not None and log_time_ns < self.start_ns:
            return False
        return self.end_ns is None or log_time_ns < self.end_ns


EVERYTHING = Selection()


def matches(pattern: str, topic: str) -> bool:
    """Whether a topic is one of those that a pattern stands for.

    Raises:
        ArgumentError: the pattern can't match any topic.
    """
    return _compiled(pattern).fullmatch(f"{topic}/") is not None


@lru_cache(256)
def _compiled(pattern: str) -> re.Pattern[str]:
    levels = pattern.split("/")
    if any(not level or ("**" in level and level != "**") for level in levels):
        raise ArgumentError(
            f"topic pattern {pattern!r}: levels are separated by single slashes, and ** stands alone; "
            "robot/*/odometry and hw/** are valid"
        )
    return re.compile(
        "".join(
            "(?:[^/]+/)*" if level == "**" else re.escape(level).replace(r"\*", "[^/]*") + "/"
            for level in levels
        )
    )
