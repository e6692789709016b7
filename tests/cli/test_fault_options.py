"""Rules that would do nothing, and problems in terms of options."""

from typing import Any

import pytest

from maniple.cli.fault_options import Link, by_option, effect_problem, link_problem, links, parsed
from maniple.cli.scenario_report import fleet_links
from maniple.core.errors import ArgumentError
from maniple.core.presets import PRESETS, with_preset
from maniple.core.scenario.types import Burst, Fault
from tests.cli.scenes import platoon

ROBOTS = ("r1", "r2", "r3")
WAYS = (
    "valid: a robot to controller on robot/ID/odometry, robot/ID/ranges, robot/ID/status; "
    "controller to a robot on robot/ID/command; controller to observers on formation/state, "
    "formation/mission; operator to controller on formation/goal"
)


def test_links_are_those_of_a_scenario_and_those_of_operators_and_observers() -> None:
    found = set(links(ROBOTS))
    assert {Link(*link) for link in fleet_links(platoon(3))} < found
    assert len(found) == 4 * 3 + 3
    assert Link("operator", "controller", "formation/goal") in found


@pytest.mark.parametrize(
    "link",
    [
        {},
        {"source": "r1"},
        {"destination": "r*"},
        {"source": "controller", "destination": "r2"},
        {"source": "r?", "destination": "controller", "topic": "robot/*/odometry"},
        {"topic": "robot/r2/command"},
        {"source": "operator"},
        {"source": "operator", "topic": "formation/*"},
        {"topic": "formation/state"},
        {"source": "controller", "destination": "r1", "topic": "formation/mission"},
    ],
)
def test_a_rule_that_matches_a_link_is_fine(link: dict[str, Any]) -> None:
    assert link_problem(Fault(loss=0.1, **link), ROBOTS) == ""


@pytest.mark.parametrize(
    ("link", "said"),
    [
        ({"source": "r1", "destination": "r2"}, "--from r1 --to r2"),
        ({"source": "r1", "topic": "robot/r2/odometry"}, "--from r1 --topic robot/r2/odometry"),
        ({"destination": "controller", "topic": "robot/*/command"}, None),
        ({"source": "controller", "destination": "controller"}, None),
        ({"source": "operator", "destination": "r1"}, None),
        ({"source": "r1", "topic": "formation/state"}, None),
    ],
)
def test_a_rule_for_where_nothing_goes_is_told_what_does(link: dict[str, Any], said: str | None) -> None:
    found = link_problem(Fault(loss=0.1, **link), ROBOTS)
    assert found.endswith(f": no message goes that way; {WAYS}")
    assert said is None or found.startswith(said + ":")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"reorder_s": 0.3}, "--reorder-by: says for how long, not how many; give --reorder too"),
        ({"reorder_s": 0.3, "loss": 0.1}, "--reorder-by: "),
        ({"queue_s": 2.0}, "--queue: is for what comes faster than a rate; give --rate-kbps too"),
        ({"loss": 0.0, "latency_s": 0.0}, "--loss, --latency: nothing is injected with that; give a number"),
        ({"burst": {"enter": 0.0, "leave": 0.5}}, "--burst-enter, --burst-leave: nothing is injected"),
        ({"burst": {"enter": 0.5, "leave": 0.5, "loss_bad": 0.0}}, "--burst-enter, --burst-leave, --burst-l"),
    ],
)
def test_a_rule_that_injects_nothing_is_told_what_it_lacks(given: dict[str, Any], said: str) -> None:
    assert effect_problem(parsed(Fault, given), given).startswith(said)


@pytest.mark.parametrize(
    "given",
    [
        *({"preset": name} for name in PRESETS),
        {"preset": "wifi-good", "reorder_s": 0.3},
        {"preset": "lte", "queue_s": 0.3},
        {"reorder": 0.1, "reorder_s": 0.3},
        {"rate_kbps": 10.0, "queue_s": 0.3},
        {"jitter_s": 0.1},
        {"burst": {"enter": 0.0, "leave": 0.5, "loss_good": 0.1}},
    ],
)
def test_a_rule_that_injects_something_is_fine(given: dict[str, Any]) -> None:
    assert effect_problem(with_preset(parsed(Fault, given)), given) == ""


def test_problems_name_options() -> None:
    assert by_option("faults[3].source = 'r9': matches nothing") == "--from = 'r9': matches nothing"
    assert by_option("faults[0].windows[1] = [2, 1]: is empty") == "--window = [2, 1]: is empty"
    assert by_option("partitions[0].groups: missing") == "partitions[0].groups: missing"
    assert by_option("no robot is known there yet") == "no robot is known there yet"
    wrong = {"loss": 2.0, "rate_kbps": -1.0, "reorder_s": -1.0, "burst": {"leave": 0.5, "loss_bad": 3.0}}
    with pytest.raises(ArgumentError) as caught:
        parsed(Fault, wrong)
    names = [line.split(maxsplit=1)[0].rstrip(":") for line in str(caught.value).splitlines()]
    assert sorted(names) == ["--burst-enter", "--burst-loss-bad", "--loss", "--rate-kbps", "--reorder-by"]
    assert parsed(Fault, {"burst": {"enter": 0, "leave": 1}}).burst == Burst(enter=0.0, leave=1.0)
