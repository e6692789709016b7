from typing import Any

import pytest
from msgspec.structs import replace

from central_controller.reference import Course
from maniple.cli.loading import completed
from maniple.cli.nodes import time_limit_s
from maniple.core.scenario.types import Scenario
from tests.cli.scenes import platoon


def scene(**planning: Any) -> Scenario:
    """Four robots, the first of which starts 5 m from its place and less than 10 m from all others."""
    scenario = platoon(4, planning=planning)
    first, *others = scenario.robots
    return completed(replace(scenario, robots=(replace(first, pose=(4.8, 0.9, 0.0)), *others)))


def test_a_run_is_given_three_times_what_its_task_takes() -> None:
    scenario = scene()
    assert time_limit_s(scenario, None) == 3.0 * Course(scenario.task).total_s + 60.0
    assert time_limit_s(scenario, 7.0) == 7.0


@pytest.mark.parametrize("build", ["straight", "law"])
def test_and_what_building_the_formation_takes(build: str) -> None:
    """At 0.05 m/s, or by the law, which is no faster than its saturation."""
    speed = 0.05 if build == "straight" else 0.1
    more = time_limit_s(scene(build=build, speed_mps=0.05), None) - time_limit_s(scene(), None)
    assert 3.0 * 5.0 / speed < more < 3.0 * (1.875 * 10.0 / speed + 30.0)
