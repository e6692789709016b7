import copy
from typing import Any

import pytest

from maniple.core.scenario.check import problems
from maniple.core.scenario.parse import scenario_of, with_overrides
from maniple.core.scenario.resolve import resolve

Data = dict[str, Any]
TCP = "tcp:127.0.0.1:5999"


def checked(data: Data, robots: dict[int, Data]) -> list[str]:
    """With these fields of some robots."""
    data = copy.deepcopy(data)
    data["models"]["omni"] = {**data["models"]["cart"], "drive": "omnidirectional", "v_max_mps": 0.5}
    for index, fields in robots.items():
        data["robots"][index].update(fields)
    return problems(resolve(scenario_of(with_overrides(data, ())), {}, {}))


def vehicle(connection: str = TCP, driver: str = "mavlink", **link: Any) -> Data:
    return {"driver": driver, "mavlink": {"connection": connection, **link}}


LONDON = [51.5, -0.1, 20.0]


@pytest.mark.parametrize(
    "robots",
    [
        {0: vehicle()},
        {0: vehicle(), 1: vehicle(system_id=2), 2: vehicle("tcp:127.0.0.1:6000")},
        {0: vehicle("serial:/dev/ttyUSB0:57600"), 1: vehicle("serial:/dev/ttyUSB1:57600")},
        {0: vehicle(origin=LONDON), 1: vehicle(system_id=2, origin=LONDON), 2: {"driver": "ros2"}},
        {0: {"driver": "mavlink", "presents": "mavlink"}, 2: {"driver": "mavlink", "presents": "mavlink"}},
        {0: {"driver": "ros2"}, 1: {"driver": "ros2"}},
        {0: {"driver": "ros2", "presents": "ros2", "scans": "simulator"}},
        {0: {"driver": "own", "presents": "mavlink", "options": {"speed": 3}}},
        {0: {"driver": "simulator", "scans": "ros2"}, 1: {"driver": "simulator", "scans": "simulator"}},
        {0: {"driver": "simulator", "scans": "lidar", "options": {"port": 1}}},
        {0: {"id": "scout-driver"}},
        {0: {"driver": "ros2", "ros2": {"router": "tcp/[fe80::1]:7447"}}},
        {
            0: {"driver": "ros2", "ros2": {"namespace": "/", "cmd_vel": "/a/cmd_vel", "odom": "/a/odom"}},
            1: {"driver": "ros2", "ros2": {"namespace": "/"}},
        },
        {
            0: {"driver": "ros2", "ros2": {"namespace": "/x"}},
            1: {"driver": "ros2", "ros2": {"namespace": "/x", "domain_id": 3}},
            2: {"driver": "ros2", "ros2": {"namespace": "/x", "router": "tcp/10.0.0.2:7447"}},
        },
    ],
    ids=str,
)
def test_what_can_be_driven_has_no_problems(data: Data, robots: dict[int, Data]) -> None:
    assert checked(data, robots) == []


