"""What a router keeps."""

import msgspec
import pytest

from maniple.core import codec
from maniple.core.errors import TransportError
from maniple.host.clock import Anchor
from maniple.host.latched import LatchedStore, Lives
from maniple.host.router import RouterHost, claim, clock_of, serve
from maniple.transport.zenoh import ZenohSession
from tests.host.nodes import odometry
from tests.transport.test_zenoh import DEADLINE_S, free_port

TOPIC = "robot/r1/odometry"


def message(seq: int, incarnation: int = 1, source: str = "r1") -> bytes:
    made = odometry("r1")
    return codec.encode(msgspec.structs.replace(made, source=source, incarnation=incarnation, seq=seq))


def test_the_newest_message_is_kept() -> None:
    store = LatchedStore()
    assert store.answer(TOPIC) == {}
    for data in (message(1), message(3), message(2), b"garbage", message(9, source="r2")):
        store.keep(TOPIC, data)
    assert store.answer(TOPIC) == {TOPIC: message(3)}


def test_a_newer_life_replaces_an_older_one() -> None:
    store = LatchedStore()
    for data in (message(70, incarnation=1), message(0, incarnation=2), message(71, incarnation=1)):
        store.keep(TOPIC, data)
    assert store.answer(TOPIC) == {TOPIC: message(0, incarnation=2)}


def test_lives_are_numbered_from_one_and_never_twice() -> None:
    lives = Lives()
    assert lives.next("r1") == 1
    lives.seen("r1", 4)
    lives.seen("r1", 2)
    assert lives.next("r1") == 5
    assert [lives.claim("r1"), lives.claim("r1"), lives.claim("r1", 9), lives.claim("r1")] == [5, 6, 9, 10]
    assert lives.claim("r1", 10) == 11  # it was there already
    assert lives.claim("r1", 11) == 11


def test_a_late_joiner_gets_what_is_latched_from_a_real_router() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "test") as router:
        host = RouterHost(router)
        host.stop()
        host.run(patience_s=0.0)
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


@pytest.mark.parametrize("speed", [3.0, None])
def test_who_joins_a_run_has_its_clock(speed: float | None) -> None:
    """As exact as the answer is fast; the wall clock if the router was given none."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    clock = Anchor.here(1.0 if speed is None else speed)
    if speed is not None:
        clock = msgspec.structs.replace(clock, epoch_ns=clock.epoch_ns + 10**12)
    with ZenohSession.router(endpoint, "test") as router:
        serve(router, None if speed is None else clock)
        with ZenohSession.client(endpoint, "test") as late:
            joined = clock_of(late)
    assert joined.speed == clock.speed
    assert abs(joined.at(joined.monotonic_ns) - clock.at(joined.monotonic_ns)) < 2e9 * clock.speed
