import math
from collections.abc import Callable
from typing import Any

import pytest

from maniple.core import topics
from maniple.core.layers import Layer
from maniple.core.messages import Command, Stamp
from maniple.core.node import Received
from maniple.core.scenario.types import (
    Avoidance,
    Formation,
    Guard,
    Line,
    RangeFinder,
    Robot,
    Scenario,
)
from tests.pioneer import PIONEER

LASER = RangeFinder(beams=181, first_angle_rad=-math.pi / 2, increment_rad=math.pi / 180, range_max_m=8.0)


@pytest.fixture
def make_scenario() -> Callable[..., Scenario]:
    """A resolved scenario of one robot, r1, that stands at the origin, without avoidance; fields override."""

    def make(**fields: Any) -> Scenario:
        defaults: dict[str, Any] = {
            "name": "test",
            "robots": (Robot(id="r1", control_point_m=0.3, pose=(0.0, 0.0, 0.0)),),
            "formation": Formation(points=((0.0, 0.0),)),
            "task": Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
            "avoidance": Avoidance(enabled=False),
            "guard": Guard(clearance=False, hold_after_s=0.5, stop_after_s=1.0),
            "models": {"pioneer-3dx": PIONEER},
            "sensors": {"sick-lms200": LASER},
        }
        return Scenario(**{**defaults, **fields})

    return make


@pytest.fixture
def command_from() -> Callable[..., Received]:
    """A command to r1 as it arrives, computed from the odometry that r1 sent at `answered`."""

    def command(
        answered: int,
        values: tuple[float, float],
        layer: Layer = "kinematics",
        seq: int = 0,
        inputs_age: int = 0,
        incarnation: int = 1,
    ) -> Received:
        message = Command(
            source="controller",
            incarnation=1,
            seq=seq,
            stamp_ns=answered,
            layer=layer,
            values=values,
            answers=Stamp(incarnation, seq, answered),
            inputs_age_ns=inputs_age,
        )
        return Received(topics.command("r1"), message)

    return command
