"""The process of a driver over real Zenoh: its host in a thread, around a driver that keeps book."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import msgspec
import pytest

from maniple.cli.loading import completed
from maniple.core import codec, topics
from maniple.core.errors import ScenarioError, TransportError
from maniple.core.messages import Drive, ExternalPose, FaultPlan, Message, Motion, Scan
from maniple.core.scenario.types import Crash, Freeze, Robot, Scenario
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.fate import Death, Pause
from maniple.host.router import RouterHost
from maniple.host.stamper import Stamper
from maniple.transport.zenoh import ZenohSession
from robot_agent.drivers.process import DriverHost
from tests.cli.scenes import platoon
from tests.robot_agent.drivers.bench import Bench
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

MARGIN_S = 0.5
"""For a machine that is busy."""


def scene(**fields: Any) -> Scenario:
    names: list[dict[str, Any]] = [{"id": "r1", "driver": "bench", **fields}, {"id": "r2"}, {"id": "r3"}]
    robots = tuple(msgspec.convert(name, Robot) for name in names)
    return completed(msgspec.structs.replace(platoon(3), robots=robots))


class Place:
    """A router, an agent's mouth, ears on the hardware network, and drivers' processes in threads."""

    def __init__(self, stack: ExitStack, scenario: Scenario | None = None) -> None:
        self.scenario = scenario or scene()
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.clock = Anchor.here()
        self.stack = stack
        self.router = stack.enter_context(Router(self.endpoint, self.clock, self.scenario))
        self.agent = stack.enter_context(ZenohSession.client(self.endpoint, "maniple"))
        self.heard: list[tuple[str, Message]] = []
        for topic in (topics.motion("r1"), topics.scan("r1")):
            self.agent.subscribe(
                topic, lambda name, data: self.heard.append((name, codec.decode(name, data)))
            )
        self.agent.settle()
        self._stamper = Stamper("r1", 1)

    def start(self, bench: Bench, life: int = 1, name: str = "r1-driver", **options: Any) -> "Process":
        process = Process(self, bench, life, name, **options)
        self.stack.callback(process.close)
        return process

    def say(self, u: float = 0.3, active: bool = True, stamper: Stamper | None = None) -> None:
        order = Drive(u_mps=u, w_radps=0.0, active=active, controller_alive=True)
        envelope = (stamper or self._stamper).stamp(topics.drive("r1"), order, self.clock.now())
        self.agent.put(envelope.topic, envelope.data)

    def drive_until(self, what: Callable[[], bool], u: float = 0.3, stamper: Stamper | None = None) -> None:
        """Say it as an agent does."""

        def said() -> bool:
            self.say(u, stamper=stamper)
            time.sleep(0.03)
            return what()

        eventually(said)

    def motions(self) -> list[Motion]:
        return [message for _, message in self.heard if isinstance(message, Motion)]


class Router:
    """A router's host in a thread."""

    def __init__(self, endpoint: str, clock: Anchor, scenario: Scenario) -> None:
        self._of = endpoint, clock, scenario

    def __enter__(self) -> "Router":
        endpoint, clock, scenario = self._of
        self.session = ZenohSession.router(endpoint, "maniple")
        self._host = RouterHost(self.session, clock, scenario)
        self._host.start()
        self._thread = threading.Thread(target=self._host.run)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._host.stop()
        self._thread.join()
        self.session.close()


class Process:
    def __init__(
        self, place: Place, bench: Bench, life: int, name: str, fleet_at: str = "", **options: Any
    ) -> None:
        self.made: list[Bench] = []
        self.outcome: list[BaseException | None] = []
        self._first = bench
        robot = place.scenario.robots[0]
        fleet, hardware = (
            ZenohSession.client(endpoint, "maniple")
            for endpoint in (fleet_at or place.endpoint, place.endpoint)
        )
        self._sessions = fleet, hardware
        self.host = DriverHost(
            self._make, robot, name, life, place.scenario, place.clock, fleet, hardware, **options
        )
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _make(self) -> Bench:
        self.made.append(Bench() if self.made else self._first)
        return self.made[-1]

    def _run(self) -> None:
        try:
            self.host.run()
        except BaseException as error:  # noqa: BLE001 - to be looked at by the test
            self.outcome.append(error)
        else:
            self.outcome.append(None)
        finally:
            for session in self._sessions:
                session.close()

    @property
    def bench(self) -> Bench:
        return self.made[-1]

    def result(self) -> BaseException | None:
        self._thread.join(30.0)
        return self.outcome[0]

    def close(self) -> None:
        self.host.stop()
        self._thread.join(30.0)


