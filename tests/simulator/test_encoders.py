import math
from collections.abc import Callable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.scenario.types import Scenario
from simulator.encoders import Encoders


@settings(deadline=None, derandomize=True, max_examples=100)
@given(path=st.floats(-100, 100), turn=st.floats(-50, 50), heading=st.floats(-3, 3))
def test_ticks_give_back_the_motion(
    make_scenario: Callable[..., Scenario], path: float, turn: float, heading: float
) -> None:
    model = make_scenario([(0.0, 0.0, 0.0)]).models["pioneer"]
    [(left, right)] = Encoders([model], np.array([heading])).ticks(np.array([[path], [heading + turn]]))
    per_tick = 2 * math.pi * model.wheel_radius_m / model.ticks_per_revolution
    for count, side in ((left, -0.5), (right, 0.5)):
        assert isinstance(count, int)
        rest = path + side * turn * model.track_m - count * per_tick
        assert -1e-12 <= rest <= per_tick + 1e-12


def test_nothing_is_counted_at_power_up(make_scenario: Callable[..., Scenario]) -> None:
    models = [make_scenario([(0.0, 0.0, 0.0)]).models["pioneer"]] * 2
    heading = np.array([2.0, -3.0])
    encoders = Encoders(models, heading)
    assert encoders.ticks(np.stack([np.zeros(2), heading])) == [(0, 0), (0, 0)]
    assert encoders.ticks(np.stack([np.array([-1e-9, 1e-9]), heading])) == [(-1, -1), (0, 0)]
