"""Room on the disk: the recorder ends its file in order before there is none."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeAlias

from maniple.core.errors import RecordingError

LEAST_FREE = 200_000_000
"""Bytes that are left free, unless said otherwise."""
LOW = 3
"""From so many times that on there is a warning."""
_EVERY_S = 1.0

Room: TypeAlias = Literal["ample", "low", "none"]


def free_bytes(folder: Path) -> int:
    """What an ordinary user may still write there.

    Raises:
        OSError: it can't be told.
    """
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


class Space:
    """Watches the free space of a folder, of which `least` bytes are to be left."""

    def __init__(self, folder: Path, least: int, free: Callable[[Path], int] = free_bytes) -> None:
        self._folder = folder
        self._least = least
        self._free = free
        self._due = 0.0
        self._told = False

    def require(self) -> None:
        """See that there is room to begin with.

        Raises:
            RecordingError: there is not.
        """
        if (left := self._left()) is not None and left < self._least:
            raise RecordingError(f"{self._text(left)}, less than is to be left (--min-free): make room there")

    def look(self, now_s: float) -> tuple[Room, str]:
        """How much room there is at a monotonic time, and what is to be said of it; not more often than once
        a second, and that it gets low is said once."""
        if now_s < self._due:
            return "ample", ""
        self._due = now_s + _EVERY_S
        left = self._left()
        if left is None or left >= LOW * self._least:
            self._told = False
            return "ample", ""
        if left < self._least:
            return "none", f"{self._text(left)}, less than is to be left (--min-free)"
        if self._told:
            return "low", ""
        self._told = True
        return "low", f"{self._text(left)}; at {megabytes(self._least)} the recording ends"

    def _left(self) -> int | None:
        try:
            return self._free(self._folder)
        except OSError:
            return None

    def _text(self, left: int) -> str:
        return f"only {megabytes(left)} are free in {self._folder}"


def megabytes(count: int) -> str:
    """A number of bytes, for people."""
    return f"{count / 1e6:.0f} MB" if count >= 10e6 else f"{count / 1e6:.2g} MB"
