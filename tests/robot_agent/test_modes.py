from itertools import product
from typing import get_args

import pytest

from maniple.core.messages import Mode
from robot_agent.modes import MOVES, TRANSITIONS, WANTS_DRIVER, Event

MODES = get_args(Mode)
EVENTS = get_args(Event)

EXPECTED = {
    # event:          waiting    tracking    holding    emergency    stopped    fault
    "contrary": ("fault", "fault", "fault", "emergency", "stopped", "fault"),
    "layer_failed": ("fault", "fault", "fault", "emergency", "stopped", "fault"),
    "driver_lost": ("waiting", "fault", "fault", "emergency", "stopped", "fault"),
    "driver_ready": ("waiting", "waiting", "waiting", "emergency", "stopped", "waiting"),
    "driver_active": ("waiting", "tracking", "holding", "emergency", "stopped", "waiting"),
    "blind": ("waiting", "holding", "holding", "emergency", "stopped", "fault"),
    "fresh": ("tracking", "tracking", "tracking", "emergency", "stopped", "fault"),
    "aging": ("holding", "holding", "holding", "emergency", "stopped", "fault"),
    "old": ("waiting", "holding", "holding", "emergency", "stopped", "fault"),
    "emergency": ("emergency", "emergency", "emergency", "emergency", "stopped", "emergency"),
    "armed": ("waiting", "tracking", "holding", "waiting", "stopped", "fault"),
    "displaced": ("waiting", "waiting", "waiting", "emergency", "stopped", "fault"),
    "stop": ("stopped", "stopped", "stopped", "stopped", "stopped", "stopped"),
}


def test_the_table_is_total() -> None:
    assert set(TRANSITIONS) == set(product(MODES, EVENTS))
    assert set(MOVES) == set(WANTS_DRIVER) == set(MODES)


@pytest.mark.parametrize(("mode", "event"), list(product(MODES, EVENTS)))
def test_transition(mode: Mode, event: Event) -> None:
    assert TRANSITIONS[mode, event] == EXPECTED[event][MODES.index(mode)]


def test_a_lost_driver_or_a_stop_never_leaves_a_robot_moving() -> None:
    for mode in MODES:
        assert not MOVES[TRANSITIONS[mode, "contrary"]]
        assert not MOVES[TRANSITIONS[mode, "layer_failed"]]
        assert not MOVES[TRANSITIONS[mode, "driver_lost"]]
        assert not MOVES[TRANSITIONS[mode, "driver_ready"]]
        assert not MOVES[TRANSITIONS[mode, "stop"]]
        assert not MOVES[TRANSITIONS[mode, "displaced"]]
        assert not MOVES[TRANSITIONS[mode, "emergency"]]


def test_only_an_operator_or_the_end_ends_an_emergency() -> None:
    for event in EVENTS:
        after = TRANSITIONS["emergency", event]
        assert (after == "emergency") == (event not in ("armed", "stop"))
        assert not MOVES[after]


def test_only_a_command_that_is_not_old_sets_a_robot_moving() -> None:
    for (mode, event), after in TRANSITIONS.items():
        if MOVES[after] and not MOVES[mode]:
            assert event in ("fresh", "aging")
