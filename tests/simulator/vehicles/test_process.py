"""The process of a presented robot over real Zenoh."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from maniple.core import codec, topics
from maniple.core.errors import ManipleError, RunError, TransportError
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time
from maniple.host.clock import Anchor
from maniple.host.router import RouterHost
from maniple.host.stamper import Stamper
from maniple.transport.zenoh import ZenohSession
from simulator.vehicles.process import VehicleHost
from tests.simulator.vehicles.bench import scenario_of
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

MakeScenario = Callable[..., Scenario]
POSES = [(0.0, 0.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0)]
DRIVE = "sim/r1/drive"


class Toy:
    """A vehicle that repeats what it sees."""

    def __init__(self, failure: Exception | None = None) -> None:
        self.seen: list[Motion | Scan] = []
        self.failure = failure
        self.opened = self.closed = False
        self.speed = 0.1
        self.refused = 3

    def open(self, now: Time) -> None:
        if isinstance(self.failure, ManipleError):
            raise self.failure
        self.opened = True

    def see(self, report: Motion | Scan, now: Time) -> None:
        self.seen.append(report)

    def step(self, now: Time) -> Drive:
        if self.failure is not None:
            raise self.failure
        return Drive(u_mps=self.speed, w_radps=0.0, active=True)

    def close(self, now: Time) -> None:
        self.closed = True


class Wired:
    """A router, and a session at it that hears what the body is told."""

    def __init__(self, scenario: Scenario, session: ZenohSession, endpoint: str) -> None:
        self.scenario, self.session, self.endpoint = scenario, session, endpoint
        self.orders: list[Drive] = []
        self.clock = Anchor.here()
        session.subscribe(DRIVE, self._heard)
        session.settle()

    def _heard(self, topic: str, data: bytes) -> None:
        order = codec.decode(topic, data)
        assert isinstance(order, Drive)
        self.orders.append(order)

    @contextmanager
    def running(self, vehicle: Toy, life: int = 1) -> Iterator[tuple[VehicleHost, list[str]]]:
        ended: list[str] = []
        prefix = self.scenario.network.prefix
        with ZenohSession.client(self.endpoint, prefix) as session:
            host = VehicleHost(vehicle, "r1", life, self.scenario, self.clock, session, session)

            def run() -> None:
                try:
                    host.run()
                    ended.append("")
                except ManipleError as error:
                    ended.append(f"{type(error).__name__}: {error}")

            thread = threading.Thread(target=run)
            thread.start()
            try:
                yield host, ended
            finally:
                host.stop()
                thread.join(10.0)
                assert not thread.is_alive()


@pytest.fixture
def wired(make_scenario: MakeScenario) -> Iterator[Wired]:
    scenario = scenario_of(make_scenario, POSES)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    prefix = scenario.network.prefix
    with ZenohSession.router(endpoint, prefix) as session:
        router = RouterHost(session, Anchor.here(), scenario, grace_s=0.0)
        router.start()
        thread = threading.Thread(target=router.run, args=(0.0,))
        thread.start()
        try:
            with ZenohSession.client(endpoint, prefix) as ear:
                yield Wired(scenario, ear, endpoint)
        finally:
            router.stop()
            thread.join(10.0)


def motion() -> Motion:
    return Motion(ticks=(1, 2), applied=(0.0, 0.0), state="active", controllable=True, pose=(1.0, 2.0, 3.0))


def test_it_passes_reports_on_and_says_what_the_body_is_to_do(wired: Wired) -> None:
    toy = Toy()
    simulator = Stamper("simulator", 1)
    topic = topics.simulated_motion("r1")
    with wired.running(toy) as (host, ended):
        assert eventually(lambda: wired.session.lives("r1-vehicle")) == (1,)
        for _ in range(3):
            wired.session.put(topic, simulator.stamp(topic, motion(), wired.clock.now()).data)
        eventually(lambda: len(toy.seen) == 3)
        wired.session.put(topic, Stamper("r2", 1).stamp(topic, motion(), wired.clock.now()).data)
        wired.session.put(topic, b"\x99 no message")
        eventually(lambda: len(wired.orders) > 10)
        eventually(lambda: sum(host.refused.values()) == 2)
    assert ended == [""]
    assert toy.closed
    assert len(toy.seen) == 3
    eventually(lambda: wired.orders[-1].active is False)
    assert {(o.source, o.incarnation) for o in wired.orders} == {("r1-vehicle", 1)}
    assert [o.seq for o in wired.orders] == list(range(len(wired.orders)))
    assert {o.u_mps for o in wired.orders[:-1]} == {0.1}
    assert host.refused == {"sender": 1, "malformed": 1, "over its protocol": 3}


def test_a_steady_order_is_said_at_the_rate_of_drives_a_new_one_at_once(wired: Wired) -> None:
    toy = Toy()
    with wired.running(toy):
        eventually(lambda: len(wired.orders) > 30)
        gaps = [b.stamp_ns - a.stamp_ns for a, b in zip(wired.orders, wired.orders[1:], strict=False)]
        assert min(gaps) >= 50_000_000
        toy.speed = 0.2
        eventually(lambda: wired.orders[-1].u_mps == 0.2)


def test_a_newer_life_takes_over(wired: Wired) -> None:
    old, new = Toy(), Toy()
    with wired.running(old) as (_, ended):
        eventually(lambda: old.opened)
        eventually(lambda: wired.session.lives("r1-vehicle") == (1,))
        with wired.running(new, life=2):
            eventually(lambda: ended)
        assert ended[0].startswith("RunError: r1-vehicle (incarnation 1) steps back")
    assert old.closed


@pytest.mark.parametrize("failure", [TransportError("taken"), ValueError("a bug")])
def test_one_that_fails_leaves_the_body_standing(wired: Wired, failure: Exception) -> None:
    toy = Toy(failure)
    with wired.running(toy) as (_, ended):
        eventually(lambda: ended)
    assert toy.closed
    eventually(lambda: wired.orders)
    assert not any(order.active for order in wired.orders)
    wanted = "TransportError: taken" if isinstance(failure, ManipleError) else "r1-vehicle failed: ValueError"
    assert wanted in ended[0]
    assert isinstance(failure, ManipleError) or ended[0].startswith(RunError.__name__)
