from typing import Any

import pytest

from maniple.core.geometry import Pose
from maniple.core.messages import Motion, Odometry
from maniple.core.time import SECOND
from robot_agent.dead_reckoning import wheels_of
from robot_agent.localisation import PATIENCE, Localisation
from tests.pioneer import PIONEER

T0 = 1000 * SECOND
WHEELS = wheels_of(PIONEER)


def motion(ticks: tuple[int, int], incarnation: int = 1) -> Motion:
    return Motion(
        incarnation=incarnation,
        stamp_ns=T0,
        ticks=ticks,
        applied=(0.0, 0.0),
        state="active",
        controllable=True,
    )


def last_word(**changes: Any) -> Odometry:
    given = {"frame_id": "r1", "x_m": 1.0, "y_m": 2.0, "psi_rad": 0.5, "u_mps": 0.0, "w_radps": 0.0}
    heads = {"source": "r1", "incarnation": 1, "stamp_ns": T0 - SECOND, "ticks": (7, 9)}
    return Odometry(**{**given, **heads, "motion_incarnation": 1, **changes})


def test_a_first_life_knows_its_frame() -> None:
    frame = Localisation("r1", 1, WHEELS)
    frame.counted(motion((7, 9)), T0)
    assert (frame.known, frame.frame_id, frame.resume(T0 + PATIENCE)) == (True, "r1", None)


def test_a_later_one_resumes_it_once() -> None:
    frame = Localisation("r1", 2, WHEELS)
    frame.heard(last_word())
    assert frame.resume(T0) is None
    frame.counted(motion((7, 9)), T0)
    frame.counted(motion((99, 99)), T0 + 1)
    assert frame.resume(T0) == Pose(1.0, 2.0, 0.5)
    assert (frame.known, frame.frame_id, frame.resume(T0)) == (True, "r1", None)


def test_a_last_word_from_the_future_does_not_tell_how_far_it_rolled_since() -> None:
    frame = Localisation("r1", 2, WHEELS)
    frame.heard(last_word(stamp_ns=T0 + SECOND))
    frame.counted(motion((9000, 9000)), T0)
    assert frame.resume(T0 + 10 * PATIENCE) is None
    assert not frame.known


def test_without_a_last_word_a_robot_whose_wheels_never_turned_stands_where_it_began() -> None:
    frame = Localisation("r1", 2, WHEELS)
    frame.counted(motion((0, 0)), T0)
    assert frame.resume(T0 + PATIENCE - 1) is None
    assert frame.frame_id == "r1/2"
    assert frame.resume(T0 + PATIENCE) == Pose(0.0, 0.0, 0.0)
    assert (frame.known, frame.frame_id) == (True, "r1")


def test_a_last_word_is_better_than_that() -> None:
    frame = Localisation("r1", 2, WHEELS)
    frame.counted(motion((0, 0)), T0)
    frame.heard(last_word(ticks=(0, 0)))
    assert frame.resume(T0 + PATIENCE) == Pose(1.0, 2.0, 0.5)


@pytest.mark.parametrize("first", [motion((0, 1)), motion((0, 0), incarnation=2)])
def test_wheels_that_may_have_turned_tell_nothing(first: Motion) -> None:
    frame = Localisation("r1", 2, WHEELS)
    frame.counted(first, T0)
    for changes in ({"incarnation": 2}, {"frame_id": "r1/1"}):
        frame.heard(last_word(**changes))
    assert frame.resume(T0 + 100 * PATIENCE) is None
    assert not frame.known
    frame.heard(last_word())
    assert frame.resume(T0 + 100 * PATIENCE) is not None
