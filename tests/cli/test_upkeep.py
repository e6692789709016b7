"""Who is waited for, who is started again, and when."""

from typing import Any

import msgspec
import pytest

from maniple.cli.loading import completed
from maniple.cli.upkeep import CALM_S, LONGEST_S, Moment, Upkeep, backoff_s
from maniple.core.faults import NEVER, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Controller, Crash
from maniple.core.time import SECOND, from_seconds
from tests.cli.scenes import platoon

SINCE = 1000 * SECOND
CALM = FaultPlan(since_ns=SINCE)


def at(seconds: float) -> Moment:
    """By a wall clock that began elsewhere."""
    return Moment(50.0 + seconds, SINCE + from_seconds(seconds))


def upkeep(keep_alive: bool = False, **changes: Any) -> Upkeep:
    scenario = msgspec.structs.replace(completed(platoon(4)), **changes)
    made = Upkeep(scenario, keep_alive)
    for name in ("router", "recorder", "simulator", "r1", "r2", "r3", "r4", "controller"):
        made.started(name, 1, at(-1.0))
    return made


def plan(*crashes: Crash) -> FaultPlan:
    return FaultPlan(since_ns=SINCE, crashes=crashes)


def test_the_wait_doubles_up_to_a_limit() -> None:
    assert [backoff_s(deaths) for deaths in (1, 2, 3, 4, 5, 6)] == [0.2, 0.4, 0.8, 1.6, 3.2, LONGEST_S]
    assert backoff_s(10**9) == LONGEST_S


@pytest.mark.parametrize("name", ["r1", "controller", "router", "recorder", "simulator"])
def test_without_keep_alive_the_dead_stay_dead(name: str) -> None:
    made = upkeep()
    assert not made.is_dead(name)
    assert made.died(name, CALM, at(1.0))[:2] == (None, False)
    assert made.is_dead(name)
    assert made.lost(()) == {name}
    assert made.due(CALM, at(1e6), ()) == []


def test_with_keep_alive_all_but_the_simulator_come_back_in_their_time() -> None:
    made = upkeep(keep_alive=True)
    for name in ("r1", "controller", "router", "recorder", "simulator"):
        made.died(name, CALM, at(1.0))
    assert made.lost(()) == {"simulator"}
    assert set(made.absent(())) == {"r1", "controller", "router", "recorder", "simulator"}
    assert made.due(CALM, at(1.19), ()) == []
    assert set(made.due(CALM, at(1.21), ())) == {"r1", "controller", "router", "recorder"}


def test_one_that_dies_again_and_again_waits_longer_until_it_has_lived_for_a_while() -> None:
    made = upkeep(keep_alive=True)
    waits, now = [], 1.0
    for lives_s in (1.0, 1.0, CALM_S - 0.1, CALM_S, 1.0):
        now += lives_s
        waits.append(made.died("r1", CALM, at(now)).due_s - at(now).wall_s)
        made.started("r1", made.next_life("r1"), at(now))
    assert waits == pytest.approx([0.2, 0.4, 0.8, 0.2, 0.4])
    assert made.life("r1") == 6


def test_what_the_plan_kills_comes_back_as_the_plan_says() -> None:
    for keep_alive in (False, True):
        made = upkeep(keep_alive)
        crashes = plan(Crash(node="r1", at_s=5, restart_after_s=3), Crash(node="r2", at_s=5))
        assert made.died("r1", crashes, at(5.01)).back
        assert not made.died("r2", crashes, at(5.01)).back
        assert made.lost(()) == {"r2"}
        assert made.due(crashes, at(7.99), ()) == []
        assert made.due(crashes, at(8.0), ()) == ["r1"]
        assert made.due(crashes, at(1e6), ()) == ["r1"]


def test_a_short_crash_is_recognised_when_it_is_over() -> None:
    made = upkeep()
    crashes = plan(Crash(node="r1", at_s=5, restart_after_s=0.01))
    assert made.died("r1", crashes, at(5.05)).crash == crashes.crashes[0]
    assert made.due(crashes, at(5.05), ()) == ["r1"]


def test_a_crash_of_a_former_life_is_no_excuse() -> None:
    made = upkeep()
    crashes = plan(Crash(node="r1", at_s=5, restart_after_s=3))
    made.died("r1", crashes, at(5.0))
    made.started("r1", 2, at(8.0))
    assert made.died("r1", crashes, at(9.0))[:2] == (None, False)


def test_who_is_taken_out_of_the_plan_lives_again() -> None:
    made = upkeep()
    made.died("r1", plan(Crash(node="r1", at_s=5)), at(5.0))
    assert made.due(CALM, at(6.0), ()) == ["r1"]


def test_who_is_to_be_dead_is_not_kept_alive() -> None:
    made = upkeep(keep_alive=True)
    made.died("r1", CALM, at(4.0))
    crashes = plan(Crash(node="r1", at_s=4.1, restart_after_s=2))
    assert made.due(crashes, at(5.0), ()) == []
    assert made.due(crashes, at(6.2), ()) == ["r1"]


def test_a_controller_dies_by_the_robot_it_runs_on() -> None:
    crashes = plan(Crash(node="r1", at_s=5, restart_after_s=3))
    made = upkeep(controller=Controller(host="r1"))
    assert made.died("controller", crashes, at(5.0)).back
    assert not upkeep().died("controller", crashes, at(5.0)).back
    assert not made.died("r2", crashes, at(5.0)).back


def test_a_guest_takes_the_place() -> None:
    made = upkeep(keep_alive=True)
    made.died("r1", CALM, at(1.0))
    made.met("r1", 2)
    assert made.due(CALM, at(9.0), {"r1"}) == []
    assert not made.absent({"r1"})
    assert made.due(CALM, at(9.0), ()) == ["r1"]
    assert made.next_life("r1") == 3
    assert upkeep().lost({"r1"}) == frozenset()


def test_a_plan_that_has_not_begun_kills_nobody() -> None:
    scenario = msgspec.structs.replace(completed(platoon(4)), crashes=(Crash(node="r1", at_s=0),))
    waiting = plan_of(scenario, NEVER)
    assert upkeep().died("r1", waiting, at(1.0)).crash is None
