"""The saturated formation law, eq. (7): q_ref' = q_des' + L tanh(L^-1 kappa (q_des - q))."""

from typing import NamedTuple

import numpy as np

from central_controller.chain import Chain, Desired
from maniple.core.geometry import Floats, wrap_array
from maniple.core.scenario.types import Controller


class Gains(NamedTuple):
    """The diagonals of the gain matrices, each (6,)."""

    slope: Floats
    """L^-1 kappa, 1/m and 1/rad."""
    saturation: Floats
    """L, m/s and rad/s."""

    @classmethod
    def of(cls, parameters: Controller) -> "Gains":
        """One number in the parameters stands for all six."""
        saturation = np.broadcast_to(np.asarray(parameters.saturation, dtype=np.float64), 6)
        return cls(np.asarray(parameters.kappa, dtype=np.float64) / saturation, saturation)


class Correction(NamedTuple):
    """What the law makes of the robots' positions."""

    velocities: Floats
    """Of every control point, (..., n, 2) in m/s."""
    errors: Floats
    """Desired minus estimated q of every triangle, (..., n - 2, 6)."""


def errors(desired: Floats, q: Floats) -> Floats:
    """Desired minus actual q, (..., 6); psi_F and beta in (-pi, pi]."""
    out = desired - q
    out[..., 2::3] = wrap_array(out[..., 2::3])
    return out


def law(desired_rates: Floats, error: Floats, gains: Gains) -> Floats:
    """The rates q_ref' (..., 6) of eq. (7) from the rates q_des' and the errors, both (..., 6)."""
    rates = error * gains.slope
    np.tanh(rates, out=rates)
    rates *= gains.saturation
    rates += desired_rates
    return rates


def step(chain: Chain, gains: Gains, positions: Floats, desired: Desired) -> Correction:
    """Velocities of all control points from their positions (..., n, 2): f, the law, J^-1, the chain."""
    triangles = chain.triangles(positions)
    error = errors(desired.q, triangles.variables())
    rates = law(desired.rates, error, gains)
    return Correction(chain.select(triangles.velocities(rates)), error)
