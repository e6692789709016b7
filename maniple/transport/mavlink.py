"""MAVLink over serial ports, UDP and TCP. The only file that opens such connections.

Nothing here blocks: what takes longer (names to look up, connections to be made) goes on in a thread of its
own, and is asked after in `receive`. A connection that is lost is made anew.

Only pymavlink's dialect is loaded, at the first use: 60 ms and 14 MB, where its `mavutil` takes 180 ms and
30 MB.
"""

import importlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from maniple.core.connections import Connection, other_end, parse_connection
from maniple.core.errors import ArgumentError, MissingExtraError, TransportError
from maniple.transport.mavlink_framing import Framer

__all__ = ["MavlinkLink", "load_dialect", "other_end"]

RETRY_S = 0.5
"""From one attempt to connect to the next."""

_CONNECT_S = 2.0
"""One attempt takes at most so long."""
_UNACKNOWLEDGED_MS = 3000
"""TCP gives a connection up that does not confirm what was sent for so long."""
_MOST_BYTES = 1 << 15
"""Taken from one peer in one `receive`."""
_MOST_WAITING = 4096
"""Bytes kept for a peer that takes none; beyond, whole messages are dropped."""
_MOST_PEERS = 16


def load_dialect(serial: bool = False) -> Any:
    """pymavlink's messages, those of ArduPilot among them. With `serial` pyserial has to be there, too.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        from pymavlink.dialects.v20 import ardupilotmega

        if serial:
            importlib.import_module("serial")
    except ImportError as error:
        raise MissingExtraError(f"MAVLink ({error.name})", "mavlink") from None
    return ardupilotmega


class _Wire(Protocol):
    """Where the bytes of one peer go through. Both raise OSError once it is lost."""

    def read(self) -> bytes:
        """What has arrived; empty where nothing has."""
        ...

    def write(self, data: bytes) -> int:
        """How many of the bytes were taken."""
        ...

    def close(self, abandon: bool = False) -> None:
        """Let it go; with `abandon` what is still under way is thrown away."""
        ...


class _Tcp:
    """One TCP connection."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACKNOWLEDGED_MS)
        self._socket = connected

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_MOST_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the other side has closed it")
        return data

    def write(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0

    def close(self, abandon: bool = False) -> None:
        if abandon:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()


class _Serial:
    """One serial port."""

    def __init__(self, connection: Connection) -> None:
        import serial

        self._port = serial.Serial(
            connection.where, connection.number, timeout=0, write_timeout=0, exclusive=True
        )  # its SerialException is an OSError

    def read(self) -> bytes:
        return bytes(self._port.read(_MOST_BYTES))

    def write(self, data: bytes) -> int:
        return self._port.write(data) or 0

    def close(self, abandon: bool = False) -> None:
        if abandon:
            with suppress(OSError):
                self._port.reset_output_buffer()
        self._port.close()


class _Datagrams:
    """One peer of a UDP socket: the one it is connected to, or one that sends to it, with `address`."""

    def __init__(self, bound: socket.socket, address: Any = None) -> None:
        self._socket, self._address = bound, address

    def read(self) -> bytes:
        """Of the socket's only peer; what came to a listening socket is handed out by address."""
        received = bytearray()
        with suppress(BlockingIOError, ConnectionRefusedError):  # nobody there yet is no loss
            while len(received) < _MOST_BYTES:
                received += self._socket.recv(_MOST_BYTES)
        return bytes(received)

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError, ConnectionRefusedError):
            if self._address is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, self._address)
        return len(data)  # a datagram is taken whole or lost

    def close(self, abandon: bool = False) -> None:  # noqa: ARG002
        if self._address is None:
            self._socket.close()


class _Peer:
    """One end of the link: a wire, what is half received from it and half sent to it, who is behind it."""

    def __init__(self, wire: _Wire, dialect: Any, system_id: int, component_id: int) -> None:
        self.wire = wire
        self.framer = Framer(dialect)
        self.systems: set[int] = set()
        self.dropped = 0
        self._codec = dialect.MAVLink(None, system_id, component_id)
        self._waiting = bytearray()

    def take(self, data: bytes) -> list[Any]:
        """The messages complete with `data`."""
        messages = self.framer.feed(data)
        self.systems.update(message.get_srcSystem() for message in messages)
        return messages

    def send(self, message: Any) -> None:
        """Whole, or not at all.

        Raises:
            OSError: the wire is lost.
        """
        self.flush()
        if len(self._waiting) > _MOST_WAITING:
            self.dropped += 1
            return
        self._waiting += message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.flush()

    def flush(self) -> None:
        """Pass on what waits, as far as it is taken.

        Raises:
            OSError: the wire is lost.
        """
        if self._waiting:
            del self._waiting[: self.wire.write(bytes(self._waiting))]


