import itertools
import math

import numpy as np
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

from maniple.core.geometry import Pose
from maniple.core.time import SECOND
from maniple.recording.viz.trail import FIRST_STEP_M, MOST, Trail


def test_a_robot_that_stands_adds_nothing() -> None:
    trail = Trail()
    assert trail.add(Pose(0.0, 0.0, 0.0))
    assert not trail.add(Pose(0.01, 0.0, 1.0))
    assert trail.add(Pose(FIRST_STEP_M, 0.0, 0.0))


def test_it_reads_as_one_message() -> None:
    trail = Trail()
    for k in range(3):
        trail.add(Pose(k, 2.0 * k, 0.5 * k))
    message = PosesInFrame.FromString(trail.message(7 * SECOND + 5))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (7, 5)
    assert message.frame_id == "world"
    assert [(p.position.x, p.position.y, p.position.z) for p in message.poses] == [
        (0, 0, 0),
        (1, 2, 0),
        (2, 4, 0),
    ]
    assert [2 * math.atan2(p.orientation.z, p.orientation.w) for p in message.poses] == [0.0, 0.5, 1.0]


def test_a_long_way_is_all_there_in_few_poses() -> None:
    trail = Trail()
    for k in range(20_000):
        trail.add(Pose(0.05 * k, 0.0, 0.0))
    poses = PosesInFrame.FromString(trail.message(0)).poses
    assert MOST / 2 <= len(poses) <= MOST
    xs = [pose.position.x for pose in poses]
    assert xs[0] == 0.0
    assert xs[-1] > 0.98 * 1000
    gaps = np.diff(xs)
    assert gaps.max() < 2.1 * gaps.min()
    assert all(a < b for a, b in itertools.pairwise(xs))
