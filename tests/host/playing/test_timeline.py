"""Time is told: these tests take none."""

import pytest

from maniple.core.time import MILLISECOND, SECOND
from maniple.host.playing.timeline import SLACK, Timeline

START = 1_000 * SECOND
NOW = 77 * SECOND


def at(rate: float | None = 1.0, paused: bool = False) -> Timeline:
    timeline = Timeline(rate, paused)
    timeline.begin(START, NOW)
    return timeline


@pytest.mark.parametrize("rate", [0.01, 0.5, 1.0, 20.0, 1000.0])
def test_a_message_is_due_when_its_time_has_passed_at_the_rate(rate: float) -> None:
    timeline = at(rate)
    assert timeline.wait(START, NOW) == 0
    assert timeline.wait(START + SECOND, NOW) == round(SECOND / rate)
    later = NOW + round(0.25 * SECOND / rate)
    assert timeline.wait(START + SECOND, later) == pytest.approx(0.75 * SECOND / rate, abs=2)
    assert timeline.position(later) == pytest.approx(START + SECOND // 4, abs=1000)


def test_as_fast_as_possible_is_always_due_and_is_where_the_last_message_was() -> None:
    timeline = at(None)
    assert timeline.wait(START + 9 * SECOND, NOW) == 0
    timeline.put(START + 9 * SECOND, NOW + 1)
    assert timeline.position(NOW + SECOND) == START + 9 * SECOND
    assert timeline.latest == timeline.slowed == 0


def test_what_is_a_little_late_is_made_up_for() -> None:
    timeline = at(2.0)
    timeline.put(START + SECOND, NOW + SECOND // 2 + SLACK)
    assert timeline.latest == SLACK
    assert timeline.slowed == 0
    assert timeline.wait(START + 2 * SECOND, NOW + SECOND) == 0


def test_what_is_later_slows_everything_that_follows_alike() -> None:
    timeline = at()
    now = NOW + 2 * SECOND
    timeline.put(START + SECOND, now)
    assert timeline.slowed == timeline.latest == SECOND
    assert [timeline.wait(START + n * SECOND, now) for n in (1, 2, 3)] == [0, SECOND, 2 * SECOND]


def test_a_play_that_can_never_keep_up_takes_as_long_as_its_puts() -> None:
    """Each put takes 3 ms, there is one every 1 ms."""
    timeline, now = at(), NOW
    for number in range(1, 1001):
        due = START + number * MILLISECOND
        wait = timeline.wait(due, now)
        assert wait is not None
        now += wait + 3 * MILLISECOND
        timeline.put(due, now)
        assert timeline.position(now) <= due + SLACK
    assert now - NOW == pytest.approx(3 * SECOND, rel=0.1)
    assert timeline.slowed == pytest.approx(2 * SECOND, abs=2 * SLACK)


def test_a_pause_holds_everything_and_counts_for_nothing() -> None:
    timeline = at(2.0)
    timeline.pause(NOW + SECOND)
    timeline.pause(NOW + 2 * SECOND)
    assert timeline.wait(START, NOW + 3 * SECOND) is None
    assert timeline.position(NOW + 9 * SECOND) == START + 2 * SECOND
    assert timeline.stood_until(NOW + 4 * SECOND) == 3 * SECOND
    timeline.resume(NOW + 11 * SECOND)
    timeline.resume(NOW + 12 * SECOND)
    assert timeline.stood == timeline.stood_until(NOW + 20 * SECOND) == 10 * SECOND
    assert timeline.position(NOW + 12 * SECOND) == START + 4 * SECOND
    assert timeline.wait(START + 6 * SECOND, NOW + 12 * SECOND) == SECOND


@pytest.mark.parametrize("rate", [1.0, None])
def test_steps_are_due_at_once_and_then_it_stands_again(rate: float | None) -> None:
    timeline = at(rate)
    timeline.step(2, NOW)
    for number in (3, 7):
        assert timeline.wait(START + number * SECOND, NOW) == 0
        timeline.put(START + number * SECOND, NOW)
    assert timeline.wait(START + 9 * SECOND, NOW) is None
    assert timeline.position(NOW + SECOND) == START + 7 * SECOND
    timeline.step(5, NOW)
    timeline.resume(NOW)
    timeline.pause(NOW)
    assert timeline.wait(START + 9 * SECOND, NOW) is None, "steps that were not made are forgotten"


def test_paused_from_the_start_and_over_the_end_of_a_round() -> None:
    timeline = at(paused=True)
    assert timeline.wait(START, NOW) is None
    timeline.begin(START, NOW + SECOND)
    timeline.resume(NOW + 5 * SECOND)
    assert timeline.stood == 5 * SECOND
    assert timeline.wait(START + SECOND, NOW + 5 * SECOND) == SECOND


@pytest.mark.parametrize(("rate", "speed"), [(20.0, 20.0), (None, 1.0)])
def test_the_clock_shows_the_time_of_the_recording(rate: float | None, speed: float) -> None:
    timeline = at(rate)
    timeline.put(START, NOW)
    clock = timeline.clock(NOW)
    assert clock.at(NOW) == START
    assert clock.speed == speed
