"""Real Zenoh sessions over loopback: a router and clients in one process."""

import socket
from collections.abc import Iterator
from queue import SimpleQueue

import pytest

from maniple.core.errors import TransportError
from maniple.transport.zenoh import ZenohSession

DEADLINE_S = 20.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "test"):
        yield address


def test_what_one_puts_another_receives_in_order(endpoint: str) -> None:
    heard: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        ear.subscribe("robot/*/odometry", lambda topic, data: heard.put((topic, data)))
        ear.settle()
        for number in range(100):
            mouth.put("robot/r1/odometry", b"%d" % number)
        got = [heard.get(timeout=DEADLINE_S) for _ in range(100)]
    assert got == [("robot/r1/odometry", b"%d" % number) for number in range(100)]


def test_nobody_hears_itself_or_another_prefix(endpoint: str) -> None:
    heard: SimpleQueue[str] = SimpleQueue()
    with (
        ZenohSession.client(endpoint, "test") as one,
        ZenohSession.client(endpoint, "other") as stranger,
        ZenohSession.client(endpoint, "test") as friend,
    ):
        one.subscribe("**", lambda topic, _: heard.put(topic))
        one.settle()
        one.put("robot/r1/odometry", b"mine")
        stranger.put("robot/r2/odometry", b"foreign")
        friend.put("robot/r3/odometry", b"wanted")
        assert heard.get(timeout=DEADLINE_S) == "robot/r3/odometry"
    assert heard.empty()


def test_raw_bytes_pass_on_any_name(endpoint: str) -> None:
    heard: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        ear.subscribe("**", lambda topic, data: heard.put((topic, data)))
        ear.settle()
        mouth.put_raw("no/such/topic", b"\xff")
        assert heard.get(timeout=DEADLINE_S) == ("no/such/topic", b"\xff")


def test_questions_are_answered_by_who_serves(endpoint: str) -> None:
    with ZenohSession.client(endpoint, "test") as asker, ZenohSession.client(endpoint, "test") as server:
        server.serve("formation/*", lambda name: {name: b"kept"})
        server.settle()
        assert asker.ask("formation/state", timeout_s=DEADLINE_S) == {"formation/state": b"kept"}


def test_lives_are_seen_to_begin_and_end_and_by_late_comers_too(endpoint: str) -> None:
    early: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
    late: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as watcher:
        watcher.watch(lambda *life: early.put(life))
        node = ZenohSession.client(endpoint, "test")
        node.announce("r1", 2)
        assert early.get(timeout=DEADLINE_S) == ("r1", 2, True)
        with ZenohSession.client(endpoint, "test") as second:
            second.watch(lambda *life: late.put(life))
            assert late.get(timeout=DEADLINE_S) == ("r1", 2, True)
        node.close()
        assert early.get(timeout=DEADLINE_S) == ("r1", 2, False)


def test_an_address_in_use_is_one_clear_message(endpoint: str) -> None:
    with pytest.raises(TransportError, match=f"can't listen on {endpoint}"):
        ZenohSession.router(endpoint, "test")


def test_no_router_is_one_clear_message() -> None:
    with pytest.raises(TransportError, match=r"can.t reach a router at tcp/127\.0\.0\.1:1 within 0\.3 s"):
        ZenohSession.client("tcp/127.0.0.1:1", "test", timeout_s=0.3)


def test_what_is_no_endpoint_is_one_clear_message() -> None:
    with pytest.raises(TransportError, match="an endpoint looks like tcp/"):
        ZenohSession.client("nonsense", "test", timeout_s=0.3)