@pytest.fixture
def place() -> Iterator[Place]:
    with ExitStack() as stack:
        yield Place(stack)


def writes(bench: Bench) -> list[float]:
    return [drive.u_mps for what, drive in bench.told if what == "write" and drive is not None]


def driving(place: Place, u: float = 0.3, **options: Any) -> Process:
    process = place.start(Bench(), **options)
    place.drive_until(lambda: u in writes(process.bench), u)
    return process


def test_it_comes_up_says_how_the_robot_moves_and_follows_orders(place: Place) -> None:
    process = place.start(Bench())
    bench = process.bench
    eventually(lambda: bench.state == "configured")
    assert place.agent.lives("r1-driver") == (1,)
    place.drive_until(lambda: 0.3 in writes(bench))
    place.drive_until(lambda: 0.5 in writes(bench), u=0.9)
    assert max(writes(bench)) == 0.5, "no order is beyond its capabilities"
    last = eventually(lambda: [m for m in place.motions() if m.twist[0] == 0.5])[-1]
    assert (last.source, last.incarnation, last.state, last.controllable) == ("r1-driver", 1, "active", True)
    assert bench.told[:3] == [("connect", None), ("configure", None), ("activate", None)]
    assert all(drive.controller_alive for what, drive in bench.told if what == "write" and drive)


def test_without_its_agent_the_robot_is_stopped_and_then_left_alone(place: Place) -> None:
    process = driving(place)
    bench, silent_since = process.bench, time.monotonic()
    eventually(lambda: ("stop", None) in bench.told)
    assert 0.2 < time.monotonic() - silent_since < 0.3 + MARGIN_S
    eventually(lambda: bench.state == "configured")
    after = bench.told[bench.told.index(("stop", None)) :]
    zeros = [drive for what, drive in after if what == "write"]
    assert [what for what, _ in after] == ["stop", *["write"] * len(zeros), "deactivate"]
    assert 5 <= len(zeros) <= 10
    assert all(drive is not None and (drive.u_mps, drive.controller_alive) == (0.0, False) for drive in zeros)
    told = len(bench.told)
    time.sleep(0.3)
    assert len(bench.told) == told, "silence"
    place.drive_until(lambda: bench.told[-1][0] == "write" and bench.velocity.u == 0.3)


def test_without_its_router_too_and_it_goes_on_when_that_is_back(place: Place) -> None:
    """It tells the router what that has forgotten."""
    process = driving(place)
    bench = process.bench
    plan = FaultPlan(source="operator", incarnation=1, stamp_ns=1, since_ns=place.clock.now())
    place.agent.put(topics.PLAN, codec.encode(plan))
    eventually(lambda: place.agent.ask(topics.PLAN))
    place.router.__exit__()
    eventually(lambda: bench.state == "configured")
    assert bench.velocity.u == 0.0
    place.router.__enter__()
    place.drive_until(lambda: bench.velocity.u == 0.3)
    assert process.made == [bench]
    assert eventually(lambda: place.agent.lives("r1-driver")) == (1,)
    assert codec.decode(topics.PLAN, eventually(lambda: place.agent.ask(topics.PLAN))[topics.PLAN]) == plan


def test_without_the_fleet_network_it_does_what_its_agent_says(place: Place) -> None:
    elsewhere = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(elsewhere, "maniple") as fleet:
        process = driving(place, fleet_at=elsewhere)
        assert eventually(lambda: fleet.lives("r1-driver")) == (1,)
    bench, told = process.bench, len(process.bench.told)
    place.drive_until(lambda: len(writes(bench)) > 20 and bench.velocity.u == 0.2, u=0.2)
    assert ("stop", None) not in bench.told[told:]


