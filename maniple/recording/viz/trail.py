"""Where a robot has been: all of its way in no more than so many poses."""

import math

from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

from maniple.core.geometry import Pose
from maniple.core.time import Time
from maniple.recording.viz.basics import WORLD, pose, timestamp, wire

MOST = 256
"""Poses of a trail. From then on every other one is left out, and new ones are twice as far apart."""

FIRST_STEP_M = 0.05


class Trail:
    """The way of one robot. It grows by a pose for every step, so a message is its head and bytes that are
    there already (in protobuf the entries of a list may simply follow)."""

    def __init__(self) -> None:
        self._poses: list[Pose] = []
        self._entries: list[bytes] = []
        self._step_m = FIRST_STEP_M

    def add(self, at: Pose) -> bool:
        """The robot is here now; whether the trail has grown."""
        if self._poses:
            last = self._poses[-1]
            if math.hypot(at.x - last.x, at.y - last.y) < self._step_m:
                return False
        self._poses.append(at)
        self._entries.append(wire(PosesInFrame(poses=[pose(at.x, at.y, 0.0, at.psi)])))
        if len(self._poses) > MOST:
            del self._poses[1::2], self._entries[1::2]
            self._step_m *= 2
        return True

    def message(self, time: Time) -> bytes:
        """The trail as `foxglove.PosesInFrame`."""
        head = wire(PosesInFrame(timestamp=timestamp(time), frame_id=WORLD))
        return head + b"".join(self._entries)
