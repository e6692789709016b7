"""Time is an int of nanoseconds. Nothing here reads a clock."""

from typing import TypeAlias

Time: TypeAlias = int
"""A moment on one clock, in ns."""

Duration: TypeAlias = int
"""A span of time, in ns."""

MILLISECOND: Duration = 1_000_000
SECOND: Duration = 1_000_000_000

VIRTUAL_EPOCH: Time = 1_000_000_000 * SECOND
"""Where virtual time starts (2001-09-09T01:46:40Z): fixed, so that recordings are reproducible."""


def from_seconds(seconds: float) -> Duration:
    """Seconds to the nearest ns."""
    return round(seconds * SECOND)


def to_seconds(duration: Duration) -> float:
    """Nanoseconds to seconds."""
    return duration / SECOND


def period(rate_hz: float) -> Duration:
    """Period of a rate in Hz, to the nearest ns."""
    return round(SECOND / rate_hz)