def test_asked_to_end_it_lets_the_robot_stand_deactivates_and_closes(place: Place) -> None:
    process = driving(place)
    bench = process.bench
    begin = time.monotonic()
    process.host.stop()
    assert process.result() is None
    assert 0.25 < time.monotonic() - begin < 3.0
    after = [what for what, _ in bench.told[bench.told.index(("stop", None)) :]]
    assert after == ["stop", *["write"] * after.count("write"), "deactivate", "close"]
    assert bench.velocity.u == 0.0
    eventually(lambda: place.agent.lives("r1-driver") == ())


def test_a_newer_life_takes_over_and_the_older_says_no_more(place: Place) -> None:
    older = driving(place)
    newer = place.start(Bench(), life=2)
    assert newer.bench.succeeds
    assert str(older.result()) == "r1-driver (incarnation 1) steps back: incarnation 2 has taken over"
    assert [what for what, _ in older.bench.told[-2:]] == ["stop", "close"]
    told = len(older.bench.told)
    place.drive_until(lambda: 0.3 in writes(newer.bench))
    assert len(older.bench.told) == told


def test_what_is_no_order_of_its_agents_newest_life_moves_nothing(
    place: Place, capfd: pytest.CaptureFixture[str]
) -> None:
    process = place.start(Bench())
    bench = process.bench
    place.drive_until(lambda: 0.3 in writes(bench), stamper=(second := Stamper("r1", 2)))
    topic, now = topics.drive("r1"), place.clock.now()
    order = Drive(u_mps=0.4, w_radps=0.0, active=True)
    good = second.stamp(topic, order, now).data
    for forged in (
        Stamper("r1", 1).stamp(topic, order, now).data,  # an older life
        Stamper("r2", 2).stamp(topic, order, now).data,  # somebody else
        second.stamp(topic, order, now - SECOND).data,  # sent a second ago
        codec.encode(msgspec.structs.replace(order, source="r1", incarnation=2, seq=10**9, stamp_ns=now)),
        good[:-3],
        b"garbage",
    ):
        place.agent.put(topic, forged)
    place.agent.put_raw(topic, good, b"0000")  # another checksum
    place.agent.put_raw(topic, good)  # none
    place.drive_until(lambda: 0.2 in writes(bench), u=0.2, stamper=second)
    assert 0.4 not in writes(bench)
    process.close()
    told = capfd.readouterr().err
    for reason in ("old", "sender", "late", "leap", "malformed", "corrupted", "unsealed"):
        assert f"1 {reason}" in told or f"2 {reason}" in told or f"3 {reason}" in told, told


@pytest.mark.parametrize("call", ["read", "write"])
def test_a_driver_that_raises_is_stopped_and_there_is_another_one(
    place: Place, call: str, capfd: pytest.CaptureFixture[str]
) -> None:
    process = driving(place)
    bench = process.bench
    bench.raises[call] = OSError("the port is gone")
    place.drive_until(lambda: len(process.made) == 2)
    assert bench.velocity.u == 0.0
    assert [what for what, _ in bench.told[-2:]] == ["stop", "close"]
    place.drive_until(lambda: 0.3 in writes(process.bench))
    faults = [motion for motion in place.motions() if motion.state == "fault"]
    assert {motion.reason for motion in faults} == {"OSError: the port is gone"}
    assert not any(motion.controllable for motion in faults)
    assert "r1-driver: the driver failed: OSError: the port is gone" in capfd.readouterr().err
    assert not bench.succeeds
    assert process.bench.succeeds


def test_a_driver_that_says_fault_is_closed_and_connected_again(place: Place) -> None:
    process = driving(place)
    bench = process.bench
    bench.state = "fault"
    place.drive_until(lambda: bench.state == "active" and bench.velocity.u == 0.3)
    assert process.made == [bench]
    steps = [what for what, _ in bench.told if what != "write"]
    assert steps[-5:] == ["stop", "close", "connect", "configure", "activate"]


