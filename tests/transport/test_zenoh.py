"""Real Zenoh sessions over loopback: a router and clients in one process."""

import socket
import time
import zlib
from collections.abc import Iterator
from queue import SimpleQueue

import pytest

from maniple.core.errors import TransportError
from maniple.transport.zenoh import MAX_BYTES, ZenohSession, crc_of
from tests.waiting import eventually

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


def test_what_is_put_carries_the_crc_of_its_bytes(endpoint: str) -> None:
    assert crc_of(b"maniple") == zlib.crc32(b"maniple").to_bytes(4, "little")
    attachments: SimpleQueue[bytes | None] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        ear._session.declare_subscriber(  # as any other program on the network would hear it
            "test/robot/r1/odometry",
            lambda sample: attachments.put(
                None if sample.attachment is None else sample.attachment.to_bytes()
            ),
        )
        ear.settle()
        mouth.put("robot/r1/odometry", b"bytes")
        assert attachments.get(timeout=DEADLINE_S) == crc_of(b"bytes")


def test_flipped_bits_and_huge_payloads_reach_nobody_and_are_told(endpoint: str) -> None:
    heard: SimpleQueue[tuple[str, str]] = SimpleQueue()
    name = "robot/r1/odometry"
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        ear.subscribe("**", lambda _, data: heard.put(("", data.decode())), lambda *why: heard.put(why))
        ear.settle()
        mouth.put_raw(name, b"what was s\x00nt", crc_of(b"what was sent"))
        mouth.put_raw(name, b"nothing to check", None)
        mouth.put_raw(name, b"of another kind", bytes(33))
        mouth.put_in_order(name, bytes(MAX_BYTES + 1))  # raw, a busy router may drop it
        mouth.put_raw(name, b"whole", crc_of(b"whole"))
        told = [heard.get(timeout=DEADLINE_S) for _ in range(5)]
    assert told == [
        (name, "corrupted"),
        ("", "nothing to check"),
        ("", "of another kind"),
        (name, "huge"),
        ("", "whole"),
    ]


def test_who_has_sent_a_crc_once_is_not_believed_without(endpoint: str) -> None:
    heard: SimpleQueue[tuple[str, str]] = SimpleQueue()
    name = "robot/r1/odometry"
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        ear.subscribe(
            name, lambda _, data: heard.put(("", data.decode())), lambda *why: heard.put(why), lambda _: True
        )
        ear.settle()
        for data, crc in (
            (b"first", None),
            (b"sealed", crc_of(b"sealed")),
            (b"forged", None),
            (b"odd", bytes(33)),
        ):
            mouth.put_raw(name, data, crc)
        told = [heard.get(timeout=DEADLINE_S) for _ in range(4)]
    assert told == [("", "first"), ("", "sealed"), (name, "unsealed"), (name, "unsealed")]


@pytest.mark.parametrize(
    "token", ["r1/0", "r1/-1", "r1/x", "r1/" + "9" * 5000, "r1/\u0663", "-r1/1", "r 1/1"]
)
def test_tokens_that_are_no_life_of_a_node_are_nobody(endpoint: str, token: str) -> None:
    seen: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
    with (
        ZenohSession.client(endpoint, "test") as watcher,
        ZenohSession.client(endpoint, "test") as forger,
        ZenohSession.client(endpoint, "test") as asker,
    ):
        kept = forger._session.liveliness().declare_token(f"test/alive/{token}")
        forger.announce("r2", 1)
        watcher.watch(lambda *life: seen.put(life))
        assert seen.get(timeout=DEADLINE_S) == ("r2", 1, True)
        assert asker.everyone() == {"r2": (1,)}
        kept.undeclare()
        forger.close()
        assert seen.get(timeout=DEADLINE_S) == ("r2", 1, False)


def test_a_session_is_back_when_its_router_is() -> None:
    """However long that takes: longer than one attempt to connect does."""
    address = f"tcp/127.0.0.1:{free_port()}"
    heard: SimpleQueue[bytes] = SimpleQueue()
    router = ZenohSession.router(address, "test")
    with (
        ZenohSession.client(address, "test", timeout_s=0.3) as ear,
        ZenohSession.client(address, "test", timeout_s=0.3) as mouth,
    ):
        ear.subscribe("formation/state", lambda _, data: heard.put(data))
        router.close()
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            mouth.put("formation/state", b"lost")
        with ZenohSession.router(address, "test"):
            until = time.monotonic() + DEADLINE_S
            while heard.empty() and time.monotonic() < until:
                mouth.put("formation/state", b"heard")
                time.sleep(0.01)
            assert heard.get_nowait() == b"heard"


