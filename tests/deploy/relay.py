"""A link that takes time: joins two network namespaces by a pair of TUN devices and holds every packet back.

    python relay.py DELAY_S LINK [LINK...]      with LINK = NAMESPACE:DEVICE,NAMESPACE:DEVICE

As root; for kernels without netem. Prints "ready" when all devices are there, and runs until it is killed;
the devices are gone then. The namespaces are those of `ip netns`.
"""

import contextlib
import ctypes
import fcntl
import os
import selectors
import struct
import sys
import time
from collections import deque
from collections.abc import Sequence

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
CLONE_NEWNET = 0x40000000
PACKET = 65536


def main(arguments: Sequence[str]) -> None:
    delay_s = float(arguments[0])
    home = os.open("/proc/self/ns/net", os.O_RDONLY)
    other_end: dict[int, int] = {}
    for link in arguments[1:]:
        one, other = (tun(*end.split(":")) for end in link.split(","))
        other_end |= {one: other, other: one}
    enter(home)
    print("ready", flush=True)
    relay(other_end, delay_s)


def relay(other_end: dict[int, int], delay_s: float) -> None:
    """Pass packets on, each `delay_s` after it came, for ever. One delay for all: first in, first out."""
    waiting: deque[tuple[float, int, bytes]] = deque()
    with selectors.DefaultSelector() as selector:
        for device in other_end:
            selector.register(device, selectors.EVENT_READ)
        while True:
            left = max(waiting[0][0] - time.monotonic(), 0.0) if waiting else None
            for key, _ in selector.select(left):
                packet = os.read(key.fd, PACKET)
                waiting.append((time.monotonic() + delay_s, other_end[key.fd], packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, device, packet = waiting.popleft()
                with contextlib.suppress(OSError):  # it is down: the packet is lost
                    os.write(device, packet)


def tun(namespace: str, name: str) -> int:
    """A new TUN device in a namespace; returns what its packets are read from and written to."""
    enter(os.open(f"/run/netns/{namespace}", os.O_RDONLY))
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    return device


def enter(namespace: int) -> None:
    """Be in another network namespace from here on (`os.setns` is there from Python 3.12)."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


if __name__ == "__main__":
    main(sys.argv[1:])
