import msgspec
import numpy as np
import pytest

from maniple.core.scenario.types import RangeFinder
from simulator.noise import RangeNoise

SENSOR = RangeFinder(
    beams=2000, first_angle_rad=0.0, increment_rad=0.003, range_max_m=8.0, sigma_m=0.005, resolution_m=0.001
)


def test_errors_are_gaussian_and_readings_whole_steps() -> None:
    readings = RangeNoise(1, ["r1", "r2"], SENSOR).apply(np.full((2, 2000), 3.0))
    errors = readings - 3.0
    assert errors.mean() == pytest.approx(0.0, abs=0.0005)
    assert errors.std() == pytest.approx(0.005, rel=0.05)
    assert np.abs(readings / 0.001 - np.rint(readings / 0.001)).max() < 1e-6
    assert not np.array_equal(readings[0], readings[1])


def test_readings_stay_within_the_limits_and_nothing_is_nothing() -> None:
    true = np.concatenate([np.full(700, 8.0), np.full(700, 7.999), np.full(600, 0.001)])[None]
    readings = RangeNoise(1, ["r1"], SENSOR).apply(true)[0]
    assert (readings[:700] == 8.0).all()
    assert 7.97 < readings[700:1400].min() < 7.999
    assert readings[700:1400].max() == 8.0
    assert readings[1400:].min() == 0.0


def test_a_robots_errors_do_not_depend_on_others_or_on_what_is_seen() -> None:
    together = RangeNoise(7, ["r1", "r2", "r3"], SENSOR)
    alone = RangeNoise(7, ["r2"], SENSOR)
    together.apply(np.full((3, 2000), 8.0))
    alone.apply(np.full((1, 2000), 1.0))
    assert np.array_equal(together.apply(np.full((3, 2000), 2.0))[1], alone.apply(np.full((1, 2000), 2.0))[0])


def test_the_seed_matters() -> None:
    first, second = (RangeNoise(seed, ["r1"], SENSOR).apply(np.full((1, 2000), 2.0)) for seed in (1, 2))
    assert not np.array_equal(first, second)


def test_an_ideal_sensor_tells_the_truth() -> None:
    ideal = msgspec.structs.replace(SENSOR, sigma_m=0.0, resolution_m=0.0)
    true = np.linspace(0.0, 8.0, 2000)[None]
    noise = RangeNoise(1, ["r1"], ideal)
    assert np.array_equal(noise.apply(true), true)
    assert np.array_equal(noise.apply(true), true)
