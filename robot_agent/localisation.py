"""Where a robot's odometry frame lies, over the lives of its agent."""

from maniple.core.edges import WORLD
from maniple.core.geometry import Pose
from maniple.core.messages import Motion, Odometry
from maniple.core.time import SECOND, Duration, Time
from robot_agent import dead_reckoning

PATIENCE: Duration = SECOND
"""How long the last word of an earlier life is waited for before there was none."""

_ORIGIN = Pose(0.0, 0.0, 0.0)


class Localisation:
    """The frame begins where the robot stood when its agent first lived. A later life resumes it, from the
    last odometry of the life before and how far the wheels have turned, or the drive's own pose has moved,
    since.

    A life that died before its first odometry leaves nothing to resume. Then the counts decide: in the first
    life of a drive they begin at zero, so while they are zero the robot stands where the frame begins. Where
    they are not, or the drive lives anew or reports poses, nobody knows where that is: until the last word of
    an earlier life is heard the robot goes by a frame of its own, named otherwise.

    Where the drive knows where in the world it is there is nothing to resume: the frame is the world's.
    """

    def __init__(self, name: str, incarnation: int, gauge: dead_reckoning.Gauge) -> None:
        self._name = name
        self._incarnation = incarnation
        self._gauge = gauge
        self._former: Odometry | None = None
        self._first: tuple[Motion, Time] | None = None
        self.known = incarnation <= 1 or name == WORLD
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
        """The drive reported counts or a pose; the first of this life are where its dead reckoning began."""
        if self._first is None:
            self._first = motion, now

    def resume(self, now: Time) -> Pose | None:
        """Where this life's dead reckoning began in the frame, as soon as that is known, once; else None.

        The robot went on an arc since the last word, or as the drive's pose did, or stayed where it was if
        that began anew. A last word that is ahead of this life's clock tells nothing of what the robot rolled
        since.
        """
        if self.known or self._first is None:
            return None
        (motion, counted_at), former = self._first, self._former
        if former is None:
            began = motion.pose is None and motion.incarnation == 1 and not any(motion.ticks)
            self.known = began and now - counted_at >= PATIENCE
            return _ORIGIN if self.known else None
        if counted_at < former.stamp_ns:
            return None
        pose = Pose(former.x_m, former.y_m, former.psi_rad)
        last = dead_reckoning.Reckoning(pose, stamp=former.stamp_ns)
        if motion.incarnation == former.motion_incarnation:
            if motion.pose is not None and former.motion_pose is not None:
                origin = dead_reckoning.origin_of(former.motion_incarnation, former.motion_origin)
                last = last._replace(reported=Pose(*former.motion_pose), origin=origin)
            elif motion.pose is None and len(former.ticks) == len(motion.ticks):
                last = last._replace(ticks=former.ticks)
        self.known = True
        return dead_reckoning.advance(self._gauge, last, motion, counted_at)[0].pose
