"""The suites pass what is built in, and catch what each property is there for."""

import math
import os
import random
import time
from collections.abc import Callable
from datetime import datetime
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from central_controller.planning import METHODS
from central_controller.watched import LAWS
from maniple.cli.loading import robot_models
from maniple.control import conformance
from maniple.control.builtin import BUILTIN
from maniple.control.conformance import Finding
from maniple.control.kinematics import Differential
from maniple.control.limits import Velocity
from maniple.control.returns import Returns
from maniple.core.scenario.types import Avoidance, Compensation, Controller, RobotModel
from tests.pioneer import PIONEER


def failures(findings: list[Finding]) -> dict[str, str]:
    return {finding.name: finding.counterexample for finding in findings if not finding.holds}


@pytest.mark.parametrize("form", ["cos", "sin"])
def test_impedance_conforms(form: Any) -> None:
    found = conformance.avoidance(BUILTIN.avoidance["impedance"], Avoidance(form=form), PIONEER)
    assert failures(found) == {}


@pytest.mark.parametrize("initial", [1.0 / 1.5, 1.0, 1.5])
def test_adaptive_conforms(initial: float) -> None:
    found = conformance.compensation(BUILTIN.compensation["adaptive"], Compensation(initial=initial), PIONEER)
    assert failures(found) == {}


@pytest.mark.parametrize("name", LAWS)
def test_formation_laws_conform(name: str) -> None:
    assert failures(conformance.formation_law(LAWS[name], Controller())) == {}


@pytest.mark.parametrize("name", METHODS)
def test_planners_conform(name: str) -> None:
    assert failures(conformance.planner(METHODS[name])) == {}


@pytest.mark.parametrize("name", list(robot_models()))
def test_kinematics_of_the_catalogue_conform(name: str) -> None:
    found = conformance.kinematics(BUILTIN.kinematics[""], robot_models()[name], 0.2)
    assert failures(found) == {}


class Through:
    """An avoidance that lets everything through; what is wrong with it is added by each test."""

    wrong: Callable[..., Any]

    def __init__(self, parameters: Avoidance, model: RobotModel) -> None:
        self.steps = 0

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Any:
        self.steps += 1
        return self.wrong(wanted, returns, dt_s)


_UNSEEDED = np.random.default_rng()


def _writes(_: Through, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
    if returns is not None:
        returns.distance[:] = 9.0
    return wanted


def _overflows(_: Through, wanted: Velocity, returns: Returns | None, dt_s: float) -> Velocity:
    return wanted._replace(u=math.exp(abs(wanted.u)))


@pytest.mark.parametrize(
    ("wrong", "caught"),
    [
        (lambda self, wanted, returns, dt_s: wanted[:2], "gives three finite numbers"),
        (lambda self, wanted, returns, dt_s: (math.nan, 0.0, 0.0), "gives three finite numbers"),
        (_overflows, "gives them for huge and for vanishing inputs"),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + _UNSEEDED.normal()),
            "same inputs, same outputs",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=0.1 * self.steps * wanted.u),
            "a step of no time changes nothing",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(w=wanted.w + 0.1),
            "stays at rest where nothing is near",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=1.1 * wanted.u),
            "does not speed up towards what is dead ahead",
        ),
        (_writes, "leaves its inputs as they are"),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + 0.0 * np.random.rand()),  # noqa: NPY002
            "draws nothing from a global random source",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + 0.0 * random.random()),
            "draws nothing from a global random source",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + 0.0 * time.perf_counter()),
            "reads no clock and no file",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + 0.0 * datetime.now().year),
            "reads no clock and no file",
        ),
        (
            lambda self, wanted, returns, dt_s: wanted._replace(u=wanted.u + 0.0 * len(os.urandom(1))),
            "reads no clock and no file",
        ),
    ],
)
def test_an_avoidance_that_breaks_a_property_is_caught(wrong: Any, caught: str) -> None:
    law = type("Wrong", (Through,), {"wrong": wrong})
    found = failures(conformance.avoidance(law, Avoidance(), PIONEER))
    assert caught in found
    assert found[caught]


