"""A maker of resolved scenarios."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest

from maniple.core.scenario.types import (
    Formation,
    Line,
    Obstacle,
    RangeFinder,
    Robot,
    Scenario,
    World,
)
from tests.pioneer import PIONEER

LASER = RangeFinder(
    beams=181,
    first_angle_rad=-math.pi / 2,
    increment_rad=math.pi / 180,
    range_max_m=8.0,
    sigma_m=0.005,
    resolution_m=0.001,
)

MakeScenario = Callable[..., Scenario]


@pytest.fixture(scope="session")
def make_scenario() -> MakeScenario:
    def make(
        poses: Sequence[tuple[float, float, float]], obstacles: Sequence[Obstacle] = (), **changes: Any
    ) -> Scenario:
        scenario = Scenario(
            name="test",
            robots=tuple(
                Robot(id=f"r{i + 1}", model="pioneer", sensor="laser", pose=pose)
                for i, pose in enumerate(poses)
            ),
            formation=Formation(points=tuple((x, y) for x, y, _ in poses)),
            task=Line(start=(0.0, 0.0), end=(5.0, 0.0), speed_mps=0.1),
            world=World(obstacles=tuple(obstacles)),
            models={"pioneer": PIONEER},
            sensors={"laser": LASER},
        )
        return msgspec.structs.replace(scenario, **changes)

    return make
