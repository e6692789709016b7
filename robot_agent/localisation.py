"""Where a robot's odometry frame lies, over the lives of its agent."""

from maniple.core.geometry import Pose
from maniple.core.messages import Motion, Odometry
from maniple.core.time import SECOND, Duration, Time
from robot_agent import dead_reckoning

PATIENCE: Duration = SECOND
"""How long the last word of an earlier life is waited for before there was none."""

_ORIGIN = Pose(0.0, 0.0, 0.0)


class Localisation:
    """The frame begins where the robot stood when its agent first lived. A later life resumes it, from the
    last odometry of the life before and the counts of the wheels since.

    A life that died before its first odometry leaves nothing to resume. Then the counts decide: in the first
    life of a drive they begin at zero, so while they are zero the robot stands where the frame begins. Where
    they are not, or the drive lives anew, nobody knows where that is: until the last word of an earlier life
    is heard the robot goes by a frame of its own, named otherwise.
    """

    def __init__(self, name: str, incarnation: int, wheels: dead_reckoning.Wheels) -> None:
        self._name = name
        self._incarnation = incarnation
        self._wheels = wheels
        self._former: Odometry | None = None
        self._first: tuple[Motion, Time] | None = None
        self.known = incarnation <= 1
        """Whether it is known where the frame lies."""

    @property
    def frame_id(self) -> str:
        """Of the frame that the odometry is in now."""
        return self._name if self.known else f"{self._name}/{self._incarnation}"

    def heard(self, odometry: Odometry) -> None:
        """The robot's own odometry came from the network: perhaps the last word of an earlier life."""
        if odometry.incarnation < self._incarnation and odometry.frame_id == self._name:
            self._former = odometry

    def counted(self, motion: Motion, now: Time) -> None:
        """The drive reported; the first counts of this life are where its dead reckoning began."""
        if self._first is None:
            self._first = motion, now

    def resume(self, now: Time) -> Pose | None:
        """Where this life's dead reckoning began in the frame, as soon as that is known, once; else None.

        The robot went on an arc since the last word, or stayed where it was if the counts began anew. A last
        word that is ahead of this life's clock tells nothing of what the robot rolled since.
        """
        if self.known or self._first is None:
            return None
        (motion, counted_at), former = self._first, self._former
        if former is None:
            self.known = now - counted_at >= PATIENCE and motion.incarnation == 1 and not any(motion.ticks)
            return _ORIGIN if self.known else None
        if counted_at < former.stamp_ns:
            return None
        same = motion.incarnation == former.motion_incarnation and len(former.ticks) == len(motion.ticks)
        pose = Pose(former.x_m, former.y_m, former.psi_rad)
        last = dead_reckoning.Reckoning(pose, ticks=former.ticks if same else None, stamp=former.stamp_ns)
        self.known = True
        return dead_reckoning.step(self._wheels, last, motion.ticks, counted_at)[0].pose
