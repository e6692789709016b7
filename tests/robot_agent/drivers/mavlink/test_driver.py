"""The driver over a real socket, against the simulator's vehicle."""

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import msgspec
import pytest

from maniple.core.errors import ManipleError, ScenarioError
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Mavlink, Scenario
from maniple.core.time import SECOND
from maniple.transport.mavlink import MavlinkLink
from robot_agent.drivers import BUILTIN, capabilities_of
from robot_agent.drivers.interface import Capabilities
from robot_agent.drivers.mavlink.driver import MavlinkDriver
from simulator.vehicles.interface import STEP
from simulator.vehicles.mavlink import MavlinkVehicle, vehicle
from tests.waiting import eventually

MakeScenario = Callable[..., Scenario]
ORIGIN = (48.1, 11.5, 500.0)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def scenario_of(make_scenario: MakeScenario, **link: Any) -> Scenario:
    """r1 behind MAVLink."""
    scenario = make_scenario()
    fields = {"connection": "tcp:127.0.0.1:5799", "origin": ORIGIN, "arm": True, **link}
    robot = msgspec.structs.replace(
        scenario.robots[0], driver="mavlink", presents="mavlink", mavlink=Mavlink(**fields)
    )
    return msgspec.structs.replace(scenario, robots=(robot,))


def driver_of(scenario: Scenario) -> MavlinkDriver:
    return MavlinkDriver(scenario, scenario.robots[0])


class Presented:
    """A vehicle on a thread of its own; its body does at once what it is told."""

    def __init__(self, scenario: Scenario) -> None:
        self._vehicle: MavlinkVehicle = vehicle(scenario, scenario.robots[0])
        self.drive = Drive(u_mps=0.0, w_radps=0.0, active=False)
        self.x = 0.0
        self._ended = threading.Event()
        self._vehicle.open(time.monotonic_ns() - 15 * SECOND)  # it is not waited for to find out where it is
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _live(self) -> None:
        step_s = STEP / 1e9
        while not self._ended.wait(step_s):
            now = time.monotonic_ns()
            self.x += self.drive.u_mps * step_s
            twist = (self.drive.u_mps, self.drive.w_radps, 0.0)
            motion = Motion(
                ticks=(), applied=twist[:2], state="active", controllable=True,
                pose=(self.x, 0.0, 0.0), twist=twist,
            )  # fmt: skip
            self._vehicle.see(motion, now)
            self.drive = self._vehicle.step(now)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._vehicle.close(time.monotonic_ns())


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def presented(stack: ExitStack, scenario: Scenario) -> Presented:
    rover = Presented(scenario)
    stack.callback(rover.close)
    return rover


def reached(driver: MavlinkDriver, state: str, order: Drive | None = None) -> list[Motion | Scan]:
    """Call it as its process does until it is there."""
    steps: dict[str, Any] = {
        "closed": "connect", "connected": "configure", "configured": "activate", "fault": "close",
    }  # fmt: skip
    said: list[Motion | Scan] = []
    asked = ""

    def there() -> bool:
        nonlocal asked
        now = time.monotonic_ns()
        said.extend(driver.read(now))
        if order is not None and driver.state == "active":
            driver.write(order, now)
        if driver.state != state and asked != driver.state:
            asked = driver.state
            driver.take(steps[asked], now)
        return driver.state == state

    eventually(there, 30.0)
    return said


