"""MAVLink frames in a stream of bytes. Pure: no socket, no clock.

A frame that is damaged costs itself only: what follows is looked for from its second byte on, so that a wrong
length does not take the frames behind it with it.
"""

import re
from typing import Any

_V2, _V1 = 0xFD, 0xFE
_CHECKSUM, _SIGNATURE = 2, 13
_SIGNED = 0x01
_HEADERS = {_V2: 10, _V1: 6}
_MARKER = re.compile(b"[\xfd\xfe]")


class Framer:
    """Finds the messages in what comes from one peer, MAVLink 2 and 1.

    `bad` counts runs of bytes that are no frame, `lost` the frames that are missing by their sequence
    numbers.
    """

    def __init__(self, dialect: Any) -> None:
        """`dialect`: the pymavlink module of the messages."""
        self.bad = 0
        self.lost = 0
        self._dialect = dialect
        self._codec = dialect.MAVLink(None)
        self._buffer = bytearray()
        self._in_garbage = False
        self._sequences: dict[tuple[int, int], int] = {}

    def feed(self, data: bytes) -> list[Any]:
        """The messages that are complete with `data`, oldest first. What another dialect may mean is left
        out."""
        self._buffer += data
        messages, at = [], 0
        while True:
            frame = self._frame(at)
            if frame is None:
                break
            length, message = frame
            at += length
            if message is not None:
                self._count(message)
                messages.append(message)
        del self._buffer[:at]
        return messages

    def _frame(self, at: int) -> tuple[int, Any] | None:
        """How many bytes from `at` on are done with, and the message they are; None where more must come."""
        buffer = self._buffer
        if at >= len(buffer):
            return None
        header = _HEADERS.get(buffer[at])
        if header is None:
            return self._garbage(at)
        if len(buffer) - at < 3:
            return None
        flags = buffer[at + 2] if header == _HEADERS[_V2] else 0
        if flags & ~_SIGNED:
            return self._garbage(at)
        length = header + buffer[at + 1] + _CHECKSUM + (_SIGNATURE if flags else 0)
        if len(buffer) - at < length:
            return None
        try:
            message = self._codec.decode(buffer[at : at + length])
        except self._dialect.MAVError:
            return self._garbage(at)
        if message.get_type().startswith("UNKNOWN"):
            # Its checksum can't be told without its definition; what follows it tells whether it is a frame.
            if at + length < len(buffer) and buffer[at + length] not in _HEADERS:
                return self._garbage(at)
            message = None
        self._in_garbage = False
        return length, message

    def _garbage(self, at: int) -> tuple[int, Any]:
        """What is passed over: from a byte that begins no frame to the next that may."""
        self.bad += not self._in_garbage
        self._in_garbage = True
        found = _MARKER.search(self._buffer, at + 1)
        return (found.start() if found else len(self._buffer)) - at, None

    def _count(self, message: Any) -> None:
        """Frames that are missing before this one; what comes late or twice is no gap."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        before = self._sequences.get(sender)
        self._sequences[sender] = message.get_seq()
        gap = 0 if before is None else (message.get_seq() - before - 1) % 256
        self.lost += gap if gap < 128 else 0
