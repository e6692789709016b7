"""The saturated formation law, eq. (7): q_ref' = q_des' + L tanh(L^-1 kappa (q_des - q))."""

from typing import NamedTuple

import numpy as np

from central_controller.chain import Chain, Desired
from maniple.control.parts import FormationLaw, refuse_options
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

    def rates(self, desired_rates: Floats, errors: Floats, dt_s: float) -> Floats:  # noqa: ARG002
        """See `FormationLaw`: eq. (7), which has no state."""
        return law(desired_rates, errors, self)


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


def paper(parameters: Controller) -> Gains:
    """The law "paper", eq. (7).

    Raises:
        ValueError: it is given options.
    """
    refuse_options(parameters.options)
    return Gains.of(parameters)


def step(
    chain: Chain, law: FormationLaw, positions: Floats, desired: Desired, dt_s: float = 0.0
) -> Correction:
    """Velocities of all control points from their positions (..., n, 2): f, the law, J^-1, the chain.

    `dt_s` (s) is the time since the step before, for a law with a state.
    """
    triangles = chain.triangles(positions)
    error = errors(desired.q, triangles.variables())
    rates = law.rates(desired.rates, error, dt_s)
    return Correction(chain.select(triangles.velocities(rates)), error)
