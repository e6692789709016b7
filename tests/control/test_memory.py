"""A pipeline that goes on with the memory of another gives what that one would have."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from maniple.control.avoidance import Impedances
from maniple.control.builtin import BUILTIN
from maniple.control.compensation import Adaptive, bounds
from maniple.control.kinematics import Car
from maniple.control.limits import Velocity
from maniple.control.memory import recall, remembered
from maniple.control.pipeline import Pipeline
from maniple.control.returns import Returns, returns_of
from maniple.core.layers import PIPELINE
from maniple.core.messages import Scan, pack_floats
from maniple.core.scenario.types import (
    Avoidance,
    Compensation,
    Formation,
    Line,
    Robot,
    RobotModel,
    Scenario,
)
from tests.pioneer import PIONEER, SICK

OMNI = replace(PIONEER, drive="omnidirectional", v_max_mps=0.5)
CAR = replace(PIONEER, drive="car", wheelbase_m=0.4, steer_max_rad=0.5)


def scenario(model: RobotModel) -> Scenario:
    return Scenario(
        name="memory",
        robots=(Robot(id="r1", model="it", pose=(0.0, 0.0, 0.0)),),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
        compensation=Compensation(enabled=True),
        models={"it": model},
        sensors={"sick-lms200": SICK},
    )


def seen() -> Returns:
    ranges = np.full(181, 8.0)
    ranges[70:80] = 0.5
    return returns_of(
        Scan(
            first_angle_rad=-math.pi / 2,
            increment_rad=math.radians(1.0),
            range_min_m=0.1,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=pack_floats(ranges),
        )
    )


@pytest.mark.parametrize("model", [PIONEER, OMNI, CAR], ids=lambda model: model.drive)
def test_the_next_pipeline_goes_on_where_the_last_was(model: RobotModel) -> None:
    made = scenario(model)
    layers = [layer for layer in PIPELINE if layer != "drive"]
    old, new = (Pipeline(layers, made, made.robots[0]) for _ in range(2))
    around = seen()
    wanted = (-0.1, 0.02, 0.0)
    for k in range(30):
        old.step(wanted, 0.1, around, Velocity(0.05 * math.sin(k), 0.1), 0.1)
    assert old.memory
    assert new.memory == ()
    new.recall(old.memory, old.compensation)
    assert (new.memory, new.compensation) == (old.memory, old.compensation)
    measured = Velocity(0.02, 0.01)
    for dt_s in (0.0, 0.1, 0.1):
        told = [line.step(wanted, 0.1, around, measured, dt_s) for line in (old, new)]
        assert told[1] == pytest.approx(told[0], abs=0.02)
        assert sum(new.memory, ()) == pytest.approx(sum(old.memory, ()))


@pytest.mark.parametrize("memory", [((1.0,), (1.0, 2.0)), ((), ()), ((),), (), ((1.0, 2.0), ())])
def test_what_is_no_memory_of_these_layers_is_left(memory: tuple[tuple[float, ...], ...]) -> None:
    made = scenario(PIONEER)
    line = Pipeline(["kinematics", "avoidance", "compensation"], made, made.robots[0])
    line.recall(memory, (1.0, 2.0))
    assert line.memory == ()
    assert line.compensation == PIONEER.theta
    assert line.fault == ""


def test_a_layer_without_a_memory_has_none() -> None:
    recall(object(), (1.0,))
    assert remembered(object()) == ()


def test_a_memory_that_is_not_finite_ends_the_pipeline() -> None:
    class Odd(Impedances):
        memory = (math.nan,)

    made = replace(scenario(PIONEER), avoidance=Avoidance(law="odd"))
    parts = BUILTIN._replace(avoidance={"odd": Odd})
    line = Pipeline(["kinematics", "avoidance"], made, made.robots[0], parts)
    assert line.step((0.1, 0.0, 0.0), 0.0, None, Velocity(), 0.0) == Velocity()
    assert line.fault == "memory failed: ValueError: remembers (nan,); must be finite"


def test_a_car_in_reverse_stays_in_reverse() -> None:
    old, new = Car(0.2, 1.0), Car(0.2, 1.0)
    assert Car(0.2, 1.0).memory == ()
    old.inverse(0.0, -0.1, 0.0, 0.0)
    assert old.memory == (-1.0,)
    new.recall(old.memory)
    aside = (0.0, -0.001, 0.1, 0.0)
    assert new.inverse(*aside) == old.inverse(*aside)
    assert new.inverse(*aside) != Car(0.2, 1.0).inverse(*aside)
    new.recall(())
    assert new.memory == ()


def test_what_was_learnt_is_kept_within_its_bounds() -> None:
    law = Adaptive(Compensation(), PIONEER)
    law.recall(tuple(100.0 for _ in PIONEER.theta))
    assert law.parameters == tuple(high for _, high in bounds(PIONEER.theta))
    with pytest.raises(ValueError, match="zip"):
        law.recall((1.0,))
