import math
from typing import Any

import numpy as np
import pytest

from maniple.core.errors import ScenarioError
from maniple.core.geometry import Pose
from maniple.core.scenario.parse import json_data, scenario_of, to_json
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.shapes import points
from maniple.core.scenario.types import Formation, RangeFinder, RobotModel, Scenario

Data = dict[str, Any]


def resolved(data: Data) -> Scenario:
    return resolve(scenario_of(data), {}, {})


def control_points(scenario: Scenario) -> list[tuple[float, float]]:
    result = []
    for robot in scenario.robots:
        assert robot.pose is not None
        x, y, _ = Pose(*robot.pose).compose(Pose(robot.control_point_m, 0.0, 0.0))
        result.append((x, y))
    return result


@pytest.mark.parametrize("end", [[3, 0], [0, 3], [-2, -1]])
def test_control_points_start_at_their_places(data: Data, end: list[float]) -> None:
    data["task"]["start"], data["task"]["end"] = [1, 2], [1 + end[0], 2 + end[1]]
    data["robots"][1]["control_point_m"] = 0.35
    scenario = resolved(data)
    psi = math.atan2(end[1], end[0])
    for point, place, robot in zip(
        control_points(scenario), data["formation"]["points"], scenario.robots, strict=True
    ):
        turned = np.array([1, 2]) + np.array(
            [[math.cos(psi), -math.sin(psi)], [math.sin(psi), math.cos(psi)]]
        ) @ np.array(place)
        assert point == pytest.approx(tuple(turned))
        assert robot.pose is not None
        assert robot.pose[2] == pytest.approx(psi)


def test_given_poses_stay_and_become_floats(data: Data) -> None:
    data["robots"][1]["pose"] = [4, 5, 0]
    pose = resolved(data).robots[1].pose
    assert pose == (4.0, 5.0, 0.0)
    assert all(isinstance(value, float) for value in pose or ())


def test_resolving_twice_changes_nothing(data: Data) -> None:
    data["start"] = {"scatter_m": 0.2, "scatter_rad": 0.5}
    once = resolved(data)
    assert resolve(once, {}, {}) == once
    assert scenario_of(json_data(to_json(once))) == once


def test_scatter_is_within_its_bounds_and_even_over_the_disc(data: Data) -> None:
    data["start"] = {"scatter_m": 0.5, "scatter_rad": 0.3}
    offsets, turns = [], []
    for seed in range(400):
        scenario = resolved({**data, "seed": seed})
        for point, place, robot in zip(
            control_points(scenario), data["formation"]["points"], scenario.robots, strict=True
        ):
            offsets.append((point[0] - place[0], point[1] - place[1]))
            assert robot.pose is not None
            turns.append(robot.pose[2])
    distances = np.hypot(*np.array(offsets).T)
    assert distances.max() <= 0.5 + 1e-12
    assert np.mean(distances < 0.5 * math.sqrt(0.5)) == pytest.approx(0.5, abs=0.05), (
        "half the area, half of them"
    )
    assert np.mean(offsets, axis=0) == pytest.approx((0, 0), abs=0.03)
    assert np.abs(turns).max() <= 0.3
    assert np.std(turns) == pytest.approx(0.3 / math.sqrt(3), rel=0.05)


def test_another_robot_moves_nobody(data: Data) -> None:
    data["start"] = {"scatter_m": 0.2, "scatter_rad": 0.5}
    before = {robot.id: robot.pose for robot in resolved(data).robots}
    data["robots"].append({"id": "r4", "model": "cart", "sensor": "eye"})
    data["formation"]["points"].append([-2, 0])
    after = {robot.id: robot.pose for robot in resolved(data).robots}
    assert {name: after[name] for name in before} == before


def test_a_given_pose_is_not_scattered(data: Data) -> None:
    data["start"] = {"scatter_m": 0.2, "scatter_rad": 0.5}
    data["robots"][0]["pose"] = [0, 0, 1]
    assert resolved(data).robots[0].pose == (0, 0, 1)


def test_catalogues_fill_in_what_is_referenced_and_own_entries_win(data: Data) -> None:
    own = scenario_of(data)
    cart, eye = own.models["cart"], own.sensors["eye"]
    other = RobotModel(**{**{name: getattr(cart, name) for name in cart.__struct_fields__}, "length_m": 0.9})
    models = {"cart": other, "wagon": other, "unused": other}
    sensors = {
        "eye": RangeFinder(beams=1, first_angle_rad=0.0, increment_rad=1.0, range_max_m=1.0),
        "ear": eye,
    }
    data["robots"][1]["model"] = "wagon"
    data["robots"][2]["sensor"] = "ear"
    scenario = resolve(scenario_of(data), models, sensors)
    assert scenario.models == {"cart": cart, "wagon": other}
    assert scenario.sensors == {"eye": eye, "ear": eye}
    assert scenario.model_of(scenario.robots[1]) is other
    assert scenario.sensor_of(scenario.robots[0]) == eye


@pytest.mark.parametrize("field", ["model", "sensor"])
def test_unknown_types_list_the_known_ones(data: Data, field: str) -> None:
    data["robots"][1][field] = "x"
    with pytest.raises(ScenarioError, match=rf"^robots\[1\].{field} = 'x': must be one of (cart|eye)$"):
        resolved(data)


def test_the_number_of_places_must_be_that_of_robots(data: Data) -> None:
    data["formation"]["points"].pop()
    with pytest.raises(
        ScenarioError, match=r"^formation.points: has 2 points; must be 3, one for each robot$"
    ):
        resolved(data)


def test_without_points_or_a_shape_there_are_no_places(data: Data) -> None:
    data["formation"] = {}
    with pytest.raises(ScenarioError, match=r"^formation.points: missing, and so is a shape; must be 3, one"):
        resolved(data)


def test_a_named_shape_becomes_points(data: Data) -> None:
    data["formation"] = {"shape": {"kind": "wedge", "spacing_m": 1.5}}
    scenario = resolved(data)
    assert scenario.formation == Formation(points=points("wedge", 3, 1.5))
    assert control_points(scenario) == [pytest.approx(point) for point in scenario.formation.points]


def test_robots_are_placed_where_positioning_says(data: Data) -> None:
    data["task"] = {"kind": "positioning", "target": [9, 9, 1], "start": [1, 2, 0]}
    placed = [(x + 1, y + 2) for x, y in data["formation"]["points"]]
    assert control_points(resolved(data)) == [pytest.approx(point) for point in placed]


def test_a_file_has_to_be_loaded_first(data: Data) -> None:
    data["task"] = {"kind": "csv", "file": "way.csv"}
    with pytest.raises(ScenarioError, match=r"^the way in 'way\.csv' has not been loaded"):
        resolved(data)


def test_scenarios_from_python_are_checked_first(data: Data) -> None:
    from msgspec.structs import replace

    scenario = scenario_of(data)
    broken = replace(scenario, task=replace(scenario.task, end=(math.inf, 0.0)))
    with pytest.raises(ScenarioError, match=r"^task.end\[0\] = inf: must be a finite number$"):
        resolve(broken, {}, {})