def test_one_that_can_not_be_connected_says_why_for_as_long_as_that_lasts(place: Place) -> None:
    bench = Bench()
    bench.raises["take"] = TransportError("nothing answers at tcp:10.0.0.9:5760")
    place.start(bench)
    why = "nothing answers at tcp:10.0.0.9:5760"
    last = eventually(lambda: [motion for motion in place.motions() if motion.reason == why])[-1]
    assert (last.state, last.controllable, last.ticks, last.pose) == ("fault", False, (), None)


@pytest.mark.parametrize(
    ("reason", "told"),
    [("waits for an EKF origin", "waits for an EKF origin"), ("", "no word from the vehicle")],
)
def test_one_that_is_silent_has_its_process_say_so(place: Place, reason: str, told: str) -> None:
    bench = Bench()
    bench.silent, bench.reason = True, reason
    process = place.start(bench)
    eventually(lambda: bench.state == "configured")
    begin, before = time.monotonic(), len(place.motions())
    eventually(lambda: len(place.motions()) > before + 20)
    assert time.monotonic() - begin < 5.0, "as often as it should be heard"
    last = place.motions()[-1]
    assert (last.reason, last.controllable, last.pose, last.ticks) == (told, False, None, ())
    process.close()


def test_what_the_scenario_is_wrong_about_ends_it(place: Place) -> None:
    bench = Bench()
    bench.raises["take"] = ScenarioError("driver = 'mavlink' needs pymavlink: pip install 'maniple[mavlink]'")
    process = place.start(bench)
    assert isinstance(process.result(), ScenarioError)
    assert bench.told == [("stop", None)]


def test_where_others_see_the_robot_is_passed_on(place: Place) -> None:
    process = place.start(Bench())
    stamper, pose = Stamper("mocap", 1), ExternalPose(pose=(1.0, 2.0, 0.5))

    def seen() -> bool:
        envelope = stamper.stamp(topics.external_pose("r1"), pose, place.clock.now())
        place.agent.put(envelope.topic, envelope.data)
        time.sleep(0.02)
        return bool(process.bench.seen)

    eventually(seen)
    assert process.bench.seen[-1].pose == (1.0, 2.0, 0.5)


def test_scans_are_those_of_the_driver_that_the_scenario_names() -> None:
    for scans, name in (("", "r1-driver"), ("laser", "r1-scanner")):
        with ExitStack() as stack:
            place = Place(stack, scene(scans=scans))
            drive, scan = Bench(), Bench()
            drive.scans = scan.scans = True
            place.start(drive)
            if scans:
                place.start(scan, name="r1-scanner")
            heard = eventually(lambda place=place: [m for _, m in place.heard if isinstance(m, Scan)])  # type: ignore[misc]
            assert {message.source for message in heard} == {name}
            place.drive_until(lambda drive=drive: 0.3 in writes(drive))  # type: ignore[misc]
            assert {motion.source for motion in place.motions()} == {"r1-driver"}
            assert not writes(scan)
            assert scan.state == ("configured" if scans else "closed")


def test_it_meets_its_fate() -> None:
    met: list[Death | Pause] = []
    with ExitStack() as stack:
        place = Place(stack)
        place.start(Bench(), meet=lambda event, _: met.append(event))
        eventually(lambda: place.agent.lives("r1-driver"))
        plan = FaultPlan(
            source="operator",
            incarnation=1,
            stamp_ns=1,
            since_ns=place.clock.now(),
            crashes=(Crash(node="r1-driver", at_s=0.5),),
            freezes=(Freeze(node="r1-driver", at_s=0.1, for_s=0.2), Freeze(node="r1", at_s=0.1, for_s=9.0)),
        )
        place.agent.put(topics.PLAN, codec.encode(plan))
        eventually(lambda: any(isinstance(event, Death) for event in met))
    assert isinstance(met[0], Pause)
    assert isinstance(met[1], Death)
