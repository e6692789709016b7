"""The driver interface, and an agent on a driver that lives through everything a driver may."""

from collections.abc import Callable
from typing import get_args

import pytest

from maniple.control.limits import Velocity, limits_of
from maniple.core import topics
from maniple.core.errors import ManipleError, ScenarioError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan, Status
from maniple.core.node import Received
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND
from robot_agent.drivers import capabilities_of
from robot_agent.drivers.interface import COUNTS, EVENTS, LIFE_CYCLE, Capabilities, Driver, Step, within
from robot_agent.node import DRIVE, STATUS, RobotAgent
from simulator.drives import TRANSITIONS as SIMULATED

STATES = get_args(DriverState)


def test_every_state_can_be_reached_and_closed() -> None:
    reached = {"closed"}
    for _ in STATES:
        reached |= {after for (before, _), after in LIFE_CYCLE.items() if before in reached}
    assert reached == set(STATES) == set(EVENTS) == set(COUNTS)
    assert all(LIFE_CYCLE[state, "close"] == "closed" for state in STATES)
    assert {step for _, step in LIFE_CYCLE} == set(get_args(Step))


def test_the_simulated_drive_lives_by_the_table() -> None:
    for (before, order), after in SIMULATED.items():
        assert LIFE_CYCLE[before, order] == after


def test_capabilities_of_the_simulator_are_those_of_the_model(make_scenario: Callable[..., Scenario]) -> None:
    scenario = make_scenario()
    expected = Capabilities(0.75, 1.745, True, True, 20.0, 10.0, "r1")
    assert capabilities_of(scenario, scenario.robots[0]) == expected


def test_limits_shrink_to_what_the_driver_can_do(make_scenario: Callable[..., Scenario]) -> None:
    scenario = make_scenario()
    limits = limits_of(scenario, scenario.robots[0])
    able = capabilities_of(scenario, scenario.robots[0])
    assert within(limits, able, "r1") == limits
    slow = within(limits, able._replace(u_max_mps=0.4, w_max_radps=1.0), "r1")
    assert (slow.u_min, slow.u_max, slow.w_max) == (-0.4, 0.4, 1.0)
    assert within(limits, able._replace(reverse=False), "r1").u_min == 0.0
    with pytest.raises(ScenarioError, match="r1: its driver does not follow a turning rate"):
        within(limits, able._replace(accepts_yaw_rate=False), "r1")


class Bench:
    """A driver whose hardware is a counter: one tick forward for every mm/s at every read."""

    def __init__(self, capabilities: Capabilities) -> None:
        self.capabilities = capabilities
        self.state: DriverState = "closed"
        self.controllable = True
        self.reason = ""
        self._applied = Velocity()
        self._ticks = 0

    def take(self, step: Step, now: int) -> None:
        if (self.state, step) not in LIFE_CYCLE:
            raise ManipleError(f"driver: can't {step} while {self.state}")
        self.state = LIFE_CYCLE[self.state, step]
        if self.state != "active":
            self.stop(now)

    def read(self, now: int) -> list[Motion | Scan]:
        self._ticks += round(1000 * self._applied[0])
        reason = "" if self.controllable else "a pilot has it"
        return [
            Motion(
                source="simulator",
                ticks=(self._ticks, self._ticks),
                applied=self._applied[:2],
                state=self.state,
                controllable=self.controllable,
                reason=reason,
            )
        ]

    def write(self, drive: Drive, now: int) -> Velocity:
        if self.state == "active" and not drive.active:
            self.take("deactivate", now)
        elif self.state == "configured" and drive.active:
            self.take("activate", now)
        if self.state == "active":
            self._applied = Velocity(min(drive.u_mps, self.capabilities.u_max_mps), drive.w_radps)
        return self._applied

    def see(self, pose: ExternalPose, now: int) -> None:
        pass

    def stop(self, now: int) -> None:
        self._applied = Velocity()


def test_an_agent_follows_its_driver_through_its_life(
    make_scenario: Callable[..., Scenario], command_from: Callable[..., Received]
) -> None:
    scenario = make_scenario()
    bench = Bench(capabilities_of(scenario, scenario.robots[0]))
    driver: Driver = bench
    agent = RobotAgent(scenario, "r1")
    now = 0

    def ticks(n: int) -> Status:
        nonlocal now
        for _ in range(n):
            now += 50 * MILLISECOND
            for message in driver.read(now):
                agent.on_message(Received(topics.motion("r1"), message), now)
            agent.on_message(command_from(now, (0.2, 0.0)), now)
            ((_, drive),) = agent.on_timer(DRIVE, now)
            assert isinstance(drive, Drive)
            driver.write(drive, now)
            if driver.state != "active":
                assert (drive.u_mps, drive.w_radps) == (0.0, 0.0)
        ((_, status),) = agent.on_timer(STATUS, now)
        assert isinstance(status, Status)
        return status

    status = ticks(2)
    assert (status.mode, status.driver, status.reason) == (
        "waiting",
        "closed",
        "the drive is in state closed",
    )
    driver.take("connect", now)
    assert ticks(2).mode == "waiting"
    driver.take("configure", now)
    status = ticks(40)
    assert (status.mode, status.driver, status.reason) == ("tracking", "active", "")
    assert driver.write(Drive(u_mps=0.2, w_radps=0.0, active=True), now) == (0.2, 0.0, 0.0)

    bench.controllable = False
    status = ticks(2)
    assert (status.mode, status.reason, bench.state) == ("fault", "a pilot has it", "configured")
    bench.controllable = True
    assert ticks(3).mode == "tracking"

    driver.take("fail", now)
    status = ticks(2)
    assert (status.mode, status.driver, status.reason) == ("fault", "fault", "the drive is in state fault")
    with pytest.raises(ManipleError, match="can't activate while fault"):
        driver.take("activate", now)
    for step in ("close", "connect", "configure"):
        driver.take(step, now)
    assert ticks(3).mode == "tracking"

    ((_, last), (_, status_at_end)) = agent.on_stop(now)
    assert isinstance(last, Drive)
    driver.write(last, now)
    assert driver.state == "configured"
    assert isinstance(status_at_end, Status)
    assert (status_at_end.mode, status_at_end.reason) == ("stopped", "told to stop")
