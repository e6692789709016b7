import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from maniple.control import avoidance, unicycle
from maniple.control.builtin import BUILTIN
from maniple.control.limits import Velocity
from maniple.control.parts import Parts
from maniple.control.pipeline import Pipeline
from maniple.control.returns import Returns
from maniple.core.errors import ScenarioError
from maniple.core.layers import PIPELINE, Layer, central_layers, onboard_layers
from maniple.core.scenario.types import Avoidance, Compensation, Formation, Line, Robot, Scenario
from tests.pioneer import PIONEER

SEEN = Returns(np.array([0.5]), np.array([-0.5]), True, False)
ROBOT = Robot(id="r1", control_point_m=0.3, pose=(0.0, 0.0, 0.0))
STANDING = Velocity()


def scenario(**changes: Any) -> Scenario:
    return Scenario(
        name="test",
        robots=(ROBOT,),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
        models={"pioneer-3dx": PIONEER},
        **changes,
    )


def pipeline(layers: Sequence[Layer], parts: Parts = BUILTIN, **changes: Any) -> Pipeline:
    return Pipeline(layers, scenario(**changes), ROBOT, parts)


@pytest.mark.parametrize("cut", PIPELINE)
def test_the_place_of_the_cut_does_not_change_what_comes_out(cut: Layer) -> None:
    law = Compensation(enabled=True)
    whole = pipeline(PIPELINE, compensation=law)
    centre = pipeline(central_layers(cut), compensation=law)
    robot = pipeline(onboard_layers(cut), compensation=law)
    for k in range(20):
        values, psi, seen = (0.1, 0.02 * k, 0.0), 0.1 * k, SEEN if k > 5 else None
        measured = Velocity(0.01 * k, 0.1)
        expected = whole.step(values, psi, seen, measured, 0.1)
        between = centre.step(values, psi, seen, measured, 0.1)
        assert robot.step(between, psi, seen, measured, 0.1) == expected
    assert centre.compensation + robot.compensation == whole.compensation


def test_kinematics_steers_the_control_point() -> None:
    u, w, v = pipeline(["kinematics"]).step((0.1, -0.2, 0.0), 0.7, None, STANDING, 0.1)
    assert unicycle.forward(0.7, 0.3, u, w) == pytest.approx((0.1, -0.2))
    assert v == 0.0


def test_avoidance_subtracts_and_adds_its_corrections() -> None:
    layers = pipeline(["avoidance"])
    sides = avoidance.forces(Avoidance(), SEEN)
    state = avoidance.step(Avoidance(), avoidance.step(Avoidance(), avoidance.REST, sides, 0.1), sides, 0.05)
    layers.step((0.2, 0.1, 0.0), 0.0, SEEN, STANDING, 0.1)
    told = layers.step((0.2, 0.1, 0.0), 0.0, SEEN, STANDING, 0.05)
    assert told == (0.2 - state.u_cor, 0.1 + state.w_cor, 0.0)
    assert state.u_cor > 0.0
    assert state.w_cor > 0.0  # an obstacle on the right turns it left


def test_corrections_fade_when_nothing_is_known_any_more() -> None:
    layers = pipeline(["avoidance"])
    for _ in range(30):
        layers.step((0.2, 0.0, 0.0), 0.0, SEEN, STANDING, 0.1)
    for _ in range(300):
        told = layers.step((0.2, 0.0, 0.0), 0.0, None, STANDING, 0.1)
    assert told == pytest.approx((0.2, 0.0, 0.0), abs=1e-4)


def test_layers_left_out_pass_values_on() -> None:
    for layers in (
        pipeline(()),
        pipeline(["avoidance"], avoidance=Avoidance(enabled=False)),
        pipeline(["compensation", "drive"]),
    ):
        assert layers.step((0.2, 0.1, 0.3), math.pi, SEEN, STANDING, 0.1) == (0.2, 0.1, 0.3)
        assert layers.compensation == ()


def test_compensation_comes_last_and_shows_what_it_learns() -> None:
    layers = pipeline(["avoidance", "compensation"], compensation=Compensation(enabled=True))
    assert layers.compensation == PIONEER.theta
    told = layers.step((0.3, 0.0, 0.0), 0.0, None, Velocity(0.2, 0.0), 0.1)
    assert told.u > 0.3
    for _ in range(10):
        layers.step((0.3, 0.0, 0.0), 0.0, None, Velocity(0.2, 0.0), 0.1, free=False)
    assert layers.compensation == PIONEER.theta
    for _ in range(10):
        layers.step((0.3, 0.0, 0.0), 0.0, None, Velocity(0.2, 0.0), 0.1)
    assert layers.compensation != PIONEER.theta


