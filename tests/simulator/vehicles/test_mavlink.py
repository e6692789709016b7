"""The rover behind real sockets."""

import socket
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from maniple.core.errors import ScenarioError, TransportError
from maniple.core.messages import Motion
from maniple.core.scenario.types import Mavlink, Scenario
from maniple.core.time import Time
from maniple.transport.mavlink import MavlinkLink
from simulator.vehicles.interface import STEP
from simulator.vehicles.mavlink import MavlinkVehicle, vehicle
from simulator.vehicles.rover import HOLD, MANUAL
from tests.simulator.vehicles.bench import BOOT, dialect, scenario_of
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

MakeScenario = Callable[..., Scenario]
POSES = [(0.0, 0.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0)]


def made(make_scenario: MakeScenario, connection: str) -> MavlinkVehicle:
    scenario = scenario_of(make_scenario, POSES, link=Mavlink(connection=connection))
    return vehicle(scenario, scenario.robots[0])


class Running:
    """A vehicle, and ground stations connected to it; its time goes on with every look."""

    def __init__(self, presented: MavlinkVehicle, connection: str, stations: int) -> None:
        self.presented = presented
        self.now: Time = BOOT
        presented.open(self.now)
        self.stations = [MavlinkLink.open(connection, 250 + k, 1, 10.0) for k in range(stations)]
        self.heard: list[list[Any]] = [[] for _ in self.stations]

    def step(self) -> None:
        still = Motion(ticks=(), applied=(0.0, 0.0), state="active", controllable=True, pose=(0.0, 0.0, 0.0))
        self.presented.see(still, self.now)
        self.presented.step(self.now)
        self.now += STEP
        for station, heard in zip(self.stations, self.heard, strict=True):
            heard += station.receive()

    def hears(self, station: int, kind: str, **fields: float) -> bool:
        """Whether a station has heard such a message."""
        self.step()
        return any(
            m.get_type() == kind and all(getattr(m, name) == value for name, value in fields.items())
            for m in self.heard[station]
        )

    def refused(self) -> int:
        """What it has not understood so far."""
        self.step()
        return self.presented.refused

    def close(self) -> None:
        for station in self.stations:
            station.close()
        self.presented.close(self.now)
        self.presented.close(self.now)


@pytest.fixture
def running(make_scenario: MakeScenario) -> Iterator[Running]:
    connection = f"tcp:127.0.0.1:{free_port()}"
    ran = Running(made(make_scenario, connection), connection, 2)
    yield ran
    ran.close()


def set_mode(mode: int) -> Any:
    return dialect.MAVLink_command_long_message(1, 1, dialect.MAV_CMD_DO_SET_MODE, 0, 1, mode, 0, 0, 0, 0, 0)


def test_several_stations_may_speak_to_it_and_each_gets_its_own_answers(running: Running) -> None:
    eventually(lambda: running.hears(0, "HEARTBEAT") and running.hears(1, "HEARTBEAT"))
    running.stations[1].send(set_mode(HOLD))
    eventually(lambda: running.hears(1, "COMMAND_ACK", result=0))
    eventually(lambda: running.hears(0, "HEARTBEAT", custom_mode=HOLD))
    assert not running.hears(0, "COMMAND_ACK")
    running.stations[0].send(set_mode(MANUAL))
    eventually(lambda: running.hears(0, "COMMAND_ACK", result=0))


def test_garbage_is_counted(running: Running) -> None:
    with socket.create_connection(("127.0.0.1", running.stations[0].connection.number)) as rude:
        rude.sendall(b"\xfd\x09\x00 no frame " * 100)
        eventually(running.refused)
    running.stations[0].send(set_mode(HOLD))
    eventually(lambda: running.hears(0, "COMMAND_ACK", result=0))


def test_a_station_that_goes_and_comes_again_finds_it_as_it_was(running: Running) -> None:
    running.stations[0].send(set_mode(HOLD))
    eventually(lambda: running.hears(0, "COMMAND_ACK", result=0))
    where = str(running.stations[0].connection)
    running.stations[0].close()
    for _ in range(5):
        running.step()
    running.stations[0] = MavlinkLink.open(where, 250, 1, 10.0)
    running.heard[0].clear()
    eventually(lambda: running.hears(0, "HEARTBEAT", custom_mode=HOLD))


@pytest.mark.parametrize("form", ["udpin:127.0.0.1:{}", "udpout:127.0.0.1:{}", "tcpin:127.0.0.1:{}"])
def test_it_is_at_the_other_end_of_any_connection(make_scenario: MakeScenario, form: str) -> None:
    connection = form.format(free_port())
    presented = made(make_scenario, connection)
    presented.open(BOOT)
    station = MavlinkLink.open(connection, 255, 1)
    heard: list[Any] = []
    now = BOOT

    def met() -> bool:
        nonlocal now
        station.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        presented.step(now)
        now += STEP
        heard.extend(station.receive())
        return any(m.get_type() == "SYS_STATUS" for m in heard)  # only those it has heard are told that

    try:
        eventually(met)
    finally:
        station.close()
        presented.close(now)


def test_a_port_that_is_taken_is_said(make_scenario: MakeScenario) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        presented = made(make_scenario, f"tcp:127.0.0.1:{port}")
        with pytest.raises(TransportError, match=f"{port}: Address already in use"):
            presented.open(BOOT)
        assert not presented.step(BOOT).active
        presented.close(BOOT)


def test_what_can_not_be_presented_is_refused(make_scenario: MakeScenario) -> None:
    with pytest.raises(ScenarioError, match=r"robots: r1: presents = 'mavlink'.*serial"):
        made(make_scenario, "serial:/dev/ttyUSB0:57600")