@pytest.mark.parametrize(
    ("robots", "message"),
    [
        (
            {0: {"driver": "mavlink"}},
            "robots[0].mavlink.connection: missing; must be given for driver = 'mavlink', as 'serial:",
        ),
        ({0: {"driver": "ros2", "scans": "mavlink"}}, "robots[0].mavlink.connection: missing; must be given"),
        (
            {0: vehicle("tcp:here")},
            "robots[0].mavlink.connection: MAVLink connection 'tcp:here': must be 'serial:",
        ),
        ({0: vehicle("tcp:here:99999")}, "'tcp:here:99999': its port must be 1 to 65535"),
        ({0: vehicle("nonsense", driver="simulator")}, "MAVLink connection 'nonsense': must be 'serial:"),
        (
            {0: vehicle("serial:/dev/ttyS1:9600") | {"presents": "mavlink"}},
            "robots[0].mavlink.connection = 'serial:/dev/ttyS1:9600': a presented vehicle has no serial port",
        ),
        (
            {0: vehicle(), 2: vehicle()},
            "robots[2].mavlink.system_id = 1: robots[0] (r1) has it on the same connection, 'tcp:127",
        ),
        (
            {0: vehicle(), 1: vehicle(system_id=2), 2: vehicle(system_id=2)},
            "robots[2].mavlink.system_id = 2: robots[1] (r2) has it on the same connection",
        ),
        (
            {0: vehicle("udpin:0.0.0.0:14999"), 1: vehicle("udpin:0.0.0.0:14999", system_id=2)},
            "robots[1].mavlink.connection = 'udpin:0.0.0.0:14999': robots[0] (r1) has it, and only one",
        ),
        (
            {0: vehicle("serial:/dev/ttyS1:9600"), 1: vehicle("serial:/dev/ttyS1:57600", system_id=2)},
            "robots[1].mavlink.connection = 'serial:/dev/ttyS1:57600': robots[0] (r1) has it",
        ),
        (
            {0: vehicle() | {"presents": "mavlink"}, 1: vehicle(system_id=2) | {"presents": "mavlink"}},
            "robots[1].mavlink.connection = 'tcp:127.0.0.1:5999': robots[0] (r1) has it",
        ),
        (
            {0: vehicle(system_id=255)},
            "robots[0].mavlink.gcs_system_id = 255: is the vehicle's own system_id; must be another",
        ),
        (
            {0: vehicle(origin=[91.0, 0.0, 0.0])},
            "robots[0].mavlink.origin = [91.0, 0.0, 0.0]: is nowhere on Earth; must be [latitude, longitude",
        ),
        (
            {0: vehicle(), 1: vehicle(system_id=2, origin=LONDON)},
            "robots[0].mavlink.origin: missing; must be [51.5, -0.1, 20.0], as of robots[1] (r2), or",
        ),
        (
            {0: vehicle(origin=LONDON), 1: vehicle(system_id=2, origin=[51.5, -0.1, 21.0])},
            "robots[1].mavlink.origin = [51.5, -0.1, 21.0]: must be [51.5, -0.1, 20.0], as of robots[0] (r1)",
        ),
        (
            {0: {"presents": "mavlink"}},
            "robots[0].presents = 'mavlink': its driver is 'simulator', which does not connect to such",
        ),
        (
            {0: {"driver": "mavlink", "presents": "mavlink", "model": "omni"}},
            "robots[0].presents = 'mavlink': its model is omnidirectional; must be differential",
        ),
        (
            {0: {"driver": "ros2", "presents": "mavlink"}},
            "robots[0].presents = 'mavlink': its driver is 'ros2', which does not connect",
        ),
        (
            {0: vehicle() | {"presents": "ros2"}},
            "robots[0].presents = 'ros2': its driver is 'mavlink', which does not connect",
        ),
        (
            {0: {"driver": "ros2", "scans": "simulator"}},
            "robots[0].scans = 'simulator': the simulator has no body for it; must be another driver",
        ),
        (
            {0: {"driver": "ros2", "scans": "ros2"}},
            "robots[0].scans = 'ros2': is its driver; must be another",
        ),
        (
            {0: {"options": {"b": 1, "a": 2}}},
            "robots[0].options: has a, b, but driver = 'simulator' takes none; must be left out",
        ),
        (
            {1: {"id": "r1-driver"}},
            "robots[1].id = 'r1-driver': names a process of r1; must not be the id of another robot",
        ),
        ({1: {"id": "r3-vehicle"}}, "robots[1].id = 'r3-vehicle': names a process of r3"),
        (
            {0: {"driver": "ros2", "ros2": {"router": "192.168.1.12:7447"}}},
            "robots[0].ros2.router = '192.168.1.12:7447': is no address of a router; must be as 'tcp/192",
        ),
        ({0: {"driver": "ros2", "ros2": {"router": "tcp/host:0"}}}, "is no address of a router"),
        (
            {0: {"driver": "ros2"}, 1: {"driver": "ros2", "ros2": {"namespace": "/r1/"}}},
            "robots[1].ros2.cmd_vel = 'cmd_vel': is /r1/cmd_vel of domain 0, as that of robots[0] (r1)",
        ),
        (
            {
                0: {"driver": "ros2", "ros2": {"odom": "/odom"}},
                2: {"driver": "ros2", "ros2": {"odom": "/odom"}},
            },
            "robots[2].ros2.odom = '/odom': is /odom of domain 0, as that of robots[0] (r1)",
        ),
    ],
    ids=str,
)
def test_what_is_wrong_is_named_with_what_would_be_valid(
    data: Data, robots: dict[int, Data], message: str
) -> None:
    (found,) = checked(data, robots)
    assert message in found
