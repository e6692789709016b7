"""A robot that speaks ROS 2 for its driver to find: the presented vehicle around a first-order body, a router
of its own, and a cable that can be cut."""

import math
import socket
import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

from maniple.cli.loading import loads
from maniple.control.limits import Velocity
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, Motion, Scan, pack_floats
from maniple.core.scenario.types import Robot, Scenario
from maniple.transport.zenoh import ZenohSession
from simulator.vehicles.ros2 import Ros2Vehicle

SCENE = """
name = "ros"
task = {{ kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15 }}
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [
  {{ id = "r1" }},
  {{ id = "r2", driver = "ros2", presents = "ros2", {extra} }},
  {{ id = "r3" }},
]
"""
STEP_S = 0.01
TAU_S = 0.1


def scene(extra: str = "ros2 = {}") -> tuple[Scenario, Robot]:
    """A platoon whose second robot speaks ROS 2."""
    scenario = loads(SCENE.format(extra=extra).encode())
    return scenario, scenario.robots[1]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Cable:
    """Passes TCP on from a port of its own; while it is cut nothing passes, and nobody is told."""

    def __init__(self, port: int) -> None:
        self.port, self._to = free_port(), port
        self._whole = threading.Event()
        self._whole.set()
        self._ended = False
        self._server = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._whole.clear()

    def restore(self) -> None:
        self._whole.set()

    def close(self) -> None:
        self._ended = True
        self._whole.set()
        self._server.close()

    def _accept(self) -> None:
        while not self._ended:
            try:
                here, _ = self._server.accept()
                there = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            for one, other in ((here, there), (there, here)):
                threading.Thread(target=self._pass, args=(one, other), daemon=True).start()

    def _pass(self, one: socket.socket, other: socket.socket) -> None:
        try:
            while data := one.recv(65536):
                self._whole.wait()
                other.sendall(data)
        except OSError:
            pass
        finally:
            for end in (one, other):
                end.close()


class Peer:
    """The robot, its router and its cable."""

    def __init__(self, scenario: Scenario, robot: Robot) -> None:
        port = free_port()
        self.router = ZenohSession.router(f"tcp/127.0.0.1:{port}", "maniple", lease_s=1.0)
        self.local = f"tcp/127.0.0.1:{port}"
        """The router as the robot itself reaches it."""
        self.cable = Cable(port)
        self.endpoint = f"tcp/127.0.0.1:{self.cable.port}"
        """And as others do."""
        self.vehicle = Ros2Vehicle(scenario, robot, self.local)
        self.pose = Pose(3.0, 2.0, 1.0)
        self.moves = Velocity()
        self.order = Drive(u_mps=0.0, w_radps=0.0, active=False)
        self._rates = scenario.rates
        self._ended = threading.Event()
        self.vehicle.open(time.time_ns())
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self.vehicle.close(time.time_ns())
        self.cable.close()
        self.router.close()

    def _live(self) -> None:
        steps = 0
        until = time.monotonic()
        motion_every, scan_every = (
            round(1 / rate / STEP_S) for rate in (self._rates.motion_hz, self._rates.scan_hz)
        )
        while not self._ended.wait(max(0.0, until - time.monotonic())):
            until += STEP_S
            now = time.time_ns()
            if steps % 2 == 0:
                self.order = self.vehicle.step(now)
            share = 1.0 - math.exp(-STEP_S / TAU_S)
            u = self.moves.u + share * (self.order.u_mps - self.moves.u)
            w = self.moves.w + share * (self.order.w_radps - self.moves.w)
            self.moves = Velocity(u, w)
            self.pose = self.pose.advance(u * STEP_S, w * STEP_S)
            if steps % motion_every == 0:
                self.vehicle.see(self._motion(), now)
            if steps % scan_every == 0:
                self.vehicle.see(_SCAN, now)
            steps += 1

    def _motion(self) -> Motion:
        return Motion(
            ticks=(),
            applied=(self.order.u_mps, self.order.w_radps),
            state="active",
            controllable=True,
            pose=(self.pose.x, self.pose.y, self.pose.psi),
            twist=(self.moves.u, self.moves.w, 0.0),
        )


_SCAN = Scan(
    first_angle_rad=-1.5,
    increment_rad=0.1,
    range_min_m=0.1,
    range_max_m=8.0,
    mount=(0.1, 0.0, 0.0),
    ranges=pack_floats(np.concatenate(([0.0, 8.0], np.linspace(1.0, 7.0, 29)))),
)
