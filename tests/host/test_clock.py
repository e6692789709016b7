"""Scenario time from the monotonic clock."""

import pytest

from maniple.core.time import SECOND
from maniple.host.clock import Anchor


def test_time_passes_speed_times_as_fast() -> None:
    anchor = Anchor(epoch_ns=100, monotonic_ns=7, speed=3.0)
    assert anchor.at(7) == 100
    assert anchor.at(7 + SECOND) == 100 + 3 * SECOND
    assert anchor.wall_seconds(3 * SECOND) == 1.0


def test_text_and_back() -> None:
    anchor = Anchor(1_700_000_000_123_456_789, 987_654_321, 0.1)
    assert Anchor.parse(str(anchor)) == anchor


@pytest.mark.parametrize("text", ["", "1:2", "1:2:x", "1.5:2:3", "1:2:0", "1:2:nan", "1:2:-1", "1:2:inf"])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - the command line says what is valid
        Anchor.parse(text)


def test_here_runs_with_the_wall_clock() -> None:
    anchor = Anchor.here(speed=2.0)
    first = anchor.now()
    assert anchor.epoch_ns <= first <= anchor.now()
