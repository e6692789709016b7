import builtins
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from central_controller import planning
from maniple.cli.loading import load
from maniple.cli.plan_command import plans_of
from maniple.cli.program import app
from maniple.cli.scenario_commands import PIPED_WIDTH
from maniple.core.errors import ManipleError, MissingExtraError, ScenarioError
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Scenario

PAPER = Path(__file__).parents[2] / "scenarios" / "paper-simulation-1.toml"
SCATTERED = ("start.scatter_m=2", "world.obstacles=[]")


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["plan", str(PAPER), *arguments])


def scattered(*overrides: str) -> Scenario:
    return load(PAPER, (*SCATTERED, *overrides), seed=3)


def printed(*arguments: str) -> Any:
    result = run(
        "--seed", "3", "--json", *(part for text in SCATTERED for part in ("--set", text)), *arguments
    )
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_every_method_is_shown_and_the_scenarios_own_is_marked() -> None:
    plans = printed("--set", "planning.method=proximity")
    assert [one["method"] for one in plans["assignments"]] == list(planning.METHODS)
    assert [one["method"] for one in plans["assignments"] if one["used"]] == ["proximity"]
    by_name = {one["method"]: one for one in plans["assignments"]}
    assert by_name["given"]["robots"] == ["r1", "r2", "r3", "r4", "r5", "r6"]
    assert by_name["optimal"]["total_m"] == pytest.approx(min(one["total_m"] for one in plans["assignments"]))
    for one in plans["assignments"]:
        assert sorted(one["robots"]) == ["r1", "r2", "r3", "r4", "r5", "r6"]


def test_figures_are_those_of_the_initial_poses() -> None:
    scenario = scattered()
    plans = plans_of(scenario, "given")
    ways = []
    for robot, (x, y) in zip(scenario.robots, scenario.formation.points, strict=True):
        assert robot.pose is not None
        px, py, psi = robot.pose
        a = robot.control_point_m
        ways.append(np.hypot(px + a * np.cos(psi) - x, py + a * np.sin(psi) - y))
    (only,) = plans.assignments
    assert only.total_m == pytest.approx(sum(ways))
    assert only.longest_m == pytest.approx(max(ways))
    assert only.build_s == pytest.approx(1.875 * max(ways) / scenario.planning.speed_mps)


def test_places_are_where_the_task_starts() -> None:
    turned = scattered("task.start=[1, 2]", "task.end=[1, 17]", "start.scatter_m=0")
    x, y = turned.formation.points[1]
    plans = plans_of(turned, "given")
    assert plans.places[1] == pytest.approx((1 - y, 2 + x))
    assert plans.assignments[0].total_m == pytest.approx(0.0, abs=1e-9)


def test_places_are_numbered_anew_where_the_scenario_says_so() -> None:
    shuffled = "formation.points=[[2, 0.9], [-1.2, 0.9], [1.2, -0.9], [-2, -0.9], [0.4, 0.9], [-0.4, -0.9]]"
    plans = plans_of(scattered(shuffled, "start.scatter_m=0", "planning.relabel=true"))
    assert plans.relabel
    assert plans.overlaps == 0 < plans.overlaps_as_given
    assert plans_of(scattered(shuffled, "start.scatter_m=0")).overlaps == plans.overlaps_as_given


def test_the_table() -> None:
    result = run("--method", "optimal")
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0] == "paper-simulation-1: 6 places, no overlaps in the chain of triangles, seed 1"
    cells = lines[3].split()
    assert cells[:3] == ["optimal", "0.00", "m"]
    assert cells[-6:] == ["r1", "r2", "r3", "r4", "r5", "r6"]
    assert max(map(len, lines)) <= PIPED_WIDTH


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(
        ScenarioError, match=r"planning.method = 'best': no such planner is installed; there are final-"
    ):
        plans_of(load(PAPER), "best")


def test_a_method_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def same(positions: Floats, places: Floats) -> Sequence[int]:
        return [0] * len(places)

    monkeypatch.setitem(planning.METHODS, "given", same)
    with pytest.raises(ManipleError, match="planner failed: a planner gave"):
        plans_of(load(PAPER), "given")


def test_without_scipy_the_others_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **named: object) -> object:
        if name.startswith("scipy"):
            raise ImportError(name)
        return real(name, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", without)
    plans = plans_of(load(PAPER))
    assert [one.method for one in plans.assignments] == ["given", "final-reorganization", "proximity"]
    assert "maniple[planning]" in plans.unavailable["optimal"]
    assert msgspec.json.encode(plans)
    with pytest.raises(MissingExtraError):
        plans_of(load(PAPER), "optimal")
