"""MAVLink frames in streams, and links over real sockets and a pseudo-terminal."""

import os
import pty
import random
import socket
import tty
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.errors import TransportError
from maniple.transport.mavlink import MavlinkLink, load_dialect
from maniple.transport.mavlink_framing import Framer
from tests.waiting import eventually

MAV = load_dialect()


def frames(count: int, system: int = 7, first: int = 0) -> list[bytes]:
    """Packed by pymavlink itself: positions whose x tells which."""
    codec = MAV.MAVLink(None, system, 1)
    packed = []
    for index in range(first, first + count):
        codec.seq = index % 256
        packed.append(bytes(position(index).pack(codec)))
    return packed


def position(index: int) -> Any:
    return MAV.MAVLink_local_position_ned_message(index, float(index), 2.0, 3.0, 0.1, 0.2, 0.3)


def numbers(messages: list[Any]) -> list[int]:
    return [round(message.x) for message in messages]


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@given(data=st.data())
@settings(max_examples=30, deadline=None)
def test_frames_are_found_however_the_bytes_are_cut(data: st.DataObject) -> None:
    stream = b"".join(frames(12))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    framer = Framer(MAV)
    found = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += framer.feed(stream[begin:end])
    assert numbers(found) == list(range(12))
    assert (framer.bad, framer.lost) == (0, 0)


def test_version_1_is_understood() -> None:
    codec = MAV.MAVLink(None, 7, 1)
    (message,) = Framer(MAV).feed(bytes(position(3).pack(codec, force_mavlink1=True)))
    assert message.x == 3.0


def test_garbage_is_counted_and_costs_no_frame() -> None:
    framer = Framer(MAV)
    noise = random.Random(1)
    found = []
    for frame in frames(50):
        found += framer.feed(bytes(noise.randrange(0xFD) for _ in range(20)))
        found += framer.feed(frame)
    assert numbers(found) == list(range(50))
    assert framer.bad == 50


def test_a_damaged_frame_costs_itself_only() -> None:
    framer = Framer(MAV)
    first, second, third, *rest = frames(12)
    damaged = bytearray(second)
    damaged[1] = 255  # a length that would swallow what follows
    found = framer.feed(first + bytes(damaged) + third + b"".join(rest))
    assert numbers(found) == [0, *range(2, 12)]
    assert framer.bad == 1
    assert framer.lost == 1


def test_ten_thousand_damaged_frames() -> None:
    """Flipped bits, cut ends, noise: what is taken as a message was sent as one, and the others are found."""
    noise = random.Random(6)
    framer = Framer(MAV)
    sent = dict(enumerate(frames(10_000)))
    whole = set()
    stream = bytearray()
    for index, frame in sent.items():
        kind = noise.randrange(4)
        if kind == 0:
            whole.add(index)
            stream += frame
        elif kind == 1:
            stream += frame[: noise.randrange(len(frame))]
        elif kind == 2:
            broken = bytearray(frame)
            for _ in range(noise.randrange(1, 6)):
                broken[noise.randrange(len(broken))] ^= 1 << noise.randrange(8)
            stream += broken
        else:
            stream += noise.randbytes(noise.randrange(1, 40))
    found = []
    for begin in range(0, len(stream), 97):
        found += framer.feed(bytes(stream[begin : begin + 97]))
    found += framer.feed(bytes(300))
    kept = [m for m in found if m.get_type() == "LOCAL_POSITION_NED"]
    indices = numbers(kept)
    # A flip of bits may undo itself, and 16 bits of checksum let one in 65 536 through.
    assert len(whole - set(indices)) <= 2
    assert all(bytes(m.get_msgbuf()) == sent[round(m.x)] for m in kept)
    assert framer.bad > 1500  # runs: damaged frames in a row are one


def test_gaps_are_counted_and_what_comes_late_is_none() -> None:
    framer = Framer(MAV)
    a, b, c, d, e = frames(5, first=254)
    framer.feed(a + d + e + b)
    assert framer.lost == 2
    framer = Framer(MAV)
    framer.feed(a + b + c + d + b"".join(frames(3, system=8)))
    assert framer.lost == 0


def test_what_another_dialect_may_mean_is_left_out_and_not_bad() -> None:
    unknown = bytes([0xFD, 3, 0, 0, 0, 7, 1, 0xFF, 0xFF, 0xFE, 1, 2, 3, 9, 9])
    framer = Framer(MAV)
    assert numbers(framer.feed(unknown + frames(1)[0])) == [0]
    assert framer.bad == 0
    assert framer.feed(unknown + b"\x00" * 300) == []
    assert framer.bad == 1


@pytest.fixture
def links() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def opened(links: ExitStack, connection: str, system: int, timeout_s: float = 0.0) -> MavlinkLink:
    link = MavlinkLink.open(connection, system, 1, timeout_s=timeout_s)
    links.callback(link.close)
    return link


def heard(link: MavlinkLink, count: int = 1) -> list[Any]:
    got: list[Any] = []

    def enough() -> bool:
        got.extend(link.receive())
        return len(got) >= count

    eventually(enough, 10.0)
    return got


def meet(one: MavlinkLink, other: MavlinkLink) -> bool:
    for link in (one, other):
        link.receive()
    return one.connected and other.connected


