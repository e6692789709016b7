"""`python -m benchmarks.play_listener ENDPOINT PREFIX COUNT`: hears so many messages and says what they were.

One JSON object: how many, their checksum in the order of their arrival, and the time from the first to the
last.
"""

import sys
import threading
import time
import zlib

import msgspec

from maniple.transport.zenoh import ZenohSession

_SILENT_S = 5.0
"""Nothing more comes after so long."""


class Heard(msgspec.Struct, frozen=True):
    """What a listener heard."""

    messages: int
    checksum: int
    wall_s: float


def checksum(topic: str, data: bytes, before: int) -> int:
    """Of all messages up to this one."""
    return zlib.crc32(data, zlib.crc32(topic.encode(), before))


def main() -> None:
    """Listen and report."""
    endpoint, prefix, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    heard, found, times = 0, 0, [0, 0]
    done = threading.Event()

    def hear(topic: str, data: bytes) -> None:
        nonlocal heard, found
        times[heard > 0] = time.monotonic_ns()
        heard, found = heard + 1, checksum(topic, data, found)
        if heard == count:
            done.set()

    with ZenohSession.client(endpoint, prefix) as session:
        session.subscribe("**", hear)
        session.settle()
        print("listens", flush=True)
        before = -1
        while not done.wait(_SILENT_S) and not (heard and heard == before):
            before = heard
    print(msgspec.json.encode(Heard(heard, found, (times[1] - times[0]) / 1e9)).decode(), flush=True)


if __name__ == "__main__":
    main()
