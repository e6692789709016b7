"""How old what a robot says is, by the controller's own clock: no clocks of two machines are compared."""

from maniple.core.messages import Odometry
from maniple.core.time import Duration, Time

DRIFT_PPM = 1000
"""Two clocks drift apart by at most this, or are seen to by round trips."""


class RobotClock:
    """Where the stamps of one life of a robot's agent lie on the controller's clock.

    Arrival minus stamp is by how much the clocks differ plus what the message took. The least of it so far,
    which may rise by `DRIFT_PPM`, belongs to a message that took the least; that is taken for half of the
    least round trip, as both ways are alike as far as anybody can tell. A round trip is from the controller's
    own stamp that comes back in `Odometry.applied` to now, without the time that the robot held it. The
    odometry took no longer than the round trip that it ends, however fast the clocks drift apart.

    `incarnation` is the life of the controller: what comes back of an earlier one says nothing.
    """

    def __init__(self, incarnation: int) -> None:
        self._incarnation = incarnation
        self._base: Duration | None = None
        self._heard_at: Time = 0
        self._least: Duration | None = None
        self.round_trip: Duration | None = None
        """The last that was measured."""

    def heard(self, odometry: Odometry, now: Time) -> None:
        """An odometry arrived."""
        took = now - odometry.stamp_ns
        if self._base is None:
            self._base = took
        else:
            self._base = min(self._base + (now - self._heard_at) * DRIFT_PPM // 1_000_000, took)
        self._heard_at = now
        applied = odometry.applied
        if applied is None or applied.incarnation != self._incarnation:
            return
        both_ways = now - applied.stamp_ns - max(odometry.held_ns, 0)
        if both_ways < 0:
            return
        self.round_trip = both_ways
        self._least = both_ways if self._least is None else min(self._least, both_ways)
        self._base = max(self._base, took + self._least // 2 - both_ways)

    def age(self, stamp_ns: Time, now: Time) -> Duration:
        """How long ago, at `now`, the robot's clock showed `stamp_ns`; after the first `heard` only."""
        assert self._base is not None, "nothing was heard yet"
        return max(now - stamp_ns - self._base + (self._least or 0) // 2, 0)
