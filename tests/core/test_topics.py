from collections.abc import Callable

import pytest

from maniple.core import messages, topics
from maniple.core.errors import MessageError
from maniple.core.topics import TOPICS, may_send, sender_of, senders_of, topic

NAMED: dict[Callable[[str], str], type[messages.Message]] = {
    topics.odometry: messages.Odometry,
    topics.ranges: messages.Scan,
    topics.status: messages.Status,
    topics.command: messages.Command,
    topics.drive: messages.Drive,
    topics.motion: messages.Motion,
    topics.scan: messages.Scan,
    topics.external_pose: messages.ExternalPose,
    topics.simulated_drive: messages.Drive,
    topics.simulated_motion: messages.Motion,
    topics.simulated_scan: messages.Scan,
    topics.journal: messages.Journal,
    topics.links: messages.LinkReports,
}


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.pattern)
def test_every_row_is_found_by_its_names_and_only_once(row: topics.Topic) -> None:
    assert topic(row.pattern.replace("{id}", "r7")) is row
    assert [other.pattern for other in TOPICS].count(row.pattern) == 1


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.pattern)
def test_rows_make_sense(row: topics.Topic) -> None:
    assert issubclass(row.type, messages.Message)
    assert row.rate_hz >= 0
    assert row.stale_after_s == 0 or row.stale_after_s * row.rate_hz >= 2, "one late message is not stale"
    assert not (row.faults and row.network != "fleet"), "faults are of the fleet network"
    assert not (row.network == "host" and row.recorded), "what a host makes is in its journal"


@pytest.mark.parametrize("named", NAMED, ids=lambda named: named.__name__)
def test_named_topics_are_in_the_table(named: Callable[[str], str]) -> None:
    assert topic(named("r1")).type is NAMED[named]


def test_every_pattern_with_an_id_has_a_name() -> None:
    assert {topic(named("x")).pattern for named in NAMED} == {
        row.pattern for row in TOPICS if "{id}" in row.pattern
    }


@pytest.mark.parametrize(
    "constant",
    [
        topics.HOST_ALIVE,
        topics.HOST_REFUSED,
        topics.HOST_COUNTERS,
        topics.DECISIONS,
        topics.FORMATION_STATE,
        topics.TRUTH,
    ],
)
def test_constants_are_in_the_table(constant: str) -> None:
    assert topic(constant).pattern == constant


@pytest.mark.parametrize(
    "name", ["", "robot", "robot//odometry", "robot/r1/odometry/x", "robot/r1/nothing", "/"]
)
def test_other_names_are_refused_with_the_known_ones(name: str) -> None:
    with pytest.raises(MessageError, match=r"robot/\{id\}/odometry"):
        topic(name)


def test_who_may_send() -> None:
    assert sender_of(topics.odometry("r1")) == "r1"
    assert sender_of(topics.command("r1")) == "controller"
    assert sender_of(topics.TRUTH) == "simulator"
    assert senders_of(topics.motion("r1")) == ("simulator", "r1-driver")
    assert senders_of(topics.scan("r1")) == ("simulator", "r1-driver", "r1-scanner")
    assert sender_of(topics.scan("r1")) == "", "one of several"
    assert may_send(topics.motion("r1"), "r1-driver")
    assert not may_send(topics.motion("r1"), "r2-driver")
    assert may_send(topics.external_pose("r1"), "cameras"), "anybody"
    assert senders_of(topics.simulated_drive("r1")) == ("r1-vehicle",)
    assert (
        senders_of(topics.simulated_motion("r1")) == senders_of(topics.simulated_scan("r1")) == ("simulator",)
    )
    assert sender_of(topics.DECISIONS) == "", "any receiver"


def test_commands_go_first_and_late_joiners_get_what_is_latched() -> None:
    assert topic(topics.command("r1")).priority == topic(topics.drive("r1")).priority == "commands"
    assert {row.pattern for row in TOPICS if row.latched} == {
        "robot/{id}/odometry",
        "formation/state",
        "formation/mission",
        "formation/goal",
        "platoon/stop",
        "faults/plan",
    }
