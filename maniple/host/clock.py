"""The clock of realtime: scenario time from the machine's monotonic clock."""

import time
from typing import Self

import msgspec

from maniple.core.time import SECOND, Duration, Time

SLOWEST, FASTEST = 0.01, 1000.0
"""Speeds: scenario time over wall time."""
_MOST = 2**62


class Anchor(msgspec.Struct, frozen=True):
    """now = epoch_ns + speed * (monotonic - monotonic_ns). All processes of a run share one."""

    epoch_ns: Time
    monotonic_ns: Time
    speed: float = 1.0

    @classmethod
    def here(cls, speed: float = 1.0) -> Self:
        """Starts now at the wall clock's time."""
        return cls(time.time_ns(), time.monotonic_ns(), speed)

    @classmethod
    def parse(cls, text: str) -> Self:
        """The inverse of `str`.

        Raises:
            ValueError: not three numbers with colons between, or a speed that no clock has.
        """
        epoch, monotonic, speed = text.split(":")
        if not SLOWEST <= float(speed) <= FASTEST:
            raise ValueError(f"speed {speed} is not from {SLOWEST:g} to {FASTEST:g}")
        return cls(int(epoch), int(monotonic), float(speed))

    def __str__(self) -> str:
        """EPOCH:MONOTONIC:SPEED, as the command line has it."""
        return f"{self.epoch_ns}:{self.monotonic_ns}:{self.speed!r}"

    def told(self, monotonic_ns: Time) -> str:
        """EPOCH:ELAPSED:SPEED, for another machine: the same run at this reading of the monotonic clock."""
        return f"{self.epoch_ns}:{monotonic_ns - self.monotonic_ns}:{self.speed!r}"

    @classmethod
    def learnt(cls, text: str, monotonic_ns: Time) -> Self:
        """The clock that was `told`, by this machine's monotonic clock at that moment.

        Raises:
            ValueError: nothing that a clock tells.
        """
        told = cls.parse(text)
        if max(abs(told.epoch_ns), abs(told.monotonic_ns)) >= _MOST:
            raise ValueError(f"{text}: no time is that far away")
        return cls(told.epoch_ns, monotonic_ns - told.monotonic_ns, told.speed)

    def at(self, monotonic_ns: Time) -> Time:
        """Scenario time at a reading of the monotonic clock."""
        return self.epoch_ns + round(self.speed * (monotonic_ns - self.monotonic_ns))

    def now(self) -> Time:
        """Scenario time, ns."""
        return self.at(time.monotonic_ns())

    def wall_seconds(self, duration: Duration) -> float:
        """How long a span of scenario time takes by the wall clock, s."""
        return duration / self.speed / SECOND
