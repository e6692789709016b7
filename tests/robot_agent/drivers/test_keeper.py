"""When a driver is told what: by single cases, and by any sequence of events against a model of a driver."""

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.messages import Drive, DriverState, Motion
from maniple.core.time import MILLISECOND, SECOND, Time
from robot_agent.drivers.interface import LIFE_CYCLE, Capabilities, Step
from robot_agent.drivers.keeper import (
    AGAIN,
    CLOSE_WITHIN,
    DEACTIVATE_WITHIN,
    FIRST,
    LATE,
    LONGEST,
    STAND,
    STAND_WITHIN,
    WATCHDOG,
    ZERO_EVERY,
    ZEROS,
    Action,
    Halt,
    Keeper,
    Lateness,
    Standing,
    Take,
    Write,
    clipped,
)

TICK = 10 * MILLISECOND
CAN = Capabilities(
    u_max_mps=0.5,
    w_max_radps=1.0,
    reverse=False,
    accepts_yaw_rate=True,
    motion_hz=20.0,
    scan_hz=10.0,
    frame="r1",
)


def drive(u: float = 0.3, active: bool = True, **fields: Any) -> Drive:
    return Drive(u_mps=u, w_radps=0.1, active=active, **fields)


class Bench:
    """A keeper with a driver that takes every step at once, unless told otherwise."""

    def __init__(self, state: DriverState = "closed") -> None:
        self.keeper = Keeper(CAN)
        self.now: Time = 0
        self.state: DriverState = state
        self.obeys = True
        self.stands = False
        self.said: list[tuple[Time, Action]] = []

    def tick(self, count: int = 1) -> list[Action]:
        """Let so many ticks pass; what was due in them."""
        begin = len(self.said)
        for _ in range(count):
            for action in self.keeper.due(self.state, self.stands, self.now):
                self.said.append((self.now, action))
                if isinstance(action, Take):
                    after = LIFE_CYCLE[self.state, action.step]
                    self.state = after if self.obeys else self.state
            self.now += TICK
        return [action for _, action in self.said[begin:]]

    def drive_for(self, ticks: int, u: float = 0.3) -> list[Action]:
        """With an order in each."""
        actions: list[Action] = []
        for _ in range(ticks):
            self.keeper.heard(drive(u), self.now)
            actions += self.tick()
        return actions

    def fail(self) -> None:
        self.state = "fault"

    def times(self, kind: type) -> list[Time]:
        return [when for when, action in self.said if isinstance(action, kind)]


def steps(actions: Sequence[Action]) -> list[Step]:
    return [action.step for action in actions if isinstance(action, Take)]


def active() -> Bench:
    bench = Bench()
    bench.drive_for(10)
    assert bench.state == "active"
    bench.said.clear()
    return bench


def test_it_is_connected_and_configured_without_an_agent_and_activated_by_one() -> None:
    bench = Bench()
    assert steps(bench.tick(10)) == ["connect", "configure"]
    assert steps(bench.drive_for(3)) == ["activate"]
    assert bench.tick() == []  # nothing is said twice


def test_an_order_that_does_not_want_it_active_activates_nothing() -> None:
    bench = Bench()
    bench.keeper.heard(drive(active=False), 0)
    assert steps(bench.tick(100)) == ["connect", "configure"]
    assert bench.times(Write) == []


def test_orders_are_passed_on_once_each_and_clipped() -> None:
    bench = active()
    assert bench.drive_for(2, u=0.7) == [Write(drive(0.5))] * 2
    assert bench.drive_for(1, u=-0.7) == [Write(drive(0.0))]


def test_without_orders_it_is_stopped_then_told_to_stand_then_nothing_and_deactivated() -> None:
    bench = active()
    bench.drive_for(1)
    last = bench.now - TICK
    bench.said.clear()
    bench.tick(200)
    (halt,) = bench.times(Halt)
    assert halt == last + WATCHDOG
    zeros = bench.times(Write)
    assert zeros == list(range(halt, halt + ZEROS, ZERO_EVERY))
    assert all(action == Write(STAND) for _, action in bench.said if isinstance(action, Write))
    assert [(when, action) for when, action in bench.said if isinstance(action, Take)] == [
        (halt + ZEROS, Take("deactivate"))
    ]
    assert bench.state == "configured"


@pytest.mark.parametrize("silence", [40, 200])
def test_the_first_order_after_silence_resumes(silence: int) -> None:
    bench = active()
    bench.tick(silence)
    bench.said.clear()
    actions = bench.drive_for(3)
    assert actions.count(Write(drive())) >= 2
    assert Write(STAND) not in actions
    assert bench.state == "active"


