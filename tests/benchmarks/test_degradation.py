from pathlib import Path
from typing import Any

import pytest

from benchmarks.degradation import NAMES, SWEEPS, Line, held, lines, markdown
from maniple.cli.sweep.plan import plan_of


def row(latency: float, off: float | None = 0.01, completed: bool = True, **more: Any) -> dict[str, Any]:
    return {
        "placement": "drive",
        "loss": 0.3,
        "latency_s": latency,
        "final_error_distance_m": off,
        "completed": completed,
        "collisions": 0,
        "tolerated_delay_s": 0.4,
        "delay_margin_s": 0.3,
        **more,
    }


def test_held_up_to_the_first_that_is_not() -> None:
    rows = [row(0.1), row(0.2), row(0.2, 9.0), row(0.3), row(0.05)]
    assert held(rows, lambda one: one["final_error_distance_m"] < 1) == 0.1
    assert held(rows, lambda one: True) == 0.3
    assert held(rows, lambda one: one["latency_s"] > 0.05) is None


def test_a_line_for_each_placement_and_loss() -> None:
    edge = [row(0.1), row(0.2, None), row(0.1, placement="kinematics"), row(0.2, placement="kinematics")]
    guarded = [row(0.1, completed=False), row(0.1, placement="kinematics", collisions=1)]
    drive, kinematics = lines(edge, guarded)
    assert drive == Line("drive", 0.3, 0.2, 0.15, 0.1, None)
    assert kinematics == Line("kinematics", 0.3, 0.2, 0.15, 0.2, None)
    text = markdown([drive, kinematics]).splitlines()
    assert text[2] == "| drive | 30% | 0.20 s | 0.15 s | 0.10 s | never |"


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_run_of_every_sweep_is_valid(name: str) -> None:
    plan = plan_of(SWEEPS / f"{name}.toml")
    assert plan.sweep.name == name
    assert plan.jobs


def test_no_sweep_is_left_out() -> None:
    assert {path.stem for path in SWEEPS.glob("degradation-*.toml")} == set(NAMES)
    assert (Path(SWEEPS) / "free-space.toml").exists()
