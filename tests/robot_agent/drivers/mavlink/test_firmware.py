"""The driver with ArduPilot Rover's own firmware, where the environment variable MANIPLE_ARDUROVER names a
binary of it that was built for its simulator (SITL)."""

import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from maniple.core.messages import Drive, DriverState, Motion
from maniple.core.scenario.types import Scenario
from maniple.core.time import MILLISECOND
from maniple.transport.mavlink import MavlinkLink
from robot_agent.drivers.interface import Step
from robot_agent.drivers.mavlink.driver import MavlinkDriver
from tests.ardurover import HOME, ardurover
from tests.robot_agent.drivers.mavlink.test_driver import driver_of, scenario_of
from tests.waiting import eventually

MakeScenario = Callable[..., Scenario]

MANUAL, GUIDED = 0, 15

pytestmark = pytest.mark.slow


class Bench:
    """The driver, called every 10 ms."""

    def __init__(self, driver: MavlinkDriver) -> None:
        self.driver = driver
        self.order: Drive | None = None
        self.motions: list[Motion] = []

    def turn(self) -> None:
        now = time.monotonic_ns()
        self.motions += [said for said in self.driver.read(now) if isinstance(said, Motion)]
        if self.order is not None:
            self.driver.write(self.order, now)
        time.sleep(0.01)

    def until(self, what: Callable[[], object], within_s: float) -> None:
        end = time.monotonic() + within_s
        while not what():
            assert time.monotonic() < end, (self.driver.state, self.driver.reason, self.driver.answers())
            self.turn()

    def is_in(self, state: DriverState) -> bool:
        return self.driver.state == state

    def is_controllable(self, controllable: bool) -> bool:
        return self.motions[-1].controllable == controllable

    def run(self, seconds: float) -> None:
        end = time.monotonic_ns() + round(seconds * 1000) * MILLISECOND
        self.until(lambda: time.monotonic_ns() >= end, seconds + 10.0)

    def drive(self, u: float, w: float, seconds: float) -> Motion:
        self.order = Drive(u_mps=u, w_radps=w, active=True, controller_alive=True)
        self.run(seconds)
        return self.motions[-1]


def test_all_of_it(make_scenario: MakeScenario, tmp_path: Path) -> None:
    with ardurover(tmp_path) as port:
        drives_and_gives_way(make_scenario, port)


def drives_and_gives_way(make_scenario: MakeScenario, port: int) -> None:
    bench = Bench(driver_of(scenario_of(make_scenario, connection=f"tcp:127.0.0.1:{port}", origin=HOME)))
    driver = bench.driver
    way: tuple[tuple[Step, DriverState, float], ...] = (
        ("connect", "connected", 30.0),
        ("configure", "configured", 120.0),
        ("activate", "active", 60.0),
    )
    for step, state, within_s in way:
        driver.take(step, time.monotonic_ns())
        bench.until(partial(bench.is_in, state), within_s)
    answers = driver.answers()
    assert answers["firmware"].startswith("ardupilotmega")
    assert (answers["mode"], answers["armed"]) == ("GUIDED", "yes")
    begun = bench.drive(0.0, 0.0, 1.0)
    there = bench.drive(0.5, 0.0, 8.0)
    assert there.twist[0] == pytest.approx(0.5, abs=0.1)
    assert begun.pose is not None
    assert there.pose is not None
    assert math.dist(begun.pose[:2], there.pose[:2]) > 2.0
    ahead = math.atan2(there.pose[1] - begun.pose[1], there.pose[0] - begun.pose[0])
    assert math.cos(ahead - begun.pose[2]) > 0.9, "it went where it looked"
    left = bench.drive(0.5, 0.2, 6.0)
    assert left.twist[1] == pytest.approx(0.2, abs=0.06)
    assert bench.drive(0.5, -0.2, 6.0).twist[1] == pytest.approx(-0.2, abs=0.06)

    pilot = MavlinkLink.open(f"tcp:127.0.0.1:{port + 2}", 254, 1, timeout_s=5.0)
    try:
        for mode, controllable in ((MANUAL, False), (GUIDED, True)):
            pilot.send(pilot.dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, mode, 0, 0, 0, 0, 0))
            bench.until(partial(bench.is_controllable, controllable), 5.0)
            pilot.receive()
    finally:
        pilot.close()
    bench.order = None
    driver.stop(time.monotonic_ns())
    driver.take("deactivate", time.monotonic_ns())
    bench.until(lambda: driver.state == "configured", 10.0)
    assert abs(bench.motions[-1].twist[0]) < 0.1
    assert driver.answers()["mode"] == "HOLD"
    driver.take("close", time.monotonic_ns())
    eventually(lambda: driver.read(time.monotonic_ns()) is None or driver.state == "closed", 2.0)
