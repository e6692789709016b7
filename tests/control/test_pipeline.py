import math
from typing import get_args

import numpy as np
import pytest

from maniple.control import avoidance, unicycle
from maniple.control.pipeline import PIPELINE, Pipeline, central_layers, onboard_layers
from maniple.control.returns import Returns
from maniple.core.layers import Layer
from maniple.core.scenario.types import Avoidance

SEEN = Returns(np.array([0.5]), np.array([-0.5]), True, False)


def test_every_cut_leaves_every_layer_on_exactly_one_side() -> None:
    assert get_args(Layer) == PIPELINE
    for cut in PIPELINE:
        assert central_layers(cut) + onboard_layers(cut) == PIPELINE
        assert onboard_layers(cut)[0] == cut


@pytest.mark.parametrize("cut", PIPELINE)
def test_the_place_of_the_cut_does_not_change_what_comes_out(cut: Layer) -> None:
    whole = Pipeline(PIPELINE, 0.3, Avoidance())
    centre = Pipeline(central_layers(cut), 0.3, Avoidance())
    robot = Pipeline(onboard_layers(cut), 0.3, Avoidance())
    for k in range(20):
        values, psi, seen = (0.1, 0.02 * k), 0.1 * k, SEEN if k > 5 else None
        expected = whole.step(values, psi, seen, 0.1)
        assert robot.step(centre.step(values, psi, seen, 0.1), psi, seen, 0.1) == expected


def test_kinematics_steers_the_control_point() -> None:
    u, w = Pipeline(("kinematics",), 0.3, Avoidance()).step((0.1, -0.2), 0.7, None, 0.1)
    assert unicycle.forward(0.7, 0.3, u, w) == pytest.approx((0.1, -0.2))


def test_avoidance_subtracts_and_adds_its_corrections() -> None:
    pipeline = Pipeline(("avoidance",), 0.3, Avoidance())
    sides = avoidance.forces(Avoidance(), SEEN)
    state = avoidance.step(Avoidance(), avoidance.step(Avoidance(), avoidance.REST, sides, 0.1), sides, 0.05)
    pipeline.step((0.2, 0.1), 0.0, SEEN, 0.1)
    assert pipeline.step((0.2, 0.1), 0.0, SEEN, 0.05) == (0.2 - state.u_cor, 0.1 + state.w_cor)
    assert state.u_cor > 0.0
    assert state.w_cor > 0.0  # an obstacle on the right turns it left


def test_corrections_fade_when_nothing_is_known_any_more() -> None:
    pipeline = Pipeline(("avoidance",), 0.3, Avoidance())
    for _ in range(30):
        pipeline.step((0.2, 0.0), 0.0, SEEN, 0.1)
    for _ in range(300):
        u, w = pipeline.step((0.2, 0.0), 0.0, None, 0.1)
    assert (u, w) == pytest.approx((0.2, 0.0), abs=1e-4)


def test_layers_left_out_pass_values_on() -> None:
    for pipeline in (
        Pipeline((), 0.3, Avoidance()),
        Pipeline(("avoidance",), 0.3, Avoidance(enabled=False)),
        Pipeline(("compensation", "drive"), 0.3, Avoidance()),
    ):
        assert pipeline.step((0.2, 0.1), math.pi, SEEN, 0.1) == (0.2, 0.1)
