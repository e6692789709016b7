"""The drivers that are part of this program keep what every driver has to, each with a simulated vehicle."""

import socket
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from maniple.core.scenario.types import Mavlink, Robot, Ros2, Scenario
from robot_agent.drivers import BUILTIN, capabilities_of
from robot_agent.drivers.conformance import PROPERTIES, Finding, check, look
from tests.robot_agent.drivers.rigs import RosRig, RoverRig, SimulatorDriver, SimulatorRig
from tests.transport.test_zenoh import free_port

MakeScenario = Callable[..., Scenario]
SITE = (47.3977, 8.5456, 488.0)


def scene(make_scenario: MakeScenario, **changes: Any) -> Scenario:
    robot = Robot(id="r1", control_point_m=0.3, pose=(1.0, -2.0, 0.5), **changes)
    return make_scenario(robots=(robot,))


def not_kept(findings: list[Finding]) -> dict[str, str]:
    return {one.name: one.counterexample or one.left_out for one in findings if not one.holds}


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def test_the_simulator_conforms(make_scenario: MakeScenario) -> None:
    scenario = scene(make_scenario)
    able = capabilities_of(scenario, scenario.robots[0])
    rig = SimulatorRig(scenario)
    found = check(lambda *_: SimulatorDriver(rig, able), scenario, "r1", rig)
    assert not_kept(found) == {
        "its poses go where its twists say": "it reports counts, of which the agent makes both",
        "tells who has it, does not fight, comes back": "nobody is there to give and take it",
    }


@pytest.fixture
def rover(make_scenario: MakeScenario) -> Iterator[tuple[Scenario, RoverRig]]:
    link = Mavlink(connection=f"udpin:127.0.0.1:{free_udp_port()}", origin=SITE, arm=True)
    scenario = scene(make_scenario, driver="mavlink", presents="mavlink", mavlink=link)
    rig = RoverRig(scenario)
    yield scenario, rig
    rig.close()


@pytest.mark.slow
def test_mavlink_conforms(rover: tuple[Scenario, RoverRig]) -> None:
    scenario, rig = rover
    assert not_kept(check(BUILTIN["mavlink"], scenario, "r1", rig)) == {}


def test_a_dry_run_tells_a_rover_nothing_that_could_move_it(rover: tuple[Scenario, RoverRig]) -> None:
    """No arming, no mode, no velocity; and what the vehicle says of itself is there."""
    scenario, rig = rover
    dry = [one for one in PROPERTIES if not one.moves]
    seen = look(BUILTIN["mavlink"], scenario, "r1", rig)
    found = check(BUILTIN["mavlink"], scenario, "r1", rig, moves=False, properties=dry[2:4])
    assert not_kept(found) == {}
    assert (seen.state, seen.reason) == ("configured", "")
    assert seen.motion is not None
    assert seen.motion.pose == pytest.approx((1.0, -2.0, 0.5), abs=0.05)
    assert seen.motion_hz == pytest.approx(20.0, rel=0.2)
    assert {"firmware", "mode", "armed", "ekf", "gps", "battery"} <= set(seen.answers)
    assert seen.answers["armed"] == "no"
    told = [one for one in rig.received if one.get_type() == "COMMAND_LONG"]
    assert told
    assert {one.command for one in told}.isdisjoint({176, 400})  # DO_SET_MODE, COMPONENT_ARM_DISARM
    kinds = {one.get_type() for one in rig.received}
    assert kinds.isdisjoint({"SET_POSITION_TARGET_LOCAL_NED", "SET_MODE", "MANUAL_CONTROL"})


@pytest.fixture
def ros(make_scenario: MakeScenario) -> Iterator[tuple[Scenario, RosRig, str]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    scenario = scene(make_scenario, driver="ros2", presents="ros2", ros2=Ros2(router=endpoint))
    rig = RosRig(scenario, endpoint)
    yield scenario, rig, endpoint
    rig.close()


@pytest.mark.slow
def test_ros2_conforms(ros: tuple[Scenario, RosRig, str]) -> None:
    scenario, rig, endpoint = ros
    found = check(BUILTIN["ros2"], scenario, "r1", rig, endpoint=endpoint, patience_s=15.0)
    assert not_kept(found) == {}
