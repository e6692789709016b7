from typing import Any

import pytest

from maniple.core.layers import Layer
from maniple.core.messages import Command, Stamp
from maniple.core.time import SECOND
from robot_agent.orders import Orders

NOW = 100 * SECOND


def command(
    layer: Layer = "drive",
    incarnation: int = 2,
    answered: int = NOW,
    inputs_age: int = 0,
    **fields: Any,
) -> Command:
    given: dict[str, Any] = {
        "source": "controller",
        "incarnation": 7,
        "seq": 3,
        "stamp_ns": 11,
        "layer": layer,
        "values": (0.1, 0.0),
        "answers": Stamp(incarnation, 5, answered),
        "inputs_age_ns": inputs_age,
    }
    return Command(**(given | fields))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (command(layer="kinematics"), "layer"),
        (command(incarnation=1), "incarnation"),
        (command(incarnation=3), "incarnation"),
        (command(answered=NOW + 1), "future"),
        (command(answered=NOW - 2 * SECOND - 1), "earlier"),
        (command(inputs_age=-1), "absurd"),
        (command(values=(1e30, 0.0)), "absurd"),
        (command(values=(0.0, -1e30)), "absurd"),
        (command(third=1000.1), "absurd"),
        (command(stop_after_s=-1.0), "absurd"),
    ],
)
def test_what_it_does_not_take(given: Command, why: str) -> None:
    orders = Orders("drive", 2)
    orders.begin(NOW - 2 * SECOND)
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


def test_what_was_held_is_dropped_when_it_begins_anew() -> None:
    orders = Orders("drive", 2)
    assert orders.take(command(), NOW) is None
    orders.begin(NOW + 1)
    assert orders.command is None
    assert orders.age_s(NOW + 2) == -1.0
    assert orders.take(command(), NOW + 2) == "earlier"
    assert orders.take(command(answered=NOW + 1), NOW + 2) is None


def test_ages_that_no_clock_has_only_make_a_command_old() -> None:
    orders = Orders("drive", 2)
    assert orders.take(command(inputs_age=2**63), NOW) is None
    assert orders.age_s(NOW) > 1e9
    assert orders.take(command(answered=-(2**63)), NOW) == "earlier"
