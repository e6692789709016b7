import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.core.scenario.types import Scenario
from simulator.encoders import Encoders, Slip
from tests.pioneer import PIONEER


@settings(deadline=None, derandomize=True, max_examples=100)
@given(path=st.floats(-100, 100), turn=st.floats(-50, 50), heading=st.floats(-3, 3))
def test_ticks_give_back_the_motion(
    make_scenario: Callable[..., Scenario], path: float, turn: float, heading: float
) -> None:
    model = make_scenario([(0.0, 0.0, 0.0)]).models["pioneer"]
    [(left, right)] = Encoders([model], np.array([heading]), 1, ["r1"]).ticks(
        np.array([[path], [heading + turn]])
    )
    per_tick = 2 * math.pi * model.wheel_radius_m / model.ticks_per_revolution
    for count, side in ((left, -0.5), (right, 0.5)):
        assert isinstance(count, int)
        rest = path + side * turn * model.track_m - count * per_tick
        assert -1e-12 <= rest <= per_tick + 1e-12


def test_nothing_is_counted_at_power_up(make_scenario: Callable[..., Scenario]) -> None:
    models = [make_scenario([(0.0, 0.0, 0.0)]).models["pioneer"]] * 2
    heading = np.array([2.0, -3.0])
    encoders = Encoders(models, heading, 1, ["r1", "r2"])
    assert encoders.ticks(np.stack([np.zeros(2), heading])) == [(0, 0), (0, 0)]
    assert encoders.ticks(np.stack([np.array([-1e-9, 1e-9]), heading])) == [(-1, -1), (0, 0)]


def slip(sigma: float = 0.1, length: float = 0.05, seed: int = 1, name: str = "slip/r1/0") -> Slip:
    return Slip(replace(PIONEER, slip_sigma=sigma, slip_length_m=length), seed, name)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=20), st.integers(1, 30))
def test_slip_does_not_depend_on_the_length_of_the_steps(ways: list[float], parts: int) -> None:
    coarse, fine = slip(), slip()
    whole = coarse.roll(np.array(ways))
    pieces = sum(fine.roll(np.full(parts, way / parts)) for way in ways)
    assert pieces == pytest.approx(whole, abs=1e-12)


def test_slip_is_a_share_of_the_way_drawn_anew_for_each_length() -> None:
    wheel = slip(sigma=0.1, length=0.05)
    shares = np.array([wheel.roll(np.full(5, 0.01)) for _ in range(20_000)]) / 0.05
    assert shares.std() == pytest.approx(0.1, rel=0.02)
    assert shares.mean() == pytest.approx(0.0, abs=0.003)
    assert np.corrcoef(shares[:-1], shares[1:])[0, 1] == pytest.approx(0.0, abs=0.03)
    wheel = slip(sigma=0.1, length=0.05)
    first = wheel.roll(np.array([0.02]))
    assert wheel.roll(np.array([-0.02])) == pytest.approx(-first)  # the other way, slipping as before
    assert slip(sigma=0.0).roll(np.array([3.0])) == 0.0


def test_every_wheel_slips_by_its_own_stream() -> None:
    shares = [
        slip(name=name, seed=seed).roll(np.array([0.01]))
        for name, seed in (
            ("slip/r1/0", 1),
            ("slip/r1/1", 1),
            ("slip/r2/0", 1),
            ("slip/r1/0", 2),
            ("slip/r1/0", 1),
        )
    ]
    assert len(set(shares)) == 4
    assert shares[0] == shares[-1]


def test_slipping_wheels_turn_more_than_the_robot_moves() -> None:
    sound, slippery = PIONEER, replace(PIONEER, slip_sigma=0.2)
    encoders = Encoders([sound, slippery], np.zeros(2), 1, ["r1", "r2"])
    arcs = np.zeros((50, 2, 2))
    arcs[:, 0] = 0.01
    encoders.roll(arcs)
    true, slipped = encoders.ticks(arcs.sum(axis=0))
    per_metre = PIONEER.ticks_per_revolution / (2 * math.pi * PIONEER.wheel_radius_m)
    assert true == (math.floor(0.5 * per_metre),) * 2
    wheels = [Slip(slippery, 1, f"slip/r2/{side}").roll(np.full(50, 0.01)) for side in (0, 1)]
    assert slipped == tuple(math.floor((0.5 + wheel) * per_metre) for wheel in wheels)
    assert slipped[0] != slipped[1] != true[1]


def test_wheels_and_track_that_are_not_as_believed() -> None:
    model = replace(PIONEER, wheel_error=(0.01, -0.02), track_error=0.05)
    encoders = Encoders([model], np.zeros(1), 1, ["r1"])
    [ticks] = encoders.ticks(np.array([[2.0], [3.0]]))
    per_metre = PIONEER.ticks_per_revolution / (2 * math.pi * PIONEER.wheel_radius_m)
    half = 0.5 * 1.05 * PIONEER.track_m
    left, right = (2.0 - 3.0 * half) / 1.01, (2.0 + 3.0 * half) / 0.98
    assert ticks == pytest.approx((left * per_metre, right * per_metre), abs=1.0)
