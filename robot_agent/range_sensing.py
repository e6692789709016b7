"""What the robot senses around itself, for its own layers and its guard."""

from maniple.control.returns import Returns, moved, returns_of
from maniple.core.geometry import Pose
from maniple.core.messages import Scan
from maniple.core.time import Duration, Time, to_seconds


class RangeSensing:
    """The last scan, for as long as it says something about now.

    The mount of the sensor comes with the scan, from the driver, which knows it; it is applied here for the
    robot's own use, and by whoever else reads the scan.
    """

    def __init__(self, stale_after: Duration) -> None:
        self._stale_after = stale_after
        self._returns: Returns | None = None
        self._pose = Pose(0.0, 0.0, 0.0)
        self._at: Time = 0

    def take(self, scan: Scan, pose: Pose, now: Time) -> None:
        """A scan arrived while the robot was at `pose` (in its odometry frame)."""
        self._returns = returns_of(scan)
        self._pose = pose
        self._at = now

    def displaced(self, before: Pose, after: Pose) -> None:
        """The robot that was believed to be at `before` turns out to be at `after`: so it was elsewhere when
        it scanned, too."""
        self._pose = after.compose(before.inverse().compose(self._pose))

    def latest(self, now: Time) -> Returns | None:
        """The returns as they were scanned; None where they are too old."""
        return self._returns if now - self._at <= self._stale_after else None

    def silence(self, now: Time) -> str:
        """Why nothing is known, for people."""
        if self._returns is None:
            return "no ranges yet"
        return f"no ranges for {to_seconds(now - self._at):.1f} s"

    def around(self, pose: Pose, now: Time) -> Returns | None:
        """The returns as they are seen from `pose`, if nothing but the robot has moved since."""
        returns = self.latest(now)
        if returns is None or pose == self._pose:
            return returns
        return moved(returns, self._pose.inverse().compose(pose))