def test_an_avoidance_that_does_nothing_breaks_nothing() -> None:
    law = type("Nothing", (Through,), {"wrong": lambda self, wanted, returns, dt_s: wanted})
    assert failures(conformance.avoidance(law, Avoidance(), PIONEER)) == {}


def test_what_raises_is_a_finding_and_not_an_error() -> None:
    def broken(parameters: Avoidance, model: RobotModel) -> Any:
        raise KeyError("mine")

    found = failures(conformance.avoidance(broken, Avoidance(), PIONEER))
    assert len(found) > 5
    assert set(found.values()) == {"raised KeyError: 'mine'"}


class Law:
    wrong: Callable[..., Any]

    def __init__(self, parameters: Controller) -> None:
        pass

    def rates(self, desired_rates: Any, errors: Any, dt_s: float) -> Any:
        return self.wrong(desired_rates, errors)


@pytest.mark.parametrize(
    ("wrong", "caught"),
    [
        (lambda self, desired, errors: desired[0], "gives finite rates of the shape of the errors"),
        (lambda self, desired, errors: desired - 0.5 * errors, "what it adds makes the errors smaller"),
        (
            lambda self, desired, errors: desired + errors + 0.1,
            "without errors it asks for the desired rates",
        ),
        (lambda self, desired, errors: desired + 1e-4 * errors, "errors of ideal robots fade"),
    ],
)
def test_a_formation_law_that_breaks_a_property_is_caught(wrong: Any, caught: str) -> None:
    assert caught in failures(
        conformance.formation_law(type("Wrong", (Law,), {"wrong": wrong}), Controller())
    )


@pytest.mark.parametrize("order", [lambda n: [0] * n, lambda n: range(1, n + 1), lambda n: range(n - 1)])
def test_a_planner_that_gives_no_permutation_is_caught(order: Any) -> None:
    found = failures(conformance.planner(lambda positions, places: order(len(places))))
    assert set(found) == {"every robot gets one place"}


class Learns:
    """A compensation that makes the drive worse, and loses a parameter on the way."""

    def __init__(self, parameters: Compensation, model: RobotModel) -> None:
        self.parameters: tuple[float, ...] = (1.0, 2.0)

    def step(self, desired: Velocity, measured: Velocity, free: bool, dt_s: float) -> Velocity:
        self.parameters = (1.0,)
        return desired._replace(u=0.5 * desired.u + 0.1)


def test_a_compensation_that_breaks_properties_is_caught() -> None:
    assert set(failures(conformance.compensation(Learns, Compensation(), PIONEER))) == {
        "shows finite parameters, always as many",
        "stays at rest",
        "the drive follows a constant speed no worse than without",
    }


class Skewed(Differential):
    def __init__(self, model: RobotModel, control_point_m: float) -> None:
        super().__init__(control_point_m)

    def inverse(self, psi: float, vx: float, vy: float, turn: float) -> Velocity:
        return super().inverse(psi + 0.1, vx, vy, turn)


class Elsewhere(Skewed):
    inverse = Differential.inverse

    def point(self, pose: Any) -> tuple[float, float]:
        return pose.x, pose.y


def test_kinematics_that_break_a_property_are_caught() -> None:
    assert set(failures(conformance.kinematics(Skewed, PIONEER, 0.2))) == {
        "inverse undoes forward where the robot can go"
    }
    assert set(failures(conformance.kinematics(Elsewhere, PIONEER, 0.2))) == {
        "forward is how point moves",
        "point is where the scenario has it, straight ahead",
    }


def test_a_car_is_only_asked_for_what_it_can_do() -> None:
    car = robot_models()["f1tenth"]
    found = conformance.kinematics(BUILTIN.kinematics[""], replace(car, steer_max_rad=0.1), 0.3)
    assert failures(found) == {}