def test_capabilities_are_known_and_nothing_is_loaded_or_opened(make_scenario: MakeScenario) -> None:
    scenario = scenario_of(make_scenario)
    expected = Capabilities(0.75, 1.745, True, True, 20.0, 10.0, "world")
    assert capabilities_of(scenario, scenario.robots[0], BUILTIN) == expected
    local = scenario_of(make_scenario, origin=None)
    assert driver_of(local).capabilities.frame == "r1"
    assert driver_of(scenario).state == "closed"
    code = (
        "import sys; import robot_agent.drivers; "
        "sys.exit(any(name.split('.')[0] in ('pymavlink', 'serial') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("link", "words"),
    [
        ({"connection": "tcp"}, "robots: r1: mavlink.connection: MAVLink connection 'tcp': must be 'serial"),
        ({"origin": None, "external_pose": True}, "mavlink.external_pose needs mavlink.origin"),
    ],
)
def test_parameters_that_do_not_do(make_scenario: MakeScenario, link: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        driver_of(scenario_of(make_scenario, **link))


def test_a_step_that_is_not_open_is_refused(make_scenario: MakeScenario) -> None:
    with pytest.raises(ManipleError, match="a driver that is closed can't activate"):
        driver_of(scenario_of(make_scenario)).take("activate", 0)


@pytest.mark.parametrize(
    "kind",
    ["tcp", "udpin", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("udpout", "tcpin"))],
)
def test_from_closed_to_driving_and_back(make_scenario: MakeScenario, stack: ExitStack, kind: str) -> None:
    port = free_port(socket.SOCK_DGRAM if kind.startswith("udp") else socket.SOCK_STREAM)
    scenario = scenario_of(make_scenario, connection=f"{kind}:127.0.0.1:{port}")
    rover = presented(stack, scenario)
    driver = driver_of(scenario)
    reached(driver, "active")
    order = Drive(u_mps=0.4, w_radps=0.0, active=True, controller_alive=True)
    motions: list[Motion | Scan] = []

    def drives() -> bool:
        now = time.monotonic_ns()
        motions.extend(driver.read(now))
        driver.write(order, now)
        return rover.drive.u_mps > 0.35

    eventually(drives, 10.0)
    assert isinstance(motions[-1], Motion)
    assert motions[-1].controllable
    assert motions[-1].pose is not None
    assert motions[-1].pose[0] == pytest.approx(rover.x, abs=0.2)
    assert driver.answers()["mode"] == "GUIDED"
    assert driver.answers()["link"] == "0 bad, 0 lost, 0 not sent"
    driver.take("deactivate", time.monotonic_ns())
    eventually(lambda: driver.read(time.monotonic_ns()) is None or driver.state == "configured", 10.0)
    eventually(lambda: driver.read(time.monotonic_ns()) is None or abs(rover.drive.u_mps) < 0.01, 10.0)
    driver.take("close", time.monotonic_ns())
    eventually(lambda: driver.read(time.monotonic_ns()) is None or driver.state == "closed", 10.0)
    eventually(lambda: not rover.drive.active, 10.0)  # it is disarmed


def test_a_vehicle_that_is_switched_off_and_on_again(make_scenario: MakeScenario, stack: ExitStack) -> None:
    port = free_port()
    scenario = scenario_of(make_scenario, connection=f"tcp:127.0.0.1:{port}")
    driver = driver_of(scenario)
    driver.take("connect", time.monotonic_ns())
    refused = f"tcp:127.0.0.1:{port}: Connection refused; no heartbeat of system 1, component 1 yet"
    eventually(lambda: driver.read(time.monotonic_ns()) is None or driver.reason == refused, 10.0)
    rover = presented(stack, scenario)
    reached(driver, "configured")
    rover.close()
    eventually(lambda: driver.read(time.monotonic_ns()) is None or driver.state == "fault", 10.0)
    assert driver.reason
    driver.take("close", time.monotonic_ns())
    presented(stack, scenario)
    reached(driver, "connected")
    driver.take("close", time.monotonic_ns())
    assert driver.state == "closed"


def test_a_port_that_is_taken_is_told(make_scenario: MakeScenario, stack: ExitStack) -> None:
    port = free_port(socket.SOCK_DGRAM)
    other = MavlinkLink.open(f"udpin:127.0.0.1:{port}", 9, 1)
    stack.callback(other.close)
    driver = driver_of(scenario_of(make_scenario, connection=f"udpin:127.0.0.1:{port}"))
    driver.take("connect", time.monotonic_ns())
    assert driver.read(time.monotonic_ns()) == []
    assert f"udpin:127.0.0.1:{port}: Address already in use" in driver.reason
    other.close()
    driver.take("connect", time.monotonic_ns())
    driver.read(time.monotonic_ns())
    assert "Address already in use" not in driver.reason
    driver.take("close", time.monotonic_ns())


def test_noise_on_the_line_is_counted(make_scenario: MakeScenario, stack: ExitStack) -> None:
    port = free_port(socket.SOCK_DGRAM)
    scenario = scenario_of(make_scenario, connection=f"udpin:127.0.0.1:{port}")
    presented(stack, scenario)
    driver = driver_of(scenario)
    reached(driver, "connected")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
        for index in range(200):
            noise.sendto(bytes([index]) * 40, ("127.0.0.1", port))
    eventually(
        lambda: driver.read(time.monotonic_ns()) is None or "200 bad" in driver.answers()["link"], 10.0
    )
    assert driver.state == "connected"
    driver.take("close", time.monotonic_ns())
