from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from central_controller import formation
from central_controller.chain import Chain
from central_controller.formation import Gains
from central_controller.watched import WatchedLaw, WatchedPlanner
from maniple.control.builtin import BUILTIN
from maniple.core.errors import ScenarioError
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Controller, Planning

CHAIN = Chain([(1.0, 0.0), (0.0, 0.8), (0.0, -0.8), (-1.0, 0.8)])
POINTS = np.array([(1.1, 0.1), (0.2, 0.8), (0.0, -0.7), (-1.2, 0.9)])
DESIRED = CHAIN.desired(Pose(0.3, 0.0, 0.1), (0.1, 0.0, 0.05))


class Law:
    def __init__(self, parameters: Controller) -> None:
        self.give = parameters.options["give"]

    def rates(self, desired_rates: Floats, errors: Floats, dt_s: float) -> Any:
        return self.give(desired_rates, errors, dt_s)


def watched(give: Any) -> WatchedLaw:
    parts = BUILTIN._replace(formation_laws={"mine": Law})
    return WatchedLaw(Controller(law="mine", options={"give": give}), parts)


def test_the_law_of_the_paper_is_the_default() -> None:
    law = WatchedLaw(Controller(), BUILTIN)
    found = law.step(CHAIN, POINTS, DESIRED, 0.1)
    expected = formation.step(CHAIN, Gains.of(Controller()), POINTS, DESIRED)
    assert np.array_equal(found.velocities, expected.velocities)
    assert np.array_equal(found.errors, expected.errors)
    assert law.fault == ""


def test_a_users_law_is_asked_with_the_time_since_the_step_before() -> None:
    law = watched(lambda desired, errors, dt_s: (desired + errors * dt_s).tolist())
    found = law.step(CHAIN, POINTS, DESIRED, 0.25)
    gains = type("Quarter", (), {"rates": lambda self, desired, errors, dt_s: desired + 0.25 * errors})()
    assert np.array_equal(found.velocities, formation.step(CHAIN, gains, POINTS, DESIRED).velocities)


def _raise(*_: object) -> None:
    raise ZeroDivisionError("mine")


@pytest.mark.parametrize(
    ("give", "why"),
    [
        (_raise, "ZeroDivisionError: mine"),
        (lambda desired, errors, dt_s: errors[:1], r"shape \(1, 6\); must be \(2, 6\)"),
        (lambda desired, errors, dt_s: errors * np.inf, "not finite"),
        (lambda desired, errors, dt_s: None, "TypeError|ValueError"),
        (lambda desired, errors, dt_s: "fast", "ValueError"),
    ],
)
def test_a_law_that_fails_gives_zero_from_then_on(give: Any, why: str) -> None:
    law = watched(give)
    found = law.step(CHAIN, POINTS, DESIRED, 0.1)
    assert not found.velocities.any()
    assert found.errors.any(), "the errors are known all the same"
    assert law.fault.startswith("the formation law failed: ")
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(law.fault)
    assert not law.step(CHAIN, POINTS, DESIRED, 0.1).velocities.any()


def test_a_law_can_not_write_to_what_it_is_given() -> None:
    def overwrite(desired: Floats, errors: Floats, dt_s: float) -> Floats:
        errors[:] = 7.0
        return desired

    found = watched(overwrite).step(CHAIN, POINTS, DESIRED, 0.1)
    assert not (found.errors == 7.0).any()


def planner(give: Any) -> WatchedPlanner:
    return WatchedPlanner(Planning(method="mine"), BUILTIN._replace(planners={"mine": give}))


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ([0, 1, 1], "must be every index below 3 once"),
        ([0, 1], "must be every index below 3 once"),
        ([0, 1, 3], "must be every index below 3 once"),
        (["a", "b", "c"], "ValueError"),
        (None, "TypeError"),
    ],
)
def test_a_planner_that_gives_no_order_leaves_the_one_there_is(order: Any, why: str) -> None:
    orders: list[Any] = [order, [2, 0, 1]]
    plan = planner(lambda positions, places: orders.pop(0))
    points = np.zeros((3, 2))
    assert list(plan(points, points)) == [0, 1, 2]
    assert why in plan.fault
    assert list(plan(points, points)) == [2, 0, 1]
    assert plan.fault == "", "the next plan counts"


def test_a_planner_may_give_numbers_of_any_kind() -> None:
    def by_x(positions: Floats, places: Floats) -> Sequence[int]:
        order: Sequence[int] = positions[:, 0].argsort()  # type: ignore[assignment]
        return order

    found = planner(by_x)(np.array([[2.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), np.zeros((3, 2)))
    assert list(found) == [1, 2, 0]
    assert all(type(index) is int for index in found)


def test_what_is_not_there_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"controller.law = 'x': not installed; there are paper"):
        WatchedLaw(Controller(law="x"), BUILTIN)
    with pytest.raises(ScenarioError, match=r"planning.method = 'x': not installed; there are final-"):
        WatchedPlanner(Planning(method="x"), BUILTIN)
    with pytest.raises(ScenarioError, match=r"controller: .* options k: it takes none"):
        WatchedLaw(Controller(options={"k": 1}), BUILTIN)
