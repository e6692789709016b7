import math

import numpy as np
import pytest

from maniple.control.limits import Velocity
from maniple.control.returns import Returns
from maniple.control.swerve import Swerve


class Probe:
    """A law that slows by a tenth and turns by a half, and notes what it is told."""

    def __init__(self) -> None:
        self.wanted = Velocity()
        self.returns: Returns | None = None

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
        self.wanted, self.returns = wanted, returns
        return Velocity(wanted.u - 0.1, wanted.w + 0.5, wanted.v)


@pytest.mark.parametrize("direction", [0.0, 0.7, math.pi / 2, -2.5])
def test_the_law_looks_where_the_robot_goes_and_turning_becomes_sideways(direction: float) -> None:
    law = Probe()
    swerve = Swerve(law, 0.3)
    c, s = math.cos(direction), math.sin(direction)
    seen = Returns(np.array([1.0, 2.0]), np.array([direction, 3.0]), True, True)
    told = swerve.step(Velocity(0.4 * c, 0.2, 0.4 * s), seen, 0.1)
    assert law.wanted == pytest.approx((0.4, 0.2, 0.0), abs=1e-12)
    assert law.returns is not None
    assert law.returns.distance.tolist() == [1.0, 2.0]
    assert law.returns.bearing[0] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(law.returns.bearing).max() <= math.pi
    ahead, aside = 0.3, 0.3 * 0.5
    assert told == pytest.approx((ahead * c - aside * s, 0.2, ahead * s + aside * c))


def test_at_a_stand_it_keeps_looking_where_it_went() -> None:
    law = Probe()
    swerve = Swerve(law, 0.3)
    swerve.step(Velocity(0.0, 0.0, 0.4), None, 0.1)
    told = swerve.step(Velocity(), None, 0.1)
    assert law.returns is None
    assert told == pytest.approx((-0.15, 0.0, -0.1))
