"""Who is heard, how often, and what no robot can have done."""

import math

import pytest

from maniple.core.geometry import Pose
from maniple.core.time import MILLISECOND, SECOND
from robot_agent.drivers.interface import Capabilities
from robot_agent.drivers.ros2.source import STALE, Pacer, Source, has_jumped

ABLE = Capabilities(0.5, 1.0, True, True, 20.0, 10.0, "r2")


def test_a_source_is_fresh_for_half_a_second() -> None:
    source = Source()
    assert source.age(5) is None
    assert not source.is_fresh(0)
    assert source.hear(b"a", SECOND) == "taken"
    assert source.age(SECOND + 3) == 3
    assert source.is_fresh(SECOND + STALE)
    assert not source.is_fresh(SECOND + STALE + 1)


def test_the_first_is_listened_to_and_another_beside_it_disputes_that() -> None:
    source = Source()
    source.hear(b"a", 0)
    assert source.hear(b"b", 1) == "second"
    assert source.is_disputed(1 + STALE)
    assert not source.is_disputed(2 + STALE)
    assert source.hear(b"a", 100 * MILLISECOND) == "taken"


def test_another_takes_over_once_the_first_is_silent() -> None:
    source = Source()
    source.hear(b"a", 0)
    assert source.hear(b"b", STALE + 1) == "anew"
    assert source.hear(b"a", STALE + 2) == "second"


def test_where_nobody_says_who_is_who_all_are_one() -> None:
    source = Source()
    assert [source.hear(b"", moment) for moment in (0, 1, 10 * SECOND)] == ["taken"] * 3


@pytest.mark.parametrize("rate", [5.0, 20.0, 50.0])
def test_the_rate_is_known_after_eleven_and_forgotten_after_a_pause(rate: float) -> None:
    source = Source()
    for number in range(11):
        assert source.rate_hz() == 0.0
        source.hear(b"", round(number * SECOND / rate))
    assert source.rate_hz() == pytest.approx(rate)
    source.hear(b"", 20 * SECOND)
    assert source.rate_hz() == 0.0


@pytest.mark.parametrize(
    ("rate", "passed"), [(10.0, 10.0), (20.0, 20.0), (30.0, 15.0), (50.0, 25.0), (200.0, 25.0)]
)
def test_no_more_passes_than_was_promised_within_a_quarter(rate: float, passed: float) -> None:
    pacer = Pacer(20.0)
    count = sum(pacer.lets_pass(round(number * SECOND / rate)) for number in range(round(10 * rate)))
    assert count / 10 == pytest.approx(passed, rel=0.1)


def test_what_the_robot_can_drive_is_no_jump() -> None:
    start = Pose(1.0, 1.0, 3.0)
    assert not has_jumped(start, start.advance(0.5, 1.0), SECOND, ABLE)
    assert not has_jumped(start, Pose(1.05, 1.0, -3.2), 0, ABLE)
    assert not has_jumped(start, Pose(1.0, 1.0, 3.0 - 2 * math.pi), 0, ABLE)


@pytest.mark.parametrize("there", [Pose(0.0, 0.0, 0.0), Pose(1.0, 1.4, 3.0), Pose(1.0, 1.0, 1.0)])
def test_what_it_can_not_drive_is_one(there: Pose) -> None:
    assert has_jumped(Pose(1.0, 1.0, 3.0), there, 50 * MILLISECOND, ABLE)
