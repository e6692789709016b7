import math

import numpy as np
import pytest

from central_controller.mission import Mission, from_here
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Controller, Line, Positioning, Samples, Sequence, Task
from maniple.core.time import SECOND

LINE = Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1, settle_s=2.0)
BACK = Line(start=(1.0, 0.0), end=(0.0, 0.0), speed_mps=0.1)
STAND = Positioning(target=(1.0, 2.0, 0.5), settle_s=1.0)
TICK = SECOND // 10


def mission(task: Task) -> Mission:
    return Mission(task, Controller())


def errors(off: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.full((2, 6), off)


def test_a_line_goes_on_with_the_time_and_ends() -> None:
    one = mission(LINE)
    for k in range(120):
        assert not one.ended
        assert one.time_s == pytest.approx(0.1 * k)
        assert one.reference(1.0).pose.x == pytest.approx(min(0.01 * k, 1.0))
        one.advance(TICK, 1.0, None)
    assert one.ended
    assert one.time_s == one.course.total_s == 12.0


def test_at_half_the_pace_the_reference_moves_half_as_fast() -> None:
    one = mission(LINE)
    for _ in range(100):
        one.advance(TICK, 0.5, None)
    assert one.reference(0.5).pose.x == pytest.approx(0.5)
    assert one.reference(0.5).velocity == pytest.approx((0.05, 0.0, 0.0))
    assert one.reference(0.0).velocity == (0.0, 0.0, 0.0)


def test_legs_follow_each_other() -> None:
    one = mission(Sequence(tasks=(LINE, BACK)))
    legs = []
    while not one.ended:
        legs.append(one.leg)
        one.advance(TICK, 1.0, None)
    assert legs == [0] * 120 + [1] * 100
    assert one.time_s == pytest.approx(22.0)
    assert one.reference(0.0).pose == pytest.approx((0.0, 0.0, math.pi))


def test_positioning_ends_when_all_were_there_for_long_enough_without_a_break() -> None:
    one = mission(STAND)
    for off in [0.5] * 50 + [0.01] * 9 + [0.03]:
        one.advance(TICK, 1.0, errors(off))
        assert not one.ended
    for _ in range(9):
        one.advance(TICK, 1.0, errors(-0.01))
    assert not one.ended
    one.advance(TICK, 1.0, None)
    assert not one.ended
    for _ in range(10):
        one.advance(TICK, 1.0, errors(0.01))
    assert one.ended
    assert one.reference(1.0).pose == pytest.approx(STAND.target)


def test_another_one_goes_on_from_its_progress() -> None:
    one, other = (mission(Sequence(tasks=(LINE, STAND))) for _ in range(2))
    for k in range(140):
        one.advance(TICK, 0.9, errors(0.01 if k > 135 else 0.5))
    other.recall(one.progress, ended=False)
    while not one.ended:
        assert (other.leg, other.time_s, other.ended) == (one.leg, one.time_s, False)
        assert other.reference(0.5) == one.reference(0.5)
        for each in (one, other):
            each.advance(TICK, 1.0, errors(0.01))
    assert other.ended
    third = mission(Sequence(tasks=(LINE, STAND)))
    third.recall(one.progress, ended=True)
    assert (third.ended, third.time_s) == (True, one.time_s)


def test_from_here_a_straight_way_leads_to_the_start() -> None:
    here = Pose(-3.0, 1.0, 2.5)
    task = from_here(LINE, here, 0.1, 2.0)
    assert isinstance(task, Sequence)
    way = task.tasks[0]
    assert isinstance(way, Samples)
    one = mission(task)
    assert one.reference(0.0).pose == pytest.approx(here)
    fastest = 0.0
    while one.leg == 0:
        vx, vy, turning = one.reference(1.0).velocity
        fastest = max(fastest, math.hypot(vx, vy) + 2.0 * abs(turning))
        one.advance(TICK, 1.0, None)
    assert one.reference(0.0).pose == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert 0.05 < fastest < 0.2


def test_from_the_start_no_way_is_needed_and_to_a_position_neither() -> None:
    assert from_here(LINE, Pose(0.001, 0.0, 0.0), 0.1, 2.0) is LINE
    task = from_here(STAND, Pose(9.0, 9.0, 0.0), 0.1, 2.0)
    assert mission(task).reference(0.0).pose == pytest.approx(STAND.target)
