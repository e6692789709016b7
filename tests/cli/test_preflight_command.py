"""`maniple preflight`, on robots and a controller played by sessions."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from central_controller.preflight import ITEMS, TESTED
from maniple.cli.operator import operator_session
from maniple.cli.program import app
from maniple.core import codec, topics
from maniple.core.errors import RunError
from maniple.core.messages import FormationState, Mission, Seat
from tests.cli.test_stop_command import Played, endpoint
from tests.cli.test_stop_trial import Spoken, checks, obeying, state
from tests.transport.test_zenoh import DEADLINE_S

__all__ = ["endpoint"]


def invoke(endpoint: str, *arguments: object) -> Result:
    return CliRunner().invoke(app, ["preflight", "--connect", endpoint, *map(str, arguments)])


def asked(endpoint: str, says: Callable[[], FormationState], *arguments: object) -> tuple[int, Any]:
    with Spoken(endpoint, says):
        found = invoke(endpoint, "--json", *arguments)
    return found.exit_code, json.loads(found.stdout)


def test_the_item_is_one_of_those_the_controller_looks_at() -> None:
    assert TESTED in ITEMS
    assert {check.item for check in checks()} <= set(ITEMS)


def test_everything_holds_and_the_platoon_begins(endpoint: str) -> None:
    one, two = Played(endpoint, "r1"), Played(endpoint, "r2")

    def says() -> FormationState:
        if any(not message.stopped for message in one.heard):
            return state(phase="running")
        return state(*checks(tested=False))

    with one.session, two.session, obeying(one, two):
        code, found = asked(endpoint, says)
    assert (code, found["ok"], found["asked"], found["begun"]) == (0, True, True, True)
    assert [(line["robot"], line["item"], line["state"]) for line in found["lines"]] == [
        ("r1", "there", "ok"),
        ("r1", "stop tested", "ok"),
        ("r2", "there", "ok"),
        ("r2", "stop tested", "ok"),
    ]
    assert found["estop"]["ok"]
    assert found["notice"] == "the platoon has begun: running"


def test_what_is_missing_is_listed_and_nothing_tested(endpoint: str) -> None:
    one = Played(endpoint, "r1")
    with one.session:
        code, found = asked(endpoint, lambda: state(*checks(there=False, tested=None)), "--wait", 0.3)
    assert (code, found["ok"], found["estop"], one.heard) == (1, False, None, [])
    assert [line["state"] for line in found["lines"]] == ["ok", "unknown", "missing", "unknown"]
    assert found["lines"][2]["why"] == "its there is missing"
    assert found["notice"] == "the emergency stop is tested once everything else holds"


def test_without_the_test_it_stays_missing(endpoint: str) -> None:
    one = Played(endpoint, "r1")
    with one.session:
        code, found = asked(endpoint, lambda: state(*checks(tested=False)), "--no-estop", "--wait", 0)
    assert (code, found["estop"], one.heard) == (1, None, [])


def test_of_a_platoon_that_has_begun_nothing_is_tested(endpoint: str) -> None:
    seats = tuple(Seat(name, place, 1, name, passed=1) for place, name in enumerate(("r1", "r2")))
    mission = Mission(source="controller", incarnation=1, number=1, stage="running", seats=seats)
    one = Played(endpoint, "r1")
    with operator_session(endpoint, "maniple", DEADLINE_S) as session, one.session:
        session.announce("controller", 1)
        session.put(topics.FORMATION_MISSION, codec.encode(mission))
        code, found = asked(endpoint, lambda: state(phase="running"))
        lost = checks(tested=False)[2:]
        with_lost, missing = asked(endpoint, lambda: state(*lost, phase="running"))
    assert (code, found["ok"], found["asked"], found["begun"], one.heard) == (0, True, True, True, [])
    assert found["notice"] == "the platoon has begun: running; its emergency stop is not tested now"
    assert (with_lost, missing["ok"], [line["robot"] for line in missing["lines"]]) == (
        1,
        False,
        ["r2", "r2"],
    )


def test_where_nothing_is_asked_it_says_so(endpoint: str) -> None:
    code, found = asked(endpoint, state)
    assert (code, found["asked"], found["lines"]) == (0, False, [])
    assert "preflight.enabled" in found["notice"]


def test_people_get_a_table(endpoint: str) -> None:
    with Spoken(endpoint, lambda: state(*checks(there=False, tested=False))):
        found = invoke(endpoint, "--wait", 0)
    assert found.exit_code == 1
    lines = [line.split() for line in found.stdout.splitlines()]
    assert lines[0] == ["robot", "item", "state", "why"]
    assert ["r2", "there", "missing", "its", "there", "is", "missing"] in lines
    assert found.stdout.splitlines()[-1] == f"3 of 4 do not hold ({endpoint})"


def test_without_a_controller_nobody_looks(endpoint: str) -> None:
    found = invoke(endpoint, "--timeout", 0.3)
    assert isinstance(found.exception, RunError)
    assert "no controller has said anything within 0.3 s" in str(found.exception)


@pytest.mark.parametrize("wrong", [("--wait", "-1"), ("--timeout", "0")])
def test_bad_options_are_refused(endpoint: str, wrong: tuple[str, str]) -> None:
    assert invoke(endpoint, *wrong).exit_code == 2
