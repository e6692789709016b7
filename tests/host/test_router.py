"""What a router keeps, and what one that starts in the middle of a run learns."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from threading import Thread
from typing import Any

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.errors import TransportError
from maniple.core.faults import NEVER
from maniple.core.messages import EmergencyStop, FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.fate import Death, Pause
from maniple.host.joining import claim, clock_of, plan_kept, restore
from maniple.host.latched import LatchedStore, Lives
from maniple.host.router import RouterHost, serve
from maniple.transport.zenoh import ZenohSession, crc_of
from tests.host.nodes import scenario_with
from tests.host.test_latched import message, stop
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

TOPIC = "robot/r1/odometry"


@contextmanager
def router(
    scenario: Scenario | None = None, clock: Anchor | None = None, **options: Any
) -> Iterator[tuple[str, RouterHost]]:
    """A router in a thread of its own; yields where it listens."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "test") as session:
        host = RouterHost(session, clock, scenario, **options)
        host.start()
        thread = Thread(target=host.run, args=(0.0,))
        thread.start()
        try:
            yield endpoint, host
        finally:
            host.stop()
            thread.join(DEADLINE_S)


def test_a_late_joiner_gets_what_is_latched_from_a_real_router() -> None:
    with router() as (endpoint, _):
        with ZenohSession.client(endpoint, "test") as early:
            assert claim(early, "r1") == 1
            assert early.lives("r1") == ()
            early.announce("r1", 1)
            early.put(TOPIC, message(5))
            early.settle()
            assert early.ask("incarnation/r1", DEADLINE_S) == {"incarnation/r1": b"2"}
            with (
                ZenohSession.client(endpoint, "test") as second,
                pytest.raises(TransportError, match=r"r1 is running already \(incarnation 1\)"),
            ):
                claim(second, "r1", patience_s=0.0)
        with ZenohSession.client(endpoint, "test") as late:
            assert late.ask(TOPIC, DEADLINE_S) == {TOPIC: message(5)}
            assert claim(late, "r1") == 2


def test_no_life_is_given_twice() -> None:
    with router() as (endpoint, _), ZenohSession.client(endpoint, "test") as session:
        assert claim(session, "r1", wanted=4) == 4
        with pytest.raises(TransportError, match="incarnation 4 of r1 was there already: the next is 5"):
            claim(session, "r1", wanted=4)
        assert [claim(session, "r1"), claim(session, "r1"), claim(session, "r2")] == [5, 6, 1]


def test_who_joins_while_a_life_is_announced_refuses_whatever_number_it_wants() -> None:
    with router() as (endpoint, _), ZenohSession.client(endpoint, "test") as first:
        first.announce("controller", 1)
        first.settle()
        with (
            ZenohSession.client(endpoint, "test") as second,
            pytest.raises(TransportError, match=r"controller is running already \(incarnation 1\)"),
        ):
            claim(second, "controller", wanted=2, patience_s=0.2)


def test_where_nobody_counts_a_life_is_the_wanted_one_or_the_first() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "test"), ZenohSession.client(endpoint, "test") as session:
        assert claim(session, "r1") == 1
        assert claim(session, "r1", wanted=3) == 3
        assert plan_kept(session) == FaultPlan(since_ns=plan_kept(session).since_ns)
        before = time.time_ns()
        assert before <= clock_of(session).now() <= time.time_ns()


@pytest.mark.parametrize("speed", [3.0, None])
def test_who_joins_a_run_has_its_clock(speed: float | None) -> None:
    """As exact as the answer is fast; epoch and all."""
    clock = Anchor.here(1.0 if speed is None else speed)
    if speed is not None:
        clock = msgspec.structs.replace(clock, epoch_ns=clock.epoch_ns + 10**12)
    with (
        router(clock=None if speed is None else clock) as (endpoint, host),
        ZenohSession.client(endpoint, "test") as late,
    ):
        joined = clock_of(late)
        served = host._service.clock
    assert (joined.speed, joined.epoch_ns) == (served.speed, served.epoch_ns)
    assert speed is None or served == clock
    assert abs(joined.monotonic_ns - served.monotonic_ns) < SECOND


def test_what_tells_no_time_is_one_clear_message() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "test") as other, ZenohSession.client(endpoint, "test") as session:
        other.serve("clock", lambda name: {name: b"noon"})
        with pytest.raises(TransportError, match="no router of maniple: b'noon'"):
            clock_of(session)


