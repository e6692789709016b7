import math
from typing import Any

import pytest
from msgspec.structs import replace

from maniple.core.edges import WORLD
from maniple.core.geometry import Pose
from maniple.core.messages import Motion, Odometry
from maniple.core.time import SECOND
from robot_agent.dead_reckoning import gauge_of
from robot_agent.localisation import PATIENCE, Localisation
from tests.pioneer import PIONEER

T0 = 1000 * SECOND
GAUGE = gauge_of(PIONEER)


def motion(ticks: tuple[int, ...], incarnation: int = 1) -> Motion:
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
    frame = Localisation("r1", 1, GAUGE)
    frame.counted(motion((7, 9)), T0)
    assert (frame.known, frame.frame_id, frame.resume(T0 + PATIENCE)) == (True, "r1", None)


def test_a_later_one_resumes_it_once() -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.heard(last_word())
    assert frame.resume(T0) is None
    frame.counted(motion((7, 9)), T0)
    frame.counted(motion((99, 99)), T0 + 1)
    assert frame.resume(T0) == Pose(1.0, 2.0, 0.5)
    assert (frame.known, frame.frame_id, frame.resume(T0)) == (True, "r1", None)


def test_a_last_word_from_the_future_does_not_tell_how_far_it_rolled_since() -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.heard(last_word(stamp_ns=T0 + SECOND))
    frame.counted(motion((9000, 9000)), T0)
    assert frame.resume(T0 + 10 * PATIENCE) is None
    assert not frame.known


def test_without_a_last_word_a_robot_whose_wheels_never_turned_stands_where_it_began() -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.counted(motion((0, 0)), T0)
    assert frame.resume(T0 + PATIENCE - 1) is None
    assert frame.frame_id == "r1/2"
    assert frame.resume(T0 + PATIENCE) == Pose(0.0, 0.0, 0.0)
    assert (frame.known, frame.frame_id) == (True, "r1")


def test_a_last_word_is_better_than_that() -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.counted(motion((0, 0)), T0)
    frame.heard(last_word(ticks=(0, 0)))
    assert frame.resume(T0 + PATIENCE) == Pose(1.0, 2.0, 0.5)


@pytest.mark.parametrize("first", [motion((0, 1)), motion((0, 0), incarnation=2)])
def test_wheels_that_may_have_turned_tell_nothing(first: Motion) -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.counted(first, T0)
    for changes in ({"incarnation": 2}, {"frame_id": "r1/1"}):
        frame.heard(last_word(**changes))
    assert frame.resume(T0 + 100 * PATIENCE) is None
    assert not frame.known
    frame.heard(last_word())
    assert frame.resume(T0 + 100 * PATIENCE) is not None


def report(pose: tuple[float, float, float], incarnation: int = 1) -> Motion:
    return replace(motion((), incarnation), pose=pose)


@pytest.mark.parametrize("incarnation", [1, 2])
def test_a_drive_that_says_where_it_is_tells_how_far_it_moved_meanwhile(incarnation: int) -> None:
    """If it is the same life of the driver; else the robot stayed where it was."""
    frame = Localisation("r1", 2, GAUGE)
    frame.heard(last_word(ticks=(), motion_pose=(50.0, 60.0, math.pi / 2)))
    frame.counted(report((50.0, 60.5, math.pi / 2 + 0.2), incarnation), T0)
    resumed = frame.resume(T0)
    went = Pose(0.5, 0.0, 0.2) if incarnation == 1 else Pose(0.0, 0.0, 0.0)
    assert resumed == pytest.approx(Pose(1.0, 2.0, 0.5).compose(went))


def test_a_pose_of_zero_does_not_tell_that_it_stands_where_its_frame_begins() -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.counted(report((0.0, 0.0, 0.0)), T0)
    assert frame.resume(T0 + 100 * PATIENCE) is None


def test_counts_do_not_go_on_from_a_pose_nor_a_pose_from_counts() -> None:
    for word, first in (
        (last_word(ticks=(), motion_pose=(5.0, 5.0, 0.0)), motion((9000, 9000))),
        (last_word(), report((5.0, 5.0, 0.0))),
    ):
        frame = Localisation("r1", 2, GAUGE)
        frame.heard(word)
        frame.counted(first, T0)
        assert frame.resume(T0) == Pose(1.0, 2.0, 0.5)


def test_in_the_world_every_life_knows_where_it_is() -> None:
    frame = Localisation(WORLD, 7, GAUGE)
    frame.heard(last_word())
    frame.counted(report((5.0, 5.0, 0.0)), T0)
    assert (frame.known, frame.frame_id, frame.resume(T0)) == (True, "world", None)


@pytest.mark.parametrize(("origin", "went"), [(3, 0.5), (4, 0.0)])
def test_a_frame_of_the_driver_that_began_anew_meanwhile_tells_nothing(origin: int, went: float) -> None:
    frame = Localisation("r1", 2, GAUGE)
    frame.heard(last_word(ticks=(), motion_pose=(50.0, 60.0, 0.0), motion_origin=3))
    frame.counted(replace(report((50.5, 60.0, 0.0)), origin=origin), T0)
    assert frame.resume(T0) == pytest.approx(Pose(1.0, 2.0, 0.5).compose(Pose(went, 0.0, 0.0)))
