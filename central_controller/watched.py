"""The formation law and the planner that a scenario names, watched: one that fails lets the platoon stand.

The built-in ones are watched like a user's.
"""

from collections.abc import Sequence

import numpy as np

from central_controller import formation
from central_controller.chain import Chain, Desired
from central_controller.formation import Correction
from central_controller.planning import METHODS
from maniple.control.parts import Parts, Planner, chosen, made
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Controller, Planning

LAWS = {"paper": formation.paper}
"""The built-in formation laws, by the names that scenarios use."""


class WatchedLaw:
    """The formation law of a scenario. Once it has raised, or given anything but finite rates of the right
    shape, its velocities are zero, and `fault` says why.

    Raises:
        ScenarioError: there is no such law, or it refuses its options.
    """

    def __init__(self, parameters: Controller, parts: Parts) -> None:
        factory = chosen({**LAWS, **parts.formation_laws}, parameters.law, "controller.law")
        self._law = made("controller", factory, parameters)
        self.fault = ""
        """Why it has ended; empty while it has not."""

    def step(self, chain: Chain, positions: Floats, desired: Desired, dt_s: float) -> Correction:
        """See `formation.step`, for control points at `positions`, (n, 2)."""
        return formation.step(chain, self, positions, desired, dt_s)

    def rates(self, desired_rates: Floats, errors: Floats, dt_s: float) -> Floats:
        """See `FormationLaw`."""
        if not self.fault:
            try:
                rates = np.asarray(
                    self._law.rates(desired_rates.copy(), errors.copy(), dt_s), dtype=np.float64
                )
                if rates.shape != errors.shape:
                    raise ValueError(f"gave rates of shape {rates.shape}; must be {errors.shape}")
                if not np.isfinite(rates).all():
                    raise ValueError("gave rates that are not finite")
            except Exception as error:  # noqa: BLE001 - a user's law may raise anything
                self.fault = f"the formation law failed: {type(error).__name__}: {error}"
            else:
                return rates
        return np.zeros_like(errors)


class WatchedPlanner:
    """The planner of a scenario. Where it raises, or gives no permutation, robots keep their order, and
    `fault` says why, until it has planned again.

    Raises:
        ScenarioError: there is no such planner.
    """

    def __init__(self, parameters: Planning, parts: Parts) -> None:
        self._planner: Planner = chosen({**METHODS, **parts.planners}, parameters.method, "planning.method")
        self.fault = ""
        """Why the last plan is none; empty if it is one."""

    def __call__(self, positions: Floats, places: Floats) -> Sequence[int]:
        """See `Planner`."""
        self.fault = ""
        try:
            order = [int(index) for index in self._planner(positions.copy(), places.copy())]
            if sorted(order) != list(range(len(places))):
                raise ValueError(f"gave {order}; must be every index below {len(places)} once")
        except Exception as error:  # noqa: BLE001 - a user's planner may raise anything
            self.fault = f"the planner failed: {type(error).__name__}: {error}"
            return range(len(places))
        return order