class MavlinkLink:
    """One MAVLink connection, with one peer or, where others come to it, with several.

    Messages are pymavlink's, of the module `dialect`. Only one thread may use a link.
    """

    def __init__(self, connection: str, system_id: int, component_id: int) -> None:
        """As `open`, without waiting."""
        try:
            self.connection = parse_connection(connection)
        except ArgumentError as error:
            raise TransportError(str(error)) from None
        self.dialect = load_dialect(self.connection.kind == "serial")
        self.reason = ""
        """Why it is not connected; empty while it is."""
        self._ids = system_id, component_id
        self._peers: dict[Any, _Peer] = {}
        self._listening: socket.socket | None = None
        self._attempt: _Attempt | None = None
        self._next_try = 0.0
        self._bad = self._lost = self._dropped = 0
        if self.connection.kind in ("udpin", "tcpin"):
            self._listening = self._listen()
            self.reason = f"{self.connection}: nobody has come yet"

    @classmethod
    def open(
        cls, connection: str, system_id: int, component_id: int, timeout_s: float = 0.0
    ) -> "MavlinkLink":
        """A link under one's own ids.

        With a `timeout_s` it waits until it is connected; without, it returns at once and goes on connecting
        in `receive`.

        Raises:
            TransportError: the string is no connection; its port is taken on this machine; it is not
                connected in time.
            MissingExtraError: pymavlink or pyserial is not installed.
        """
        link = cls(connection, system_id, component_id)
        until = time.monotonic() + timeout_s
        link._keep()
        while not link.connected and time.monotonic() < until:
            time.sleep(0.01)
            link._keep()
        if timeout_s > 0.0 and not link.connected:
            reason = link.reason
            link.close()
            raise TransportError(f"{reason} (waited {timeout_s:g} s)")
        return link

    @property
    def connected(self) -> bool:
        """Whether there is anybody to send to. (Over UDP and serial ports that is known of a listener only,
        which has heard somebody: heartbeats tell the rest.)"""
        return bool(self._peers)

    @property
    def bad(self) -> int:
        """Runs of bytes that were no frame."""
        return self._bad + sum(peer.framer.bad for peer in self._peers.values())

    @property
    def lost(self) -> int:
        """Frames that are missing, by their sequence numbers."""
        return self._lost + sum(peer.framer.lost for peer in self._peers.values())

    @property
    def dropped(self) -> int:
        """Messages that were not sent because the peer took none."""
        return self._dropped + sum(peer.dropped for peer in self._peers.values())

    def receive(self) -> list[Any]:
        """The messages that have arrived, of each peer oldest first. It also keeps the connection."""
        self._keep()
        if self._listening is not None and self.connection.kind == "udpin":
            return self._hear()
        messages = []
        for key, peer in list(self._peers.items()):
            try:
                peer.flush()
                messages += peer.take(peer.wire.read())
            except OSError as error:
                self._lose(key, error)
        return messages

    def send(self, message: Any, to: int = 0) -> None:
        """To the system `to`, by default the message's own target; to all where that is nobody who was heard.
        Nothing where nobody is connected."""
        target = to or getattr(message, "target_system", 0)
        known = any(target in peer.systems for peer in self._peers.values())
        for key, peer in list(self._peers.items()):
            if known and target not in peer.systems:
                continue
            try:
                peer.send(message)
            except OSError as error:
                self._lose(key, error)

    def close(self, abandon: bool = False) -> None:
        """Let go of everything; with `abandon` what was sent and has not left yet is thrown away, where the
        system can. A second time it does nothing."""
        for key in list(self._peers):
            self._forget(key, abandon)
        if self._listening is not None:
            self._listening.close()
            self._listening = None
        if self._attempt is not None:
            self._attempt.abandon()
            self._attempt = None
        self._next_try = float("inf")
        self.reason = "closed"

    def _listen(self) -> socket.socket:
        """A socket that others come to."""
        kind, where, port = self.connection
        stream = kind == "tcpin"
        try:
            family, _, _, _, address = socket.getaddrinfo(where, port, flags=socket.AI_PASSIVE)[0]
            listening = socket.socket(family, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM)
        except OSError as error:
            raise TransportError(f"{self.connection}: {_words(error)}") from None
        try:
            listening.setblocking(False)
            if stream:
                listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(address)
            if stream:
                listening.listen(_MOST_PEERS)
        except OSError as error:
            listening.close()
            raise TransportError(f"{self.connection}: {_words(error)}") from None
        return listening

    def _keep(self) -> None:
        """Take what has come, or connect again where the connection is gone."""
        if self._listening is not None:
            if self.connection.kind == "tcpin":
                self._accept(self._listening)
            return
        if self._peers:
            return
        if self._attempt is None:
            if time.monotonic() >= self._next_try:
                self._next_try = time.monotonic() + RETRY_S
                self._attempt = _Attempt(self._make)
            return
        if self._attempt.is_alive():
            return
        attempt, self._attempt = self._attempt, None
        if attempt.wire is None:
            self.reason = f"{self.connection}: {_words(attempt.error)}"
        else:
            self.reason = ""
            self._add(None, attempt.wire)

    def _make(self) -> _Wire:
        """Connect; may take its time."""
        kind, where, number = self.connection
        if kind == "serial":
            return _Serial(self.connection)
        if kind == "tcp":
            return _Tcp(socket.create_connection((where, number), _CONNECT_S))
        family, _, _, _, address = socket.getaddrinfo(where, number, type=socket.SOCK_DGRAM)[0]
        made = socket.socket(family, socket.SOCK_DGRAM)
        try:
            made.setblocking(False)
            made.connect(address)
        except OSError:
            made.close()
            raise
        return _Datagrams(made)

    def _accept(self, listening: socket.socket) -> None:
        """Those who have connected."""
        while True:
            try:
                client, address = listening.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:
                self.reason = f"{self.connection}: {_words(error)}"
                return
            if len(self._peers) >= _MOST_PEERS:
                client.close()
                continue
            self._add(address, _Tcp(client))

    def _hear(self) -> list[Any]:
        """What came to the listening UDP socket, by who sent it. Only who says a message is a peer."""
        assert self._listening is not None
        messages: list[Any] = []
        taken = 0
        while taken < _MOST_BYTES:
            try:
                data, address = self._listening.recvfrom(_MOST_BYTES)
            except (BlockingIOError, ConnectionRefusedError):
                break
            except OSError as error:
                self.reason = f"{self.connection}: {_words(error)}"
                break
            taken += len(data) + 1
            peer = self._peers.pop(address, None) or self._peer(_Datagrams(self._listening, address))
            heard = peer.take(data)
            if heard or peer.systems:
                self._peers[address] = peer  # the last one heard is the last in the table
                self.reason = ""
                while len(self._peers) > _MOST_PEERS:
                    self._forget(next(iter(self._peers)))
            else:
                self._bad += peer.framer.bad or 1
            messages += heard
        return messages

    def _peer(self, wire: _Wire) -> _Peer:
        return _Peer(wire, self.dialect, *self._ids)

    def _add(self, key: Any, wire: _Wire) -> None:
        self._peers[key] = self._peer(wire)
        self.reason = ""

    def _lose(self, key: Any, error: OSError) -> None:
        self._forget(key)
        if not self._peers:
            self.reason = f"{self.connection}: {_words(error)}"

    def _forget(self, key: Any, abandon: bool = False) -> None:
        """Of a peer only its counts are left."""
        peer = self._peers.pop(key)
        self._bad += peer.framer.bad
        self._lost += peer.framer.lost
        self._dropped += peer.dropped
        with suppress(OSError):
            peer.wire.close(abandon)


class _Attempt(threading.Thread):
    """One attempt to connect."""

    def __init__(self, make: Callable[[], _Wire]) -> None:
        super().__init__(name="mavlink-connect", daemon=True)
        self.wire: _Wire | None = None
        self.error: Exception | None = None
        self._make = make
        self._lock = threading.Lock()
        self._abandoned = False
        self.start()

    def run(self) -> None:
        """Connect; what nobody waits for any more is closed."""
        try:
            wire = self._make()
        except (OSError, ValueError) as error:
            self.error = error
            return
        with self._lock:
            if self._abandoned:
                wire.close()
            else:
                self.wire = wire

    def abandon(self) -> None:
        """Nobody waits for it any more."""
        with self._lock:
            self._abandoned = True
            if self.wire is not None:
                self.wire.close()


def _words(error: Exception | None) -> str:
    """An error of the system, in its own words."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text)
