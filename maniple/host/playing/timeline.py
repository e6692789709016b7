"""When each message of a recording is due, by a monotonic clock that is told. Pure."""

from maniple.core.time import MILLISECOND, Duration, Time
from maniple.host.clock import FASTEST, SLOWEST, Anchor

SLACK: Duration = 100 * MILLISECOND
"""A play that is later than this goes on from where it is, so that everything is slowed alike; what is less
is made up for. Wall time."""


class Timeline:
    """Where in the recording a play is. `rate` is time of the recording over wall time; None: as fast as
    possible. `now` is always a reading of the same monotonic clock."""

    def __init__(self, rate: float | None = 1.0, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self.latest: Duration = 0
        """How late the latest message was, wall time."""
        self.slowed: Duration = 0
        """By how much the whole was slowed, wall time."""
        self.stood: Duration = 0
        """How long it was paused, wall time, up to the last `resume` or `begin`."""
        self._position: Time = 0
        self._since: Time = 0
        self._paused_at: Time | None = None
        self._steps = 0

    def begin(self, position: Time, now: Time) -> None:
        """Be at a time of the recording now, from the start or anew."""
        self._position, self._since = position, now
        if self.paused and self._paused_at is None:
            self._paused_at = now

    def position(self, now: Time) -> Time:
        """The time of the recording."""
        if self.paused or self.rate is None:
            return self._position
        return self._position + round(self.rate * (now - self._since))

    def clock(self, now: Time) -> Anchor:
        """The time of the recording as a clock that others go by. One that stands still there is not."""
        speed = 1.0 if self.rate is None else min(max(self.rate, SLOWEST), FASTEST)
        return Anchor(self.position(now), now, speed)

    def wait(self, log_time: Time, now: Time) -> Duration | None:
        """How long until a message of this log time is due; None: for as long as the pause lasts."""
        if self.paused:
            return 0 if self._steps else None
        return max(self._due(log_time, now) - now, 0)

    def put(self, log_time: Time, now: Time) -> None:
        """A message of this log time has been put."""
        if self.paused or self.rate is None:
            self._steps = max(self._steps - 1, 0)
            self._position, self._since = log_time, now
            return
        late = now - self._due(log_time, now)
        self.latest = max(self.latest, late)
        if late > SLACK:
            self.slowed += late
            self._position, self._since = log_time, now

    def pause(self, now: Time) -> None:
        """Stand still."""
        if not self.paused:
            self._position, self._since = self.position(now), now
            self.paused, self._paused_at = True, now

    def resume(self, now: Time) -> None:
        """Go on from where it is."""
        if self.paused:
            self.stood = self.stood_until(now)
            self.paused, self._paused_at, self._steps = False, None, 0
            self._since = now

    def step(self, count: int, now: Time) -> None:
        """Put so many more messages, at once; a play that was not paused is now."""
        self.pause(now)
        self._steps += count

    def stood_until(self, now: Time) -> Duration:
        """How long it was paused up to now, wall time."""
        return self.stood + (0 if self._paused_at is None else now - self._paused_at)

    def _due(self, log_time: Time, now: Time) -> Time:
        if self.rate is None:
            return now
        return self._since + round((log_time - self._position) / self.rate)
