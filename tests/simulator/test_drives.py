import math
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from maniple.control.limits import Velocity
from maniple.core.messages import Drive, DriverState
from maniple.core.scenario.types import Scenario
from simulator.drives import TRANSITIONS, Change, Drives
from tests.pioneer import PIONEER

MS = 1_000_000


@pytest.fixture
def drives(make_scenario: Callable[..., Scenario]) -> Drives:
    return Drives([make_scenario([(0.0, 0.0, 0.0)]).models["pioneer"]] * 2, 10 * MS)


def order(u: float, w: float, active: bool = True) -> Drive:
    return Drive(u_mps=u, w_radps=w, active=active)


@pytest.mark.parametrize(("state", "event"), sorted(TRANSITIONS))
def test_every_transition(drives: Drives, state: DriverState, event: str) -> None:
    if state == "active":
        drives.command(0, order(0.0, 0.0), 0)
    assert drives.state(0) == state
    drives.command(0, order(0.1, 0.2, active=event == "activate"), 1)
    assert drives.state(0) == ("active" if event == "activate" else "configured")
    assert drives.reference(0) == ((0.1, 0.2, 0.0) if event == "activate" else None)
    assert drives.state(1) == "configured"


def test_orders_are_clipped_to_the_drives_limits(drives: Drives) -> None:
    drives.command(0, order(9.0, -9.0), 0)
    drives.command(1, order(-9.0, 9.0), 0)
    assert drives.reference(0) == (0.75, -1.745, 0.0)
    assert drives.changes[1] == Change(1, 1, Velocity(-0.75, 1.745), False)


def test_sideways_only_for_those_who_can_and_steering_within_the_limit() -> None:
    round_, car = (
        replace(PIONEER, drive="omnidirectional", v_max_mps=0.4),
        replace(PIONEER, drive="car", wheelbase_m=0.5, steer_max_rad=0.4),
    )
    drives = Drives([PIONEER, round_, car], 10 * MS)
    for robot in range(3):
        drives.command(robot, Drive(u_mps=0.1, w_radps=1.0, v_mps=-0.9, active=True), 0)
    assert [drives.reference(robot) for robot in range(3)] == [
        (0.1, 1.0, 0.0),
        (0.1, 1.0, -0.4),
        (0.1, pytest.approx(0.1 * math.tan(0.4) / 0.5), 0.0),
    ]


@pytest.mark.parametrize(("elapsed", "tick"), [(0, 1), (10 * MS - 1, 1), (10 * MS, 2), (11 * MS, 2)])
def test_an_order_counts_from_the_first_step_due_after_it(drives: Drives, elapsed: int, tick: int) -> None:
    drives.command(0, order(0.1, 0.0), elapsed)
    assert drives.changes == [Change(tick, 0, Velocity(0.1), False)]


@pytest.mark.parametrize(("heard", "tick"), [(0, 50), (1, 51), (10 * MS, 51)])
def test_silence_brakes_from_the_first_step_due_at_the_timeout(drives: Drives, heard: int, tick: int) -> None:
    drives.command(0, order(0.1, 0.0), heard)
    drives.expire(heard + 500 * MS - 1)
    assert drives.reference(0) == (0.1, 0.0, 0.0)
    drives.expire(heard + 500 * MS)
    assert drives.changes[1:] == [Change(tick, 0, Velocity(), True)]
    assert drives.reference(0) is None
    assert drives.state(0) == "active"


def test_changes_stay_in_order_whoever_falls_silent_first(drives: Drives) -> None:
    drives.command(1, order(0.1, 0.0), 0)
    drives.command(0, order(0.1, 0.0), 20 * MS)
    drives.command(1, order(0.2, 0.0), 700 * MS)
    ticks = [(change.tick, change.robot, change.braking) for change in drives.changes]
    assert ticks == [(1, 1, False), (3, 0, False), (50, 1, True), (52, 0, True), (71, 1, False)]
