"""Ground truth as arrays; what errors it makes is tested with the summary."""

import math

import msgspec
import numpy as np
import pytest

from maniple.cli.loading import completed
from maniple.core.geometry import Pose
from maniple.core.messages import Truth, pack_floats
from maniple.core.scenario.types import Scenario
from maniple.report.truth import (
    control_points,
    differences,
    estimated_poses,
    ground_of,
    origin_of,
    unwrapped,
)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    table = {
        "name": "ground",
        "task": {"kind": "line", "start": [0, 0], "end": [2, 0], "speed_mps": 0.2},
        "formation": {"points": [[1, 0], [0, 1], [0, -1]]},
        "robots": [{"id": f"r{i}", "control_point_m": 0.1 * i, "pose": [i, 2, 0.5 * i]} for i in (1, 2, 3)],
    }
    return completed(msgspec.convert(table, Scenario))


def truth(robots: tuple[str, ...], *, sideways: bool) -> Truth:
    numbers = np.arange(len(robots), dtype=float)
    return Truth(
        stamp_ns=5,
        robots=robots,
        poses=pack_floats(np.outer(numbers, [1, 2, 3])),
        velocities=pack_floats(np.outer(numbers, [1, 10])),
        sideways=pack_floats(100 * numbers) if sideways else b"",
        clearances=pack_floats(numbers),
        collisions=0,
    )


@pytest.mark.parametrize("sideways", [True, False])
def test_robots_in_the_order_of_the_scenario(scenario: Scenario, sideways: bool) -> None:
    """Sideways speed is told where some robot can; of a robot that is not there nothing is known."""
    told = [truth(robots, sideways=sideways) for robots in (("r3", "r1"), ("r1", "r2", "r3"))]
    ground = ground_of(told, scenario)
    assert ground.poses[0, [0, 2]].tolist() == [[1, 2, 3], [0, 0, 0]]
    assert np.isnan(ground.poses[0, 1]).all()
    assert ground.clearances[1].tolist() == [0, 1, 2]
    assert ground.velocities[1, 2].tolist() == [2, 20, 200 * sideways]
    assert ground.velocities[0, [0, 2], 2].tolist() == [100 * sideways, 0]
    assert np.isnan(ground.velocities[0, 1]).all()


def test_control_points_and_believed_poses_as_geometry_has_them(scenario: Scenario) -> None:
    own = np.array([[0.3, -0.2, 3.0], [0.4, -0.3, -3.0]])
    origin = origin_of("r2", scenario)
    assert origin == Pose(2.0, 2.0, 1.0)
    assert origin_of("world", scenario) == Pose(0.0, 0.0, 0.0)
    for row, found in zip(own, estimated_poses(origin, own), strict=True):
        expected = origin.compose(Pose(*row))
        assert found[:2] == pytest.approx(expected[:2])
        assert math.remainder(found[2] - expected.psi, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
        point = control_points(np.tile(found, (3, 1)), scenario)[1]
        assert point == pytest.approx(expected.compose(Pose(0.2, 0.0, 0.0))[:2])
    assert np.diff(unwrapped(own)[:, 2]) == pytest.approx([2 * math.pi - 6.0])


def test_differences_of_angles_are_wrapped() -> None:
    found = differences(np.array([[0, 0, 3.0, 1, 1, -3.0]]), np.array([[0, 0, -3.0, 0, 2, 3.0]]))
    assert found[0] == pytest.approx([0, 0, 6 - 2 * math.pi, 1, -1, 2 * math.pi - 6])
