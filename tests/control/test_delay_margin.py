import math
from collections import deque
from itertools import product

import numpy as np
import pytest

from maniple.cli.loading import loads
from maniple.control.delay_margin import delay_margin_s, margin
from maniple.core.scenario.types import Scenario

SCENE = b"""
name = "margins"
task = { kind = "line", start = [0, 0], end = [9, 0], speed_mps = 0.4 }
formation.shape = { kind = "wedge", spacing_m = 2.0 }
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
"""


def scene(*overrides: str) -> Scenario:
    return loads(SCENE, overrides)


def grows(first: float, second: float, lag_s: float, delay_s: float, carried: float) -> bool:
    """Whether y'' = q, lag q' = c - q, c = -(first y' + second y) a delay ago, y and y' carried forward over
    a part of that, swings wider and wider."""
    steps = 200
    dt, ahead = delay_s / steps, carried * delay_s
    y, rate, q = 1.0, 0.0, 0.0
    past = deque([0.0] * steps)
    seen = []
    for _ in range(100 * steps):
        past.append(-first * (rate + ahead * q) - second * (y + ahead * rate))
        q += dt / lag_s * (past.popleft() - q)
        rate += dt * q
        y += dt * rate
        seen.append(abs(y))
    half = len(seen) // 2
    return max(seen[3 * half // 2 :]) > max(seen[half : 3 * half // 2])


@pytest.mark.parametrize("carried", [0.0, 0.5])
@pytest.mark.parametrize("turning", [0.5, 1.0, 2.0])
def test_a_simulated_loop_loses_its_stability_there(turning: float, carried: float) -> None:
    first, second = turning + 0.25, turning * 0.25
    found = margin(first, second, 0.233, carried)
    assert not grows(first, second, 0.233, 0.95 * found, carried)
    assert grows(first, second, 0.233, 1.05 * found, carried)


@pytest.mark.parametrize(
    ("first", "share", "lag"), list(product((0.05, 1.0, 8.0), (0.0, 0.1, 0.3), (0.0, 0.3)))
)
def test_at_the_margin_the_open_loop_passes_minus_one(first: float, share: float, lag: float) -> None:
    """Somewhere: |1 + L(jw)| has a zero, found on a grid of w."""
    second = share * first**2
    found = margin(first, second, lag)
    assert found > 0.0
    w = np.geomspace(1e-3, 1e2, 100_001)
    loop = (first * 1j * w + second) / ((1j * w) ** 2 * (1.0 + lag * 1j * w)) * np.exp(-1j * w * found)
    assert np.abs(1.0 + loop * (1.0 + 0.5j * w * found)).min() < 2e-3


def test_without_lag_and_offset_it_is_the_rule_of_thumb() -> None:
    assert margin(2.0, 0.0, 0.0, carried=0.0) == pytest.approx(math.pi / 4.0, rel=1e-3)


def test_a_loop_that_is_unstable_without_delay_has_none() -> None:
    """L(s) = (s + 2) / (s^2 (1 + s)): 1 < 2 * 1, by Routh."""
    assert margin(1.0, 2.0, 1.0) == 0.0


def test_a_faster_platoon_tolerates_less_but_not_with_the_kinematics_on_the_robots() -> None:
    def of(speed: float, layer: str) -> float:
        scenario = scene(f"task.speed_mps={speed}", f"placement.robot_from={layer}")
        found = delay_margin_s(scenario, scenario.robots[0])
        assert found is not None
        return found

    assert of(0.2, "drive") > of(0.3, "drive") > of(0.4, "drive")
    assert of(0.4, "drive") == of(0.4, "compensation") == of(0.4, "avoidance")
    assert of(0.2, "kinematics") == of(0.4, "kinematics")


def test_only_of_a_differential_drive() -> None:
    scenario = scene("robots.0.model=robotino", "task.speed_mps=0.2")
    assert delay_margin_s(scenario, scenario.robots[0]) is None
    assert delay_margin_s(scenario, scenario.robots[1]) is not None
