"""Connection strings."""

import pytest

from maniple.core.connections import other_end, parse_connection
from maniple.core.errors import ArgumentError


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("serial:/dev/ttyUSB0:57600", ("serial", "/dev/ttyUSB0", 57600)),
        ("serial:/dev/serial/by-id/usb-a:b:115200", ("serial", "/dev/serial/by-id/usb-a:b", 115200)),
        ("udpin:0.0.0.0:14550", ("udpin", "0.0.0.0", 14550)),
        ("udpout:rover.local:14550", ("udpout", "rover.local", 14550)),
        ("tcp:[::1]:5760", ("tcp", "::1", 5760)),
    ],
)
def test_taken_apart_and_written_again(text: str, parts: tuple[str, str, int]) -> None:
    assert parse_connection(text) == parts
    assert str(parse_connection(text)) == text


@pytest.mark.parametrize(
    "text", ["", "tcp", "tcp:host", "tcp::5760", "udp:h:1", "tcp:h:x", "tcp:h:-1", "tcp:h:٣", "/dev/ttyUSB0"]
)
def test_what_is_no_connection_is_told_what_is(text: str) -> None:
    with pytest.raises(ArgumentError, match="must be 'serial:/dev/ttyUSB0:57600', 'udpin"):
        parse_connection(text)


def test_ports_and_baud_rates_have_bounds() -> None:
    with pytest.raises(ArgumentError, match="its port must be 1 to 65535"):
        parse_connection("tcp:host:65536")
    with pytest.raises(ArgumentError, match="its baud rate must be 1 to"):
        parse_connection("serial:/dev/ttyUSB0:0")


@pytest.mark.parametrize(
    ("driver", "vehicle"),
    [
        ("tcp:127.0.0.1:5790", "tcpin:127.0.0.1:5790"),
        ("udpin:0.0.0.0:14000", "udpout:127.0.0.1:14000"),
        ("tcpin:[::]:14000", "tcp:[::1]:14000"),
        ("udpin:10.0.0.5:14000", "udpout:10.0.0.5:14000"),
        ("udpout:localhost:14000", "udpin:localhost:14000"),
    ],
)
def test_the_other_end(driver: str, vehicle: str) -> None:
    assert other_end(driver) == vehicle


def test_a_cable_has_no_other_end_here() -> None:
    with pytest.raises(ArgumentError, match="nothing of this machine"):
        other_end("serial:/dev/ttyUSB0:57600")