@pytest.mark.parametrize(("one", "other"), [("tcpin", "tcp"), ("udpin", "udpout")])
def test_both_ways_over_sockets(links: ExitStack, one: str, other: str) -> None:
    port = free_port(socket.SOCK_DGRAM if one == "udpin" else socket.SOCK_STREAM)
    server = opened(links, f"{one}:127.0.0.1:{port}", 1)
    assert not server.connected
    client = opened(links, f"{other}:127.0.0.1:{port}", 255, timeout_s=5.0)
    client.send(position(1))
    (first,) = heard(server)
    assert (first.x, first.get_srcSystem()) == (1.0, 255)
    server.send(position(2))
    server.send(position(3))
    assert numbers(heard(client, 2)) == [2, 3]
    assert server.connected
    assert (client.bad, client.lost, client.dropped, client.reason) == (0, 0, 0, "")


def test_over_a_serial_port(links: ExitStack) -> None:
    master, slave = pty.openpty()
    links.callback(os.close, master)
    tty.setraw(slave)
    link = opened(links, f"serial:{os.ttyname(slave)}:57600", 255, timeout_s=5.0)
    os.close(slave)
    os.write(master, b"boot\r\n" + frames(1)[0])
    assert numbers(heard(link)) == [0]
    assert link.bad == 1
    link.send(position(5))
    assert Framer(MAV).feed(os.read(master, 1000))[0].x == 5.0


def test_a_serial_port_that_is_not_there_is_looked_for_again(links: ExitStack) -> None:
    link = opened(links, "serial:/dev/no-such-port:57600", 255)
    eventually(lambda: link.receive() or link.reason, 10.0)
    assert "No such file or directory" in link.reason
    assert not link.connected


def test_tcp_comes_back(links: ExitStack) -> None:
    port = free_port()
    client = opened(links, f"tcp:127.0.0.1:{port}", 255)
    eventually(lambda: client.receive() or "Connection refused" in client.reason, 10.0)
    for _ in range(2):
        server = MavlinkLink.open(f"tcpin:127.0.0.1:{port}", 1, 1)
        eventually(partial(meet, client, server), 10.0)
        server.send(position(4))
        assert numbers(heard(client)) == [4]
        server.close()
        eventually(lambda: client.receive() or not client.connected, 10.0)
        assert client.reason
        client.send(position(5))  # goes nowhere, and does not fail


def test_several_vehicles_on_one_port_are_answered_each(links: ExitStack) -> None:
    port = free_port(socket.SOCK_DGRAM)
    ground = opened(links, f"udpin:127.0.0.1:{port}", 255)
    vehicles = [opened(links, f"udpout:127.0.0.1:{port}", system, 5.0) for system in (1, 2)]
    for vehicle in vehicles:
        vehicle.send(position(0))
    assert {message.get_srcSystem() for message in heard(ground, 2)} == {1, 2}
    ground.send(MAV.MAVLink_command_long_message(2, 1, 512, 0, *[0.0] * 7))
    assert [m.get_type() for m in heard(vehicles[1])] == ["COMMAND_LONG"]
    ground.send(position(1), to=1)
    assert [m.get_type() for m in heard(vehicles[0])] == ["LOCAL_POSITION_NED"]
    ground.send(position(2))
    assert numbers(heard(vehicles[0])) == numbers(heard(vehicles[1])) == [2]


def test_noise_on_a_listening_port_makes_no_peer(links: ExitStack) -> None:
    port = free_port(socket.SOCK_DGRAM)
    ground = opened(links, f"udpin:127.0.0.1:{port}", 255)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
        for index in range(40):
            noise.sendto(bytes([index] * 30), ("127.0.0.1", port))
        eventually(lambda: ground.receive() or ground.bad == 40, 10.0)
    assert not ground.connected


def test_who_takes_nothing_blocks_nobody(links: ExitStack) -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        link = opened(links, f"tcp:127.0.0.1:{deaf.getsockname()[1]}", 255, timeout_s=5.0)
        for index in range(200_000):
            link.send(position(index))
            if link.dropped > 10:
                break
        assert link.dropped > 10


def test_what_can_not_be_opened_is_told(links: ExitStack) -> None:
    with pytest.raises(TransportError, match="MAVLink connection 'tcp:x': must be 'serial"):
        MavlinkLink.open("tcp:x", 255, 1)
    port = free_port()
    with pytest.raises(TransportError, match=rf"tcp:127.0.0.1:{port}: Connection refused \(waited 0.2 s\)"):
        MavlinkLink.open(f"tcp:127.0.0.1:{port}", 255, 1, timeout_s=0.2)
    opened(links, f"tcpin:127.0.0.1:{port}", 1)
    with pytest.raises(TransportError, match=f"tcpin:127.0.0.1:{port}: Address already in use"):
        MavlinkLink.open(f"tcpin:127.0.0.1:{port}", 1, 1)


def test_closed_twice_is_closed(links: ExitStack) -> None:
    link = opened(links, f"tcp:127.0.0.1:{free_port()}", 255)
    link.close()
    link.close()
    assert link.receive() == []
    assert not link.connected