class Slow:
    """A user's avoidance."""

    def __init__(self, parameters: Avoidance, model: object) -> None:
        self.share = parameters.options["share"]

    def step(self, wanted: Velocity, returns: Returns | None, dt_s: float) -> Any:
        if returns is None:
            return wanted
        return self.share(wanted) if callable(self.share) else wanted._replace(u=self.share * wanted.u)


USERS = BUILTIN._replace(avoidance={**BUILTIN.avoidance, "slow": Slow})


def slow(share: object) -> Pipeline:
    return pipeline(["avoidance"], USERS, avoidance=Avoidance(law="slow", options={"share": share}))


def test_a_users_layer_takes_the_place_of_ours() -> None:
    layers = slow(0.5)
    assert layers.step((0.2, 0.1, 0.0), 0.0, SEEN, STANDING, 0.1) == (0.1, 0.1, 0.0)


def _raise(_: Velocity) -> None:
    raise ZeroDivisionError("of mine")


@pytest.mark.parametrize(
    ("gives", "why"),
    [
        (_raise, "ZeroDivisionError: of mine"),
        (lambda wanted: wanted._replace(w=math.nan), "w = nan"),
        (lambda wanted: (wanted.u, math.inf, 0.0), "w = inf"),
        (lambda wanted: wanted[:2], "must be three numbers"),
        (lambda _: None, "must be three numbers"),
        (lambda _: ("fast", 0.0, 0.0), "must be three numbers"),
    ],
)
def test_a_layer_that_fails_ends_in_a_stand_with_a_reason(gives: object, why: str) -> None:
    layers = slow(gives)
    assert layers.step((0.2, 0.1, 0.0), 0.0, None, STANDING, 0.1) == (0.2, 0.1, 0.0)
    assert layers.fault == ""
    assert layers.step((0.2, 0.1, 0.0), 0.0, SEEN, STANDING, 0.1) == STANDING
    assert layers.fault.startswith("avoidance failed: ")
    assert why in layers.fault
    assert layers.step((0.2, 0.1, 0.0), 0.0, None, STANDING, 0.1) == STANDING, "for good"


class Learning:
    """A user's compensation, which shows `counts` one after the other."""

    def __init__(self, counts: Sequence[Any]) -> None:
        self.counts = list(counts)

    @property
    def parameters(self) -> Any:
        return self.counts.pop(0)

    def step(self, desired: Velocity, *_: object) -> Velocity:
        return desired


def learning(*counts: Any) -> Pipeline:
    users = BUILTIN._replace(compensation={"mine": lambda *_: Learning(counts)})
    return pipeline(["compensation"], users, compensation=Compensation(enabled=True, law="mine"))


def test_what_a_users_compensation_learns_is_plain_numbers_or_a_fault() -> None:
    layers = learning([3], np.array([1, 2]), ["much"], "shown")
    assert layers.compensation == (3.0,)
    assert layers.step((0.2, 0.1, 0.0), 0.0, None, STANDING, 0.1) == (0.2, 0.1, 0.0)
    assert list(map(repr, layers.compensation)) == ["1.0", "2.0"]
    assert layers.step((0.2, 0.1, 0.0), 0.0, None, STANDING, 0.1) == STANDING
    assert layers.fault.startswith("compensation failed: ValueError: has the parameters 'shown'")
    assert not layers.compensation
    with pytest.raises(ScenarioError, match=r"compensation: .*IndexError"):
        learning()


def test_numbers_of_any_kind_are_taken() -> None:
    told = slow(lambda _: np.array([1, 2, 3])).step((0.2, 0.1, 0.0), 0.0, SEEN, STANDING, 0.1)
    assert told == (1.0, 2.0, 3.0)
    assert all(type(number) is float for number in told)


def test_a_layer_that_is_not_there_is_named_with_those_that_are() -> None:
    with pytest.raises(
        ScenarioError, match=r"avoidance.law = 'fast': not installed; there are impedance, slow"
    ):
        pipeline(["avoidance"], USERS, avoidance=Avoidance(law="fast"))
    with pytest.raises(ScenarioError, match=r"compensation.law = 'none': not installed; there are adaptive"):
        pipeline(["compensation"], compensation=Compensation(enabled=True, law="none"))
    scene = replace(scenario(), models={"pioneer-3dx": replace(PIONEER, kinematics="crab")})
    with pytest.raises(ScenarioError, match=r"kinematics = .crab.: not installed; there are none"):
        Pipeline(["kinematics"], scene, ROBOT)


def test_a_layer_that_can_not_use_its_options_says_so() -> None:
    with pytest.raises(ScenarioError, match=r"avoidance: .*KeyError: 'share'"):
        pipeline(["avoidance"], USERS, avoidance=Avoidance(law="slow"))
    with pytest.raises(ScenarioError, match=r"avoidance: .*options share: it takes none"):
        pipeline(["avoidance"], avoidance=Avoidance(options={"share": 1}))
