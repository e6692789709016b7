"""A platoon as processes, each in a network namespace of its own.

Fleet network: every node has a link of its own to a namespace that routes, `hub`; those of the robots are
slow and lose packets. Hardware network: a bridge in the namespace of the simulator. Needs root.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
PORT = 7447
FLEET, HARDWARE = "10.77", "10.78.0"


class Namespaces:
    """The networks; `robots` are far from everything, `others` of the fleet are near."""

    def __init__(self, robots: Sequence[str], others: Sequence[str], wired: Sequence[str]) -> None:
        self._prefix = f"mnp{os.getpid()}-"
        self._robots, self._others, self._wired = tuple(robots), tuple(others), tuple(wired)
        self._relay: subprocess.Popen[str] | None = None
        self._made: list[str] = []

    def named(self, node: str) -> str:
        """The namespace of a node."""
        return f"{self._prefix}{node}"

    def address(self, node: str) -> str:
        """Of a node on the fleet network."""
        return f"{FLEET}.{(*self._robots, *self._others).index(node) + 1}.2"

    def make(self, delay_s: float, loss: float) -> None:
        """Lay the links. Between robots and the rest a packet takes `delay_s` and is lost with probability
        `loss`, either way."""
        for node in dict.fromkeys(("hub", "simulator", *self._robots, *self._others, *self._wired)):
            ip("netns", "add", self.named(node))
            self._made.append(node)
            self.ip(node, "link", "set", "lo", "up")
        self._relay = self._far_links(delay_s)
        for node in self._others:
            self.ip(node, "link", "add", "fleet", "type", "veth", "peer", node, "netns", self.named("hub"))
        for node in (*self._robots, *self._others):
            self._address(node)
        self.run("hub", "sysctl", "-qw", "net.ipv4.ip_forward=1")
        self._wires()
        for node in self._robots:
            for way in ("-i", "-o"):
                chance = ("-m", "statistic", "--mode", "random", "--probability", str(loss))
                self.run("hub", "iptables", "-A", "FORWARD", way, node, *chance, "-j", "DROP")

    def _far_links(self, delay_s: float) -> "subprocess.Popen[str]":
        links = [f"{self.named(node)}:fleet,{self.named('hub')}:{node}" for node in self._robots]
        command = [sys.executable, str(Path(__file__).with_name("relay.py")), str(delay_s), *links]
        relay = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert relay.stdout is not None
        assert relay.stdout.readline() == "ready\n"
        return relay

    def _address(self, node: str) -> None:
        """Give both ends of a node's fleet link their addresses."""
        own = self.address(node)
        gate = own[:-1] + "1"
        for where, device, address in ((node, "fleet", own), ("hub", node, gate)):
            peer = gate if address == own else own
            self.ip(where, "address", "add", address, "peer", peer, "dev", device)
            self.ip(where, "link", "set", device, "up")
        self.ip(node, "route", "add", "default", "via", gate)

    def _wires(self) -> None:
        self.ip("simulator", "link", "add", "hardware", "type", "bridge")
        self.ip("simulator", "address", "add", f"{HARDWARE}.1/24", "dev", "hardware")
        self.ip("simulator", "link", "set", "hardware", "up")
        for number, node in enumerate((*self._robots, *self._wired), start=2):
            end = ("peer", "name", node, "netns", self.named("simulator"))
            self.ip(node, "link", "add", "hardware", "type", "veth", *end)
            self.ip("simulator", "link", "set", node, "master", "hardware", "up")
            self.ip(node, "address", "add", f"{HARDWARE}.{number}/24", "dev", "hardware")
            self.ip(node, "link", "set", "hardware", "up")

    def cut(self, node: str, cut: bool) -> None:
        """Take a robot's fleet link away, or give it back."""
        for way in ("-i", "-o"):
            self.run("hub", "iptables", "-I" if cut else "-D", "FORWARD", way, node, "-j", "DROP")

    def ip(self, node: str, *arguments: str) -> None:
        """`ip` in the namespace of a node."""
        ip("-n", self.named(node), *arguments)

    def run(self, node: str, *command: str) -> str:
        """A command in the namespace of a node; returns what it says."""
        return told("ip", "netns", "exec", self.named(node), *command)

    def remove(self) -> None:
        """Take everything away that `make` made, as far as it came."""
        if self._relay is not None:
            self._relay.kill()
            self._relay.communicate()
        for node in self._made:
            subprocess.run(["ip", "netns", "delete", self.named(node)], check=False)


class Processes:
    """What runs in the namespaces: `maniple` with arguments, each with what it says in a file of its own."""

    def __init__(self, networks: Namespaces, folder: Path) -> None:
        self._networks = networks
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._files: list[IO[bytes]] = []

    def start(self, name: str, where: str, *arguments: object) -> None:
        """Start a process of the platoon in the namespace of `where`."""
        file = (self._folder / f"{name}.txt").open("ab")
        self._files.append(file)
        command = [sys.executable, "-m", "maniple", *map(str, arguments)]
        self._running[name] = subprocess.Popen(
            ["ip", "netns", "exec", self._networks.named(where), *command],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )

    def status(self, name: str, within_s: float) -> int:
        """How a process ended."""
        return self._running[name].wait(within_s)

    def said(self, name: str) -> str:
        """What a process has said."""
        return (self._folder / f"{name}.txt").read_text()

    def listens(self, name: str) -> None:
        """Wait until a router is there."""
        eventually(lambda: "listening" in self.said(name))

    def end(self) -> None:
        """Kill what still runs."""
        for process in self._running.values():
            process.kill()
            process.wait()
        for file in self._files:
            file.close()


@contextlib.contextmanager
def platoon(networks: Namespaces, folder: Path, delay_s: float, loss: float) -> Iterator[Processes]:
    """The networks, and processes in them; both are gone afterwards."""
    processes = Processes(networks, folder)
    try:
        networks.make(delay_s, loss)
        yield processes
    finally:
        processes.end()
        networks.remove()


def ip(*arguments: str) -> str:
    """`ip` of iproute2."""
    return told("ip", *arguments)


def told(*command: str) -> str:
    """What a command says.

    Raises:
        AssertionError: it failed; with what it said.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}{done.stdout}"
    return done.stdout
