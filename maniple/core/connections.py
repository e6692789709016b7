"""Connection strings of MAVLink vehicles, as text."""

import ipaddress
from collections.abc import Mapping
from typing import Literal, NamedTuple, TypeAlias

from maniple.core.errors import ArgumentError

Kind: TypeAlias = Literal["serial", "udpin", "udpout", "tcp", "tcpin"]
"""A serial port; UDP, listening for who sends, or sending first; TCP, connecting, or waiting for who
connects."""

FORMS = (
    "'serial:/dev/ttyUSB0:57600', 'udpin:0.0.0.0:14550', 'udpout:HOST:PORT', 'tcp:HOST:PORT' or "
    "'tcpin:0.0.0.0:PORT'"
)
"""What is valid, in words for people."""

_KINDS: Mapping[str, Kind] = {
    "serial": "serial",
    "udpin": "udpin",
    "udpout": "udpout",
    "tcp": "tcp",
    "tcpin": "tcpin",
}
_OTHER: Mapping[Kind, Kind] = {"udpin": "udpout", "udpout": "udpin", "tcp": "tcpin", "tcpin": "tcp"}


class Connection(NamedTuple):
    """One connection string, taken apart."""

    kind: Kind
    where: str
    """A device, or a host's name or address."""
    number: int
    """Baud rate, or port."""

    def __str__(self) -> str:
        where = f"[{self.where}]" if ":" in self.where and self.kind != "serial" else self.where
        return f"{self.kind}:{where}:{self.number}"


def parse_connection(text: str) -> Connection:
    """A connection string, taken apart.

    Raises:
        ArgumentError: it is none.
    """
    name, _, rest = text.partition(":")
    kind = _KINDS.get(name)
    where, _, number = rest.rpartition(":")
    if where.startswith("[") and where.endswith("]"):
        where = where[1:-1]
    most = 10_000_000 if kind == "serial" else 65535
    if kind is None or not where or not number.isascii() or not number.isdigit():
        raise ArgumentError(f"MAVLink connection {text!r}: must be {FORMS}")
    if not 1 <= int(number) <= most:
        what = "baud rate" if kind == "serial" else "port"
        raise ArgumentError(f"MAVLink connection {text!r}: its {what} must be 1 to {most}")
    return Connection(kind, where, int(number))


def other_end(text: str) -> str:
    """What the vehicle opens on this machine for the driver to find it at `text`, and the other way round.

    Raises:
        ArgumentError: it is no connection string, or one of a serial port: a cable has no name there.
    """
    connection = parse_connection(text)
    if connection.kind == "serial":
        raise ArgumentError(f"MAVLink connection {text!r}: nothing of this machine is at its other end")
    where = connection.where
    if connection.kind in ("udpin", "tcpin"):
        where = _reachable(where)
    return str(connection._replace(kind=_OTHER[connection.kind], where=where))


def _reachable(where: str) -> str:
    """An address of this machine at which a listener on `where` is found."""
    try:
        address = ipaddress.ip_address(where)
    except ValueError:
        return where
    if not address.is_unspecified:
        return where
    return "127.0.0.1" if address.version == 4 else "::1"
