"""Messages that pass every check and make little sense: nothing they say may stop a recorder."""

import numpy as np
import pytest

from maniple.core import codec
from maniple.core.messages import (
    EmergencyStop,
    FaultPlan,
    Goal,
    Message,
    Mission,
    Odometry,
    RobotReport,
    Scan,
    Seat,
    Status,
    Truth,
    pack_floats,
)
from maniple.recording.viz import Viewer
from tests.core.test_happenings import state as state_of
from tests.recording.viz.pictures import run


def floats(*shape: int, of: float = 0.0) -> bytes:
    return pack_floats(np.full(shape, of))


def state(**changes: object) -> tuple[str, Message]:
    return "formation/state", state_of(source="controller", **changes)


def odometry(x: float, y: float, psi: float, frame: str = "r1") -> tuple[str, Message]:
    said = Odometry(source="r1", frame_id=frame, x_m=x, y_m=y, psi_rad=psi, u_mps=0.0, w_radps=0.0)
    return "robot/r1/odometry", said


def scan(ranges: bytes, beams: bytes = b"", most: float = 5.0, huge: float = 0.0) -> tuple[str, Message]:
    said = Scan(
        source="r1",
        first_angle_rad=huge,
        increment_rad=huge,
        range_min_m=0.0,
        range_max_m=most,
        mount=(huge, 0.0, huge),
        ranges=ranges,
        beams=beams,
    )
    return "robot/r1/ranges", said


def truth(robots: tuple[str, ...], poses: int, clearances: int) -> tuple[str, Message]:
    said = Truth(
        source="simulator",
        robots=robots,
        poses=floats(poses, 3),
        velocities=b"",
        clearances=floats(clearances),
        collisions=0,
    )
    return "sim/truth", said


STATUS = Status(
    source="r1",
    mode="fault",
    guard="something\0new",
    command_age_s=1e300,
    command_age_max_s=-5.0,
    driver="fault",
    reason="x" * 100_000,
    counters={},
)

ODD = (
    state(chain=()),
    state(chain=("x", "y", "z"), points=floats(3, 2), errors=floats(9, 6)),
    state(chain=("r1",), points=floats(1, 2)),
    state(frame="nobody", points=floats(3, 2), errors=floats(1, 6)),
    state(roster=(RobotReport("ghost", "lost", -1.0, ""),)),
    state(errors=floats(1, 6, of=1e18), points=floats(3, 2, of=1e18), reference=(1e300, 1e300, 1e300)),
    truth(("r1", "q"), 1, 0),
    truth((), 3, 1),
    odometry(1e307, -1e307, 0.0),
    odometry(0.0, 0.0, 1e307),
    odometry(0.0, 0.0, 0.0, frame=""),
    odometry(0.0, 0.0, 0.0, frame="ü/∞"),
    scan(b""),
    scan(floats(1)),
    scan(floats(3, of=-3.0), most=1e300, huge=1e300),
    scan(floats(3), beams=floats(1, 3)),
    scan(floats(2), beams=floats(4, 3)),
    scan(floats(3, of=1e18), beams=floats(3, 3, of=1e18), most=1e30),
    ("robot/r1/status", STATUS),
    ("formation/mission", Mission(source="controller", number=1, stage="running", seats=(Seat("zz", 0),))),
    ("formation/goal", Goal(source="op", id="")),
    ("platoon/stop", EmergencyStop(source="", stopped=True, reason="\n")),
    ("faults/plan", FaultPlan(source="x", since_ns=-(10**18))),
)


@pytest.mark.parametrize("time", [0, 10**18, 2**64 - 1])
def test_odd_messages_are_drawn_or_left_out(time: int) -> None:
    viewer = Viewer(run().scenario)
    for topic, message in ODD:
        assert viewer.wants(topic)
        viewer.see(topic, codec.decode(topic, codec.encode(message)), time)