FAULTY = {
    "robots": [{"id": "r1", "pose": [0, 0, 0]}, {"id": "r2", "pose": [1, 0, 0]}],
    "faults": [{"loss": 0.25}],
}


def test_the_run_begins_once_all_were_seen() -> None:
    clock = Anchor.here(4.0)
    with (
        router(scenario_with(**FAULTY), clock, grace_s=0.0) as (endpoint, _),
        ZenohSession.client(endpoint, "test") as session,
    ):
        heard: SimpleQueue[tuple[bytes, int]] = SimpleQueue()
        session.subscribe(topics.PLAN, lambda _, data: heard.put((data, clock.now())))
        session.settle()
        session.announce("r2", 1)
        session.announce("simulator", 1)
        session.announce("controller", 1)
        session.settle()
        before = clock.now()
        session.announce("r1", 1)
        data, after = heard.get(timeout=DEADLINE_S)
        plan = codec.decode(topics.PLAN, data)
        assert isinstance(plan, FaultPlan)
        assert before <= plan.since_ns <= after
        assert (plan.source, plan.incarnation, plan.seq) == ("router", 1, 0)
        assert [rule.loss for rule in plan.faults] == [0.25]
        assert plan_kept(session) == plan  # who joins late has it too
        assert heard.empty()


def test_a_run_without_faults_has_a_beginning_too() -> None:
    clock = Anchor.here()
    with (
        router(scenario_with(), clock, grace_s=0.0) as (endpoint, _),
        ZenohSession.client(endpoint, "test") as session,
    ):
        before = clock.now()
        for node in ("r1", "controller"):
            session.announce(node, 1)
        eventually(lambda: plan_kept(session).since_ns < NEVER)
        plan = plan_kept(session)
        assert before <= plan.since_ns <= clock.now()
        assert plan == FaultPlan(
            since_ns=plan.since_ns, source="router", incarnation=1, stamp_ns=plan.since_ns
        )


def restoring(session: ZenohSession, clock: Anchor, *held: tuple[str, bytes], **lives: int) -> None:
    """Tell a router what was, as a host does."""
    store, known = LatchedStore(), Lives()
    for topic, data in held:
        assert store.keep(topic, data) == "news"
    for node, life in lives.items():
        known.seen(node, life)
    restore(session, clock, store.all(), known)
    session.settle()


def test_a_router_that_comes_back_learns_what_was() -> None:
    """Orders, last words of the dead, who has lived, what time it is; and the run does not begin again."""
    clock = Anchor.here(4.0)
    clock = msgspec.structs.replace(clock, monotonic_ns=clock.monotonic_ns - 100 * SECOND)
    plan = codec.encode(FaultPlan(source="operator", incarnation=9, since_ns=7))
    with (
        router(scenario_with(**FAULTY)) as (endpoint, host),
        ZenohSession.client(endpoint, "test") as session,
        ZenohSession.client(endpoint, "test") as late,
    ):
        orders: SimpleQueue[bytes] = SimpleQueue()
        late.subscribe(topics.STOP, lambda _, data: orders.put(data))
        late.settle()
        held = ((topics.STOP, stop(5)), (topics.PLAN, plan), (TOPIC, message(8, incarnation=3)))
        restoring(session, clock, *held, controller=2)
        assert orders.get(timeout=DEADLINE_S) == stop(5)  # who came in between hears it now
        for node in ("r1", "r2", "controller"):
            session.announce(node, 1)
        assert clock_of(late).epoch_ns == clock.epoch_ns
        for topic, data in held:
            assert late.ask(topic) == {topic: data}
        assert [claim(late, "r5"), late.ask("incarnation/r1"), late.ask("incarnation/controller")] == [
            1,
            {"incarnation/r1": b"4"},
            {"incarnation/controller": b"3"},
        ]
        assert eventually(lambda: host._service._begun)
        assert late.ask(topics.PLAN) == {topics.PLAN: plan}


def test_its_own_clock_and_what_is_newer_stay() -> None:
    clock = Anchor.here(4.0)
    other = msgspec.structs.replace(clock, epoch_ns=0, monotonic_ns=0)
    with (
        router(clock=clock) as (endpoint, _),
        ZenohSession.client(endpoint, "test") as session,
    ):
        session.put(topics.STOP, stop(5, stopped=False))
        restoring(session, other, (topics.STOP, stop(4)))
        assert session.ask(topics.STOP) == {topics.STOP: stop(5, stopped=False)}
        assert clock_of(session).epoch_ns == clock.epoch_ns


