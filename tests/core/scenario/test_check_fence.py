import math
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.geometry import Pose
from maniple.core.scenario import outline
from maniple.core.scenario.check import problems
from maniple.core.scenario.check_fence import fence_problems, inside_by
from maniple.core.scenario.parse import scenario_of, with_overrides
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.types import Scenario
from maniple.core.scenario.ways import way_of
from tests.control.test_geofence import star

Data = dict[str, Any]
ROOM = "guard.fence=[[-1.5, -1.5], [5, -1.5], [5, 1.5], [-1.5, 1.5]]"
"""The robots start with their control points at (1, 0) and (0, +-0.8), and go 3 m east."""


def made(data: Data, *overrides: str) -> Scenario:
    return resolve(scenario_of(with_overrides(data, overrides)), {}, {})


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        [ROOM],
        ["guard.fence=[[-1.5, 1.5], [5, 1.5], [5, -1.5], [-1.5, -1.5]]"],
        [ROOM, "task={kind='positioning', target=[3, 0, 1]}"],
        [ROOM, "planning.method='optimal'"],
    ],
    ids=str,
)
def test_a_task_that_stays_inside_has_no_problems(data: Data, overrides: list[str]) -> None:
    assert problems(made(data, *overrides)) == []


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["guard.fence=[[0, 0], [9, 9]]"], "guard.fence: has 2 corners; must have at least 3, or none"),
        (
            ["guard.fence=[[-5, -5], [5, 5], [5, -5], [-5, 5]]"],
            "guard.fence: edges 0 and 2 meet; must be the corners of a simple polygon, in order",
        ),
        (["guard.fence=[[-5, -5], [-5, -5], [5, 5], [5, -5]]"], "guard.fence: edge 0 has no length"),
        (
            ["guard.fence=[[-5, -5], [20000, -5], [5, 5]]"],
            "guard.fence[1] = [20000.0, -5.0]: must be within 10000 m",
        ),
        (
            [ROOM, "robots.1.pose=[-1.3, 0.8, 0]"],
            "robots[1].pose = [-1.3, 0.8, 0.0]: r2 is not inside guard.fence at the start: the middle of the "
            "circle around its body is 0.2 m inside; must be at least 0.32 m inside",
        ),
        (
            [ROOM, "robots.1.pose=[-2, 0.8, 0]"],
            "r2 is not inside guard.fence at the start: the middle of the circle around its body is 0.5 m o",
        ),
        (
            [ROOM, "task.end=[4.2, 0]"],
            "task: leads r1 out of guard.fence: after 42.0 s the middle of its circle, [5.00, 0.00], is 0 m "
            "inside; must be at least 0.37 m inside",
        ),
        (
            [
                ROOM,
                "task={kind='sequence', tasks=[{kind='line', start=[0, 0], end=[3, 0], speed_mps=0.1}, "
                "{kind='positioning', target=[6, 0, 0]}]}",
            ],
            "task.tasks[1]: leads r1 out of guard.fence: after 0.0 s its place, [7.00, 0.00], is 2 m "
            "outside; must be at least 0.17 m inside",
        ),
        (
            [ROOM, "task={kind='circle', centre=[0, 3], radius_m=3, speed_mps=0.1, start_rad=-1.5708}"],
            "task: leads r3 out of guard.fence",
        ),
    ],
    ids=str,
)
def test_what_would_have_to_leave_is_named(data: Data, overrides: list[str], message: str) -> None:
    found = problems(made(data, *overrides))
    assert len(found) == 1
    assert message in found[0]


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.integers(0, 10**6), st.lists(st.tuples(st.floats(-7, 7), st.floats(-7, 7)), min_size=1, max_size=9))
def test_inside_by_is_that_of_an_independent_geometry(seed: int, points: list[tuple[float, float]]) -> None:
    corners = star(seed)
    polygon = shapely.Polygon(corners)
    scenario = fenced(corners)
    for (x, y), left in zip(points, inside_by(np.array(points), scenario), strict=True):
        point = shapely.Point(x, y)
        distance = polygon.exterior.distance(point)
        if distance > 1e-7:
            assert left == pytest.approx(distance if polygon.contains(point) else -distance)


def fenced(corners: list[tuple[float, float]], data: Data | None = None) -> Scenario:
    base = data or {
        "name": "small",
        "task": {"kind": "line", "start": [0, 0], "end": [3, 0], "speed_mps": 0.1},
        "formation": {"points": [[1, 0], [0, 0.8], [0, -0.8]]},
        "robots": [{"id": f"r{k}", "pose": [0, 0, 0]} for k in (1, 2, 3)],
    }
    return scenario_of({**base, "guard": {"fence": [list(corner) for corner in corners]}})


@pytest.mark.parametrize("end", [3.2, 3.6, 3.7, 4.0])
def test_the_place_of_a_circle_is_that_of_the_robot_in_line_with_its_way(data: Data, end: float) -> None:
    """By hand, over the whole way of a slanted line."""
    scenario = made(data, "guard.fence=[[-2, -2], [5, -2], [5, 6], [-2, 6]]", f"task.end=[{end}, 2]")
    way, polygon, worst = way_of(scenario.task), shapely.Polygon(scenario.guard.fence), math.inf  # type: ignore[arg-type]
    for k in range(500):
        frame, (vx, vy, _) = way.at(way.travel_s * k / 499)
        for robot, point in zip(scenario.robots, scenario.formation.points, strict=True):
            place = frame.compose(Pose(*point, math.atan2(vy, vx) - frame.psi))
            middle = shapely.Point(place.compose(Pose(-robot.control_point_m, 0.0, 0.0))[:2])
            need = outline.circle(scenario.model_of(robot))[1] + scenario.guard.margin_m
            worst = min(worst, polygon.exterior.distance(middle) - need)
    assert bool(list(fence_problems(scenario))) == (worst < 0.0)
