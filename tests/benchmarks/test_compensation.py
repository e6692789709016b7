import math

import numpy as np
import pytest

from benchmarks.compensation import KAPPA, QUICK, WRONG, Drift, measured
from maniple.core.scenario.types import Compensation


def test_figures_of_a_drift() -> None:
    drift = Drift(
        np.array([[0.3, 0, 0, 0, 0, 0.4], [0.0] * 6]), np.array([[0, 3.0, 0, 0, 4.0, 0], [0.1] * 6])
    )
    assert drift.rms == pytest.approx(math.sqrt(0.125))
    assert drift.bound(0.25) == pytest.approx(2.0)
    assert drift.largest_error == pytest.approx(5.0)


@pytest.fixture(scope="module")
def without() -> Drift:
    return measured(Compensation(), laps=2.5)


@pytest.mark.parametrize("initial", [WRONG[0], pytest.param(WRONG[1], marks=pytest.mark.slow)])
def test_compensation_halves_the_velocity_error_and_the_bound_is_kept(without: Drift, initial: float) -> None:
    compensated = measured(Compensation(enabled=True, initial=initial, gamma=QUICK), laps=2.5)
    assert compensated.rms < 0.5 * without.rms
    for drift in (without, compensated):
        assert drift.largest_error < drift.bound(KAPPA)
