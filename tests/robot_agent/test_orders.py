import pytest

from maniple.core.layers import Layer
from maniple.core.messages import Command, Stamp
from maniple.core.time import SECOND
from robot_agent.orders import Orders

NOW = 100 * SECOND


def command(
    layer: Layer = "drive", incarnation: int = 2, answered: int = NOW, inputs_age: int = 0
) -> Command:
    return Command(
        source="controller",
        incarnation=7,
        seq=3,
        stamp_ns=11,
        layer=layer,
        values=(0.1, 0.0),
        answers=Stamp(incarnation, 5, answered),
        inputs_age_ns=inputs_age,
    )


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (command(layer="kinematics"), "layer"),
        (command(incarnation=1), "incarnation"),
        (command(incarnation=3), "incarnation"),
        (command(answered=NOW + 1), "future"),
    ],
)
def test_what_it_does_not_take(given: Command, why: str) -> None:
    orders = Orders("drive", 2)
    good = command()
    assert orders.take(good, NOW) is None
    assert orders.take(given, NOW) == why
    assert orders.command is good


def test_age_counts_from_the_odometry_that_is_answered() -> None:
    orders = Orders("drive", 2)
    assert orders.age_s(NOW) == -1.0
    orders.take(command(answered=NOW - SECOND // 4), NOW)
    assert orders.age_s(NOW) == 0.25
    assert orders.age_s(NOW + SECOND) == 1.25
    assert orders.stamp() == Stamp(7, 3, 11)


def test_an_older_input_of_the_controller_makes_it_older() -> None:
    orders = Orders("drive", 2)
    orders.take(command(answered=NOW - SECOND // 4, inputs_age=SECOND), NOW)
    assert orders.age_s(NOW + SECOND) == 2.0