def test_what_is_put_in_order_arrives_so_with_its_encoding_and_seal(endpoint: str) -> None:
    names = ("robot/r1/command", "journal/r1", "made/up", "robot/r1/odometry")
    heard: SimpleQueue[tuple[str, bytes, bytes, str]] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as ear, ZenohSession.client(endpoint, "test") as mouth:
        subscriber = ear._session.declare_subscriber(
            "test/**",
            lambda sample: heard.put(
                (
                    str(sample.key_expr),
                    sample.payload.to_bytes(),
                    b"" if sample.attachment is None else sample.attachment.to_bytes(),
                    str(sample.encoding),
                )
            ),
        )
        ear.settle()
        for number in range(10_000):
            name = names[number % 4]
            mouth.put_in_order(name, b"%d" % number, None if name == "made/up" else "text/plain")
        got = [heard.get(timeout=DEADLINE_S) for _ in range(10_000)]
        subscriber.undeclare()
    for number, (key, data, seal, encoding) in enumerate(got):
        assert key == f"test/{names[number % 4]}"
        assert data == b"%d" % number
        assert seal == crc_of(data)
        assert encoding == ("zenoh/bytes" if key == "test/made/up" else "text/plain")


def test_who_is_withdrawn_is_there_no_more(endpoint: str) -> None:
    changes: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as watcher, ZenohSession.client(endpoint, "test") as node:
        watcher.watch(lambda *life: changes.put(life))
        node.announce("r1", 2)
        assert changes.get(timeout=DEADLINE_S) == ("r1", 2, True)
        node.withdraw("r1", 2)
        assert changes.get(timeout=DEADLINE_S) == ("r1", 2, False)
        node.announce("r1", 2)
        assert changes.get(timeout=DEADLINE_S) == ("r1", 2, True)


def test_a_client_knows_whether_it_has_its_router() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohSession.router(address, "test")
    with ZenohSession.client(address, "test", timeout_s=0.5) as client:
        assert client.connected
        router.close()
        eventually(lambda: not client.connected)
        with ZenohSession.router(address, "test"):
            eventually(lambda: client.connected)


def test_raw_publishers_reach_raw_subscribers_with_their_attachments_until_it_ends(endpoint: str) -> None:
    heard: SimpleQueue[tuple[str, bytes, bytes | None]] = SimpleQueue()
    with ZenohSession.client(endpoint, "") as ear, ZenohSession.client(endpoint, "test") as mouth:
        end = ear.subscribe_raw("test/**", lambda *sample: heard.put(sample))
        ear.settle()
        publisher = mouth.raw_publisher("odd/name")
        publisher.put(b"with", b"attachment")
        publisher.put(b"without")
        assert heard.get(timeout=DEADLINE_S) == ("test/odd/name", b"with", b"attachment")
        assert heard.get(timeout=DEADLINE_S) == ("test/odd/name", b"without", None)
        end()
        end()
        ear.settle()
        publisher.put(b"nobody")
        mouth.settle()
    assert heard.empty()


def test_huge_bytes_do_not_reach_raw_subscribers(endpoint: str) -> None:
    heard: SimpleQueue[bytes] = SimpleQueue()
    with ZenohSession.client(endpoint, "") as ear, ZenohSession.client(endpoint, "") as mouth:
        ear.subscribe_raw("big", lambda _name, data, _attachment: heard.put(data))
        ear.settle()
        mouth.put_raw("big", bytes(MAX_BYTES + 1))
        mouth.put_raw("big", b"small")
        assert heard.get(timeout=DEADLINE_S) == b"small"


def test_who_comes_late_gets_the_history_of_a_raw_publisher(endpoint: str) -> None:
    heard: SimpleQueue[bytes] = SimpleQueue()
    with ZenohSession.client(endpoint, "") as ear, ZenohSession.client(endpoint, "") as mouth:
        publisher = mouth.raw_publisher("kept", history=2)
        for number in range(4):
            publisher.put(b"%d" % number)
        mouth.settle()
        ear.subscribe_raw("kept", lambda _name, data, _attachment: heard.put(data), history=2)
        assert [heard.get(timeout=DEADLINE_S) for _ in range(2)] == [b"2", b"3"]


def test_tokens_are_seen_to_come_and_go(endpoint: str) -> None:
    seen: SimpleQueue[tuple[str, bool]] = SimpleQueue()
    with ZenohSession.client(endpoint, "") as ear, ZenohSession.client(endpoint, "") as mouth:
        end = mouth.declare_token("@space/a%b/§")
        ear.watch_tokens("@space/**", lambda *change: seen.put(change))
        assert seen.get(timeout=DEADLINE_S) == ("@space/a%b/§", True)
        end()
        assert seen.get(timeout=DEADLINE_S) == ("@space/a%b/§", False)
        assert mouth.zid != ear.zid
