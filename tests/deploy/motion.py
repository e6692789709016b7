"""What a recording says of how the robots moved, and how old what they acted on was."""

from collections.abc import Sequence
from pathlib import Path

from maniple.cli.loading import load
from maniple.control.limits import Limits, limits_of
from maniple.core.messages import Truth, unpack_floats
from maniple.recording.reader import read
from tests.deploy.scene import ROBOTS

STANDS_MPS = 0.005


def limits(scene: Path) -> Limits:
    """Of the robots of a scene, which are all alike."""
    scenario = load(scene)
    return limits_of(scenario, scenario.robots[0])


def fastest(logs: Sequence[Path], robot: str, since_s: float, until_s: float) -> float:
    """The highest speed of a robot in a span of wall time by the ground truth, which must be there, m/s."""
    column = ROBOTS.index(robot)
    speeds = [
        abs(float(unpack_floats(truth.velocities, 2)[column, 0]))
        for log in logs
        for _, truth in read(log).decoded(Truth)
        if since_s <= truth.stamp_ns / 1e9 <= until_s
    ]
    assert speeds, "the recording has a gap there"
    return max(speeds)