def test_told_to_brake_and_deactivate_it_does_at_once() -> None:
    bench = active()
    for _ in range(100):
        bench.keeper.heard(drive(0.4, active=False), bench.now)
        bench.tick()
    kinds = [type(action) for _, action in bench.said]
    assert kinds == [Halt, *[Write] * (ZEROS // ZERO_EVERY), Take]
    assert all(action == Write(STAND) for _, action in bench.said if isinstance(action, Write))
    assert bench.state == "configured"


def test_a_deactivation_that_is_under_way_is_called_off() -> None:
    bench = active()
    bench.obeys = False
    assert steps(bench.tick(90)) == ["deactivate"]
    bench.said.clear()
    actions = bench.drive_for(3)
    assert actions[0] == Take("activate")
    assert actions[1:] == [Write(drive())] * 2


def test_an_activation_that_is_under_way_is_called_off() -> None:
    bench = Bench("configured")
    bench.obeys = False
    assert steps(bench.drive_for(3)) == ["activate"]
    assert steps(bench.tick(40)) == ["deactivate"]
    assert bench.times(Write) == []


def test_a_step_that_is_refused_is_asked_for_again_but_not_at_once() -> None:
    bench = Bench("connected")
    bench.obeys = False
    bench.tick(301)
    assert bench.times(Take) == [0, AGAIN, 2 * AGAIN, 3 * AGAIN]


def test_from_a_fault_it_is_stopped_closed_and_connected_again_later_each_time() -> None:
    bench = active()
    waits: list[Time] = []
    for _ in range(7):
        bench.fail()
        begin = bench.now
        bench.said.clear()
        while bench.state != "connected":
            bench.keeper.heard(drive(), bench.now)
            bench.tick()
        assert steps([action for _, action in bench.said]) == ["close", "connect"]
        waits.append(bench.times(Take)[-1] - begin)
    assert waits == [FIRST, 2 * FIRST, 4 * FIRST, 8 * FIRST, *[LONGEST] * 3]


def test_a_fault_while_driving_stops_first() -> None:
    bench = active()
    bench.drive_for(1)
    bench.said.clear()
    bench.state = "fault"
    assert bench.drive_for(1) == [Halt(), Take("close")]


def test_once_it_was_up_it_is_not_put_off_longer() -> None:
    bench = active()
    for _ in range(5):
        bench.fail()
        begin = bench.now
        bench.drive_for(60)
        assert bench.state == "active"
        assert bench.times(Take)[-3] - begin == FIRST


def test_a_driver_that_failed_is_connected_later_and_the_old_order_moves_nothing() -> None:
    bench = active()
    bench.keeper.failed(bench.now)
    bench.state = "closed"
    begin = bench.now
    bench.tick(100)
    assert bench.times(Take)[0] == begin + FIRST
    assert bench.times(Write) == []


def test_one_that_left_active_by_itself_is_not_fought() -> None:
    """As when a pilot has disarmed it: nothing is said to it but the step, and that seldom."""
    bench = active()
    bench.state, bench.obeys = "configured", False
    actions = bench.drive_for(300)
    assert actions == [Take("activate")] * 3


def test_the_end_of_one_that_drives() -> None:
    bench = active()
    bench.keeper.end(bench.now)
    begin = bench.now
    for _ in range(50):
        bench.keeper.heard(drive(), bench.now)  # no order counts any more
        bench.tick()
    assert bench.times(Halt) == [begin]
    assert {action for _, action in bench.said if isinstance(action, Write)} == {Write(STAND)}
    bench.stands = True
    assert steps(bench.tick(5)) == ["deactivate", "close"]
    assert bench.keeper.done
    assert bench.tick(100) == []


def test_the_end_of_one_that_never_stands_never_deactivates_and_never_closes() -> None:
    bench = active()
    bench.obeys = False
    bench.keeper.end(bench.now)
    begin = bench.now
    while not bench.keeper.done:
        bench.tick()
    assert bench.now - TICK - begin == STAND_WITHIN + DEACTIVATE_WITHIN + CLOSE_WITHIN
    assert steps([action for _, action in bench.said]) == ["deactivate", "deactivate", "close"]


@pytest.mark.parametrize("state", ["closed", "connected", "configured", "fault"])
def test_the_end_of_one_that_does_not_drive(state: DriverState) -> None:
    bench = Bench(state)
    bench.keeper.end(0)
    actions = bench.tick(5)
    assert steps(actions) == ([] if state == "closed" else ["close"])
    assert not any(isinstance(action, Write) for action in actions)
    assert bench.keeper.done


class Model:
    """A driver that takes its time, refuses, faults, and leaves a state by itself, as it is told by dice."""

    def __init__(self, dice: st.DataObject) -> None:
        self.dice = dice
        self.state: DriverState = "closed"
        self.under_way: tuple[int, Step] | None = None

    def take(self, step: Step) -> None:
        assert (self.state, step) in LIFE_CYCLE, (self.state, step)
        delay = self.dice.draw(st.sampled_from([0, 0, 0, 3, 40, 10_000]))
        self.under_way = (delay, step)

    def tick(self, happens: str) -> None:
        if happens == "fault" and self.state != "closed":
            self.state, self.under_way = "fault", None
        elif happens == "drop" and self.state == "active":
            self.state, self.under_way = "configured", None
        elif self.under_way is not None:
            left, step = self.under_way
            self.under_way = (left - 1, step) if left else None
            if not left:
                self.state = LIFE_CYCLE[self.state, step]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_whatever_happens(dice: st.DataObject) -> None:
    """Only a young order that wants it moves the robot, silence follows zeros, zeros follow a stop, every
    step is a legal one, and the end comes."""
    keeper, model = Keeper(CAN), Model(dice)
    now, heard, last, drives, stopped = 0, -(10 * SECOND), STAND, False, -(10 * SECOND)
    ends: Time | None = None
    events = dice.draw(
        st.lists(
            st.tuples(
                st.sampled_from(["drive", "drive", "drive", "rest", "silence", "fault", "drop", "failed"]),
                st.integers(1, 90),
            ),
            min_size=1,
            max_size=12,
        )
    )
    ending = dice.draw(st.integers(0, len(events)))
    script = [("end", 1) if index == ending else event for index, event in enumerate([*events, ("end", 1)])]
    script.append(("silence", 600))
    for kind, ticks in script:
        for tick in range(ticks):
            now += TICK
            if kind in ("drive", "rest") and tick % 5 == 0:
                last, heard = drive(0.1 + tick / 1000.0, active=kind == "drive"), now
                keeper.heard(last, now)
            if kind == "end" and ends is None:
                keeper.end(now)
                ends = now
            if kind == "failed" and tick == 0:
                model.state, model.under_way, drives = "closed", None, False
                keeper.failed(now)
            model.tick(kind if tick == 0 else "")
            state = model.state
            if state in ("closed", "connected", "configured"):
                drives = False
            young = last.active and now - heard < WATCHDOG and ends is None
            actions = keeper.due(state, False, now)
            if drives and not young:
                assert actions[0] == Halt()
            for action in actions:
                if isinstance(action, Halt):
                    assert not young or state == "fault"
                    drives, stopped = False, now
                elif isinstance(action, Write) and action.drive != STAND:
                    assert young
                    assert state == "active"
                    assert action.drive == clipped(last, CAN)
                    drives = True
                elif isinstance(action, Write):
                    assert state == "active"
                    assert not young
                    assert now - stopped < ZEROS or ends is not None
                else:
                    assert action.step != "activate" or young
                    model.take(action.step)
    assert keeper.done


@given(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9), st.booleans(), st.booleans(), st.floats(0, 1))
def test_what_is_written_is_within_the_capabilities(
    u: float, w: float, v: float, reverse: bool, turns: bool, v_max: float
) -> None:
    can = CAN._replace(reverse=reverse, accepts_yaw_rate=turns, v_max_mps=v_max)
    order = clipped(Drive(u_mps=u, w_radps=w, v_mps=v, active=True, controller_alive=True), can)
    assert (-0.5 if reverse else 0.0) <= order.u_mps <= 0.5
    assert abs(order.w_radps) <= (1.0 if turns else 0.0)
    assert abs(order.v_mps) <= v_max
    assert order.active
    assert order.controller_alive
    assert clipped(order, can) == order


def test_what_piled_up_while_nothing_was_read_is_late_and_what_follows_is_not() -> None:
    lateness = Lateness()
    offset = 7 * SECOND
    sent = range(0, 20 * SECOND, SECOND // 20)
    late = []
    for stamp in sent:
        arrived = stamp + offset
        if 5 * SECOND <= stamp < 15 * SECOND:
            arrived = 15 * SECOND + offset  # the process was frozen for 10 s
        if lateness.of(1, stamp, arrived) > LATE:
            late.append(stamp)
    assert min(late) == 5 * SECOND
    assert 14.5 * SECOND < max(late) < 15 * SECOND


@pytest.mark.parametrize("skew", [-0.009, 0.009])
def test_a_clock_that_drifts_makes_nothing_late(skew: float) -> None:
    lateness = Lateness()
    stamps = range(0, 600 * SECOND, SECOND // 20)
    assert all(lateness.of(1, round(stamp * (1 + skew)), stamp) < LATE for stamp in stamps)


def test_another_life_has_another_clock() -> None:
    lateness = Lateness()
    assert lateness.of(1, 100 * SECOND, 100 * SECOND) == 0
    assert lateness.of(2, 3 * SECOND, 101 * SECOND) == 0
    assert lateness.of(2, 4 * SECOND, 103 * SECOND) > LATE


def motion(u: float = 0.0, ticks: tuple[int, ...] | None = None) -> Motion:
    pose = (0.0, 0.0, 0.0) if ticks is None else None
    return Motion(
        ticks=ticks or (),
        applied=(0.0, 0.0),
        state="active",
        controllable=True,
        pose=pose,
        twist=(u, 0.0, 0.0),
    )


@pytest.mark.parametrize("counts", [False, True])
def test_a_robot_stands_that_is_seen_not_to_move_for_a_while(counts: bool) -> None:
    standing = Standing()
    assert not standing.holds(0)
    for tick in range(100):
        now = tick * 50 * MILLISECOND
        moves = tick < 40
        standing.take(motion(ticks=(min(tick, 40), 0)) if counts else motion(0.3 if moves else 0.01), now)
        assert standing.holds(now) == (tick >= 39 + 6 + (1 if counts else 0))
    assert standing.holds(now + 200 * MILLISECOND)
    assert not standing.holds(now + 400 * MILLISECOND)  # not seen any more