GARBAGE = (b"", b"\xc1", b"{}", b"null", b'{"clock":"1:2:3","lives":{"r1":"x"}}', b"\xff" * 100, bytes(1000))


@pytest.mark.parametrize("name", ["@told/seen", "@told/held/platoon/stop", "@told/held/no/topic", "@told/x"])
def test_garbage_is_counted_and_the_router_goes_on(name: str) -> None:
    with router(grace_s=0.0) as (endpoint, host), ZenohSession.client(endpoint, "test") as foe:
        for data in GARBAGE:
            foe.put_raw(name, data)
        foe.put_raw(name, b"flipped", crc_of(b"whole"))
        assert eventually(lambda: host.refused["malformed"] == len(GARBAGE))
        assert eventually(lambda: host.refused["corrupted"] == 1)
        foe.put(topics.STOP, stop(1))
        eventually(lambda: foe.ask(topics.STOP) == {topics.STOP: stop(1)})
        assert foe.ask("claim/r1/" + "9" * 5000) == {}
        assert foe.ask("claim/r1/x") == {}
        assert foe.ask("clock") != {}


def test_forged_lives_do_not_take_the_place_of_a_robots_last_word() -> None:
    with router(grace_s=0.0) as (endpoint, _), ZenohSession.client(endpoint, "test") as session:
        session.announce("r1", 1)
        session.settle()
        session.put(TOPIC, message(5))
        session.put(TOPIC, message(0, incarnation=2**60))
        session.put(TOPIC, message(6))
        assert eventually(lambda: session.ask(TOPIC) == {TOPIC: message(6)})


def test_a_router_dies_and_freezes_as_the_plan_says() -> None:
    met: SimpleQueue[Death | Pause] = SimpleQueue()
    clock = Anchor.here(4.0)
    with (
        router(clock=clock, grace_s=0.0, meet=lambda event, _: met.put(event)) as (endpoint, _),
        ZenohSession.client(endpoint, "test") as session,
    ):
        crash = {"node": "router", "at_s": 2.0, "restart_after_s": 1.0}
        freeze = {"node": "router", "at_s": 1.0, "for_s": 0.5}
        plan = msgspec.convert({"since_ns": clock.now(), "crashes": [crash], "freezes": [freeze]}, FaultPlan)
        session.put(topics.PLAN, codec.encode(msgspec.structs.replace(plan, incarnation=1)))
        assert isinstance(met.get(timeout=DEADLINE_S), Pause)
        assert isinstance(met.get(timeout=DEADLINE_S), Death)


@pytest.mark.slow
def test_one_that_starts_in_the_time_of_its_death_is_away_for_the_rest_of_it() -> None:
    clock = Anchor.here()
    plan = msgspec.convert(
        {"since_ns": clock.now() - 10 * SECOND, "crashes": [{"node": "router", "at_s": 9.0}]}, FaultPlan
    )
    brief = msgspec.structs.replace(
        plan, crashes=(msgspec.structs.replace(plan.crashes[0], restart_after_s=60.0),), incarnation=1
    )
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    for known, least, most in ((brief, 30.0, 60.0), (plan, float("inf"), float("inf"))):
        with ZenohSession.router(endpoint, "test") as session:
            host = RouterHost(session, clock)
            host.start()
            away: SimpleQueue[float] = SimpleQueue()
            thread = Thread(target=lambda host=host, away=away: away.put(host.run(0.0)))
            thread.start()
            with ZenohSession.client(endpoint, "test") as other:
                restoring(other, clock, (topics.PLAN, codec.encode(known)))
                assert least <= away.get(timeout=DEADLINE_S) <= most
            thread.join()


def test_serving_is_all_that_a_test_router_needs() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "test") as session:
        service = serve(session, Anchor.here())
        with ZenohSession.client(endpoint, "test") as other:
            other.put(topics.STOP, stop(1))
            other.settle()
            assert isinstance(codec.decode(topics.STOP, other.ask(topics.STOP)[topics.STOP]), EmergencyStop)
        assert service.settled
