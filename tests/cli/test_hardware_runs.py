"""Whole platoons on real protocols, as processes, and what goes wrong with hardware."""

import json
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from pymavlink import mavutil

from maniple.core import codec, topics
from maniple.core.geometry import Floats
from maniple.core.messages import FormationState, Message, Motion, Status, Truth, unpack_floats
from maniple.core.time import SECOND, Time, to_seconds
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import ROOT, start
from tests.cli.test_realtime import running
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

MIXED = ROOT / "scenarios" / "hardware-mixed.toml"

PLATOON = """
name = "behind-mavlink"
task = { kind = "line", start = [0, 0], end = [3, 0], speed_mps = 0.15, settle_s = 3.0 }
formation.points = [[0.9, 0.7], [0, -0.7], [-0.9, 0.7]]
placement.robot_from = "kinematics"
guard.clearance = false
"""
ROBOT = """
[[robots]]
id = "{}"
driver = "mavlink"
presents = "mavlink"
mavlink = {{ connection = "tcp:127.0.0.1:{}", arm = true, origin = [48.137154, 11.576124, 520.0] }}
"""
ROBOTS = ("r1", "r2", "r3")

STILL_MPS, STILL_RADPS = 0.02, 0.04
CUT_S = 5.0
WATCHDOG_S, ROUND_S = 0.3, 0.2
"""The driver's, and what it takes until the agent's death can be seen in the ground truth; a busy machine
may add"""
SLACK_S = 0.6
MANUAL, GUIDED = 0, 15


class Proxy:
    """Between a driver and its vehicle: a cable that can be cut and mended. What was on its way then arrives
    late, all at once, as with a radio that comes back."""

    def __init__(self, to: int) -> None:
        self._to = to
        self._whole = threading.Event()
        self._whole.set()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = [self._listening]
        self._threads: list[threading.Thread] = []
        self._begin(self._accept)

    @property
    def port(self) -> int:
        return int(self._listening.getsockname()[1])

    def cut(self) -> None:
        self._whole.clear()

    def mend(self) -> None:
        self._whole.set()

    def close(self) -> None:
        self._whole.set()
        for one in self._open:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(5.0)
        for one in self._open:
            one.close()

    def _begin(self, work: Callable[..., None], *ends: socket.socket) -> None:
        self._threads.append(threading.Thread(target=work, args=ends, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listening.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:  # the vehicle is not there yet
                near.close()
                continue
            self._open += [near, far]
            self._begin(self._pump, near, far)
            self._begin(self._pump, far, near)

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(4096):
                self._whole.wait()
                sink.sendall(data)
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


class Platoon:
    """The processes of a platoon that nobody supervises, and what they say."""

    def __init__(self, endpoint: str, wiring: str, stack: ExitStack) -> None:
        self._endpoint = endpoint
        self._wiring = wiring
        self._stack = stack
        self._newest: dict[str, Message] = {}
        self.processes: dict[str, subprocess.Popen[str]] = {}

    def start(self, name: str, *command: object, scenario: Path, wired: bool = False) -> None:
        """A process; `wired`: on the router of r3's own wiring too, or that router."""
        if command[0] == "router":
            where = ["--listen", self._wiring if wired else self._endpoint]
        else:
            where = ["--connect", self._endpoint, *(["--hardware", self._wiring] if wired else [])]
        process = start(*command, "--scenario", scenario, *where)
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        self.processes[name] = process

    def listen(self) -> ZenohSession:
        def connect() -> ZenohSession | None:
            with suppress(Exception):
                return ZenohSession.client(self._endpoint, "maniple", timeout_s=1.0)
            return None

        session = eventually(connect)
        assert session is not None
        self._stack.callback(session.close)
        for name in (topics.FORMATION_STATE, topics.status("*"), topics.TRUTH):
            session.subscribe(name, self._heard)
        return session

    def _heard(self, topic: str, data: bytes) -> None:
        self._newest[topic] = codec.decode(topic, data)

    @property
    def state(self) -> FormationState | None:
        found = self._newest.get(topics.FORMATION_STATE)
        return found if isinstance(found, FormationState) else None

    @property
    def r3(self) -> Status | None:
        found = self._newest.get(topics.status("r3"))
        return found if isinstance(found, Status) else None

    @property
    def task_s(self) -> float:
        return self.state.task_time_s if self.state is not None else 0.0

    @property
    def waits(self) -> bool:
        """Whether r3 is waited for, or the platoon holds without it."""
        return self.state is not None and ("r3" in self.state.waits_for or self.state.phase == "holding")

    def stands(self) -> bool:
        """Whether r3 does, by ground truth."""
        truth = self._newest.get(topics.TRUTH)
        assert isinstance(truth, Truth)
        u, w = unpack_floats(truth.velocities, 2)[truth.robots.index("r3")]
        return bool(abs(u) < STILL_MPS and abs(w) < STILL_RADPS)

    def goes_on(self) -> bool:
        """Once it does: the reference moves, and r3 follows."""
        before = self.task_s
        eventually(lambda: self.task_s > before + 1.0 and not self.waits and not self.stands())
        return True

    def command(self, *words: str) -> dict[str, Any]:
        process = start(*words, "--connect", self._endpoint, "--json")
        out, err = process.communicate(timeout=90)
        assert process.returncode == 0, f"{out}\n{err}"
        found: dict[str, Any] = json.loads(out)
        return found

    def end(self, *names: str) -> None:
        for name in names:
            self.processes[name].send_signal(signal.SIGTERM)
        for name in names:
            _, err = self.processes[name].communicate(timeout=30)
            assert self.processes[name].returncode == 0, f"{name}: {err}"


class Pilot:
    """Another ground station at a vehicle, by pymavlink's own connection."""

    def __init__(self, port: int) -> None:
        self._link: Any = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", source_system=254)
        assert self._link.wait_heartbeat(timeout=10) is not None

    def set_mode(self, mode: int) -> None:
        self._link.mav.command_long_send(1, 1, 176, 0, 1, mode, 0, 0, 0, 0, 0)
        until = time.monotonic() + 10
        while time.monotonic() < until:
            ack = self._link.recv_match(type="COMMAND_ACK", blocking=True, timeout=1)
            if ack is not None and ack.command == 176:
                assert ack.result == 0
                return
        raise AssertionError("no answer to the change of mode")

    def close(self) -> None:
        self._link.close()


@contextmanager
def platoon(folder: Path) -> Iterator[tuple[Platoon, Proxy, int]]:
    """Three presented rovers. As on a real one, r3's computer has a router and a recorder of its own for
    what its agent and its driver say to each other; and the driver reaches its vehicle through a proxy."""
    ports = [free_port() for _ in ROBOTS]
    with ExitStack() as stack:
        proxy = stack.enter_context(closing(Proxy(ports[2])))
        scene, bodies = folder / "scene.toml", folder / "bodies.toml"
        bodies.write_text(PLATOON + "".join(map(ROBOT.format, ROBOTS, ports)))
        scene.write_text(PLATOON + "".join(map(ROBOT.format, ROBOTS, (*ports[:2], proxy.port))))
        one = Platoon(f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}", stack)
        one.start("router", "router", scenario=scene)
        one.start("r3-router", "router", scenario=scene, wired=True)
        session = one.listen()
        one.start("recorder", "recorder", "--log", folder / "base.mcap", scenario=scene)
        eventually(lambda: session.lives("recorder"))
        mine = ("--topic", "hw/r3/*", "--topic", "robot/r3/*")
        one.start("r3-recorder", "recorder", "--log", folder / "r3.mcap", *mine, scenario=scene, wired=True)
        eventually((folder / "r3.mcap").exists)
        one.start("simulator", "simulator", scenario=scene)
        for robot in ROBOTS:
            one.start(f"{robot}-vehicle", "vehicle", robot, scenario=bodies)
        for robot in ROBOTS:
            wired = robot == "r3"
            one.start(f"{robot}-driver", "driver", "run", robot, scenario=scene, wired=wired)
            one.start(robot, "agent", robot, scenario=scene, wired=wired)
        one.start("controller", "controller", scenario=scene)
        yield one, proxy, ports[2]


def log_command(*words: object) -> None:
    process = start("log", *words)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, f"{out}\n{err}"


class Course(NamedTuple):
    """How r3 moved, by ground truth."""

    times: Floats
    """s, by the clock of the recorder."""
    speeds: Floats
    """(k, 2): m/s, rad/s."""
    collisions: int


def course_of(log: Path) -> Course:
    times, speeds, collisions = [], [], 0
    for record, truth in read(log).decoded(Truth):
        times.append(to_seconds(record.log_time_ns))
        speeds.append(unpack_floats(truth.velocities, 2)[truth.robots.index("r3")])
        collisions = truth.collisions
    return Course(np.array(times), np.array(speeds), collisions)


def longest_drive(course: Course, begin: Time, end: Time) -> float:
    """How long after `begin` r3 still moved, s, up to `end`."""
    inside = (course.times >= to_seconds(begin)) & (course.times <= to_seconds(end))
    moves = (np.abs(course.speeds) >= (STILL_MPS, STILL_RADPS)).any(axis=1) & inside
    return float(course.times[moves].max(initial=to_seconds(begin)) - to_seconds(begin))


@pytest.mark.slow
def test_three_rovers_bear_a_cut_link_a_pilot_and_a_dead_agent(tmp_path: Path) -> None:
    """All behind MAVLink: each time r3 stands, the others wait, and it goes on; then the task is done. The
    recording shows it and proves the agents."""
    with platoon(tmp_path) as (one, link, port):
        found = one.command("preflight", "--wait", "60")
        assert found["ok"]
        assert found["estop"]["stop"]["confirmed"].keys() == set(ROBOTS)
        eventually(lambda: one.task_s > 2.0)

        cut_at = time.time_ns()
        link.cut()
        eventually(lambda: one.waits, 3.0)
        eventually(one.stands, 5.0)
        time.sleep(max(CUT_S - (time.time_ns() - cut_at) / SECOND, 0.0))  # how long it lasts is the point
        link.mend()
        mended_at = time.time_ns()
        assert one.goes_on()

        with closing(Pilot(port)) as pilot:
            taken_at = time.time_ns()
            pilot.set_mode(MANUAL)
            eventually(lambda: one.r3 is not None and not one.r3.controllable, 3.0)
            eventually(lambda: one.waits, 3.0)
            eventually(one.stands, 3.0)
            assert one.r3 is not None
            reason = one.r3.reason
            given_at = time.time_ns()
            pilot.set_mode(GUIDED)
            assert one.goes_on()
        assert "MANUAL" in reason

        killed_at = time.time_ns()
        one.processes["r3"].kill()
        one.processes["r3"].communicate()
        eventually(lambda: one.waits, 3.0)
        eventually(one.stands, 3.0)
        back_at = time.time_ns()
        one.start("r3", "agent", "r3", scenario=tmp_path / "scene.toml", wired=True)
        eventually(lambda: one.r3 is not None and one.r3.incarnation == 2 and one.r3.controllable)
        assert one.command("stop")["ok"]  # of a new agent it has to be tested anew
        assert one.command("arm")["ok"]
        eventually(lambda: one.state is not None and one.state.phase == "done", 90.0)
        one.end("controller", "r1", "r2", "r3")
        one.end("r1-driver", "r2-driver", "r3-driver")
        one.end("r1-vehicle", "r2-vehicle", "r3-vehicle", "simulator")
        one.end("recorder", "r3-recorder")
        one.end("router", "r3-router")

    log = tmp_path / "run.mcap"
    log_command("merge", tmp_path / "base.mcap", tmp_path / "r3.mcap", "--out", log)
    course = course_of(log)
    assert course.collisions == 0
    # The vehicle's own time limit of 3 s, as its link was cut and nobody could tell it to stand.
    assert longest_drive(course, cut_at, mended_at) < 3.0 + 1.0 + SLACK_S
    assert longest_drive(course, taken_at, given_at) < 1.0 + SLACK_S
    assert longest_drive(course, killed_at, back_at) < WATCHDOG_S + ROUND_S + 0.5 + SLACK_S
    motions = [motion for _, motion in read(log).decoded(Motion) if motion.source == "r3-driver"]
    assert any(re.search("pilot.*MANUAL", motion.reason) for motion in motions if not motion.controllable)
    log_command("verify", log)


@pytest.mark.slow
def test_a_simulated_a_ros2_and_a_mavlink_robot_in_one_formation(tmp_path: Path) -> None:
    """`maniple run` of the scene, on a shorter way."""
    changes = (
        "task.points=[[0,0],[1.5,0],[2.5,0.8]]",
        "task.settle_s=6",
        f"robots.r3.mavlink.connection={_tcp()}",
    )
    with running(tmp_path, MIXED, *(word for change in changes for word in ("--set", change))) as run:
        code, result, notices = run.finish(150.0)
    assert code == 0, notices
    assert result["completed"]
    assert result["collisions"] == 0
    assert "emergency stop tested: 3 robots stood after" in notices
    assert result["final_error"]["position_m"] < 0.1
    assert result["final_error"]["distance_m"] < 0.1
    assert result["real_time_factor"] < 1.0
    drivers = {motion.source for _, motion in read(run.log).decoded(Motion)}
    assert {"simulator", "r2-driver", "r3-driver"} <= drivers


def _tcp() -> str:
    return f"tcp:127.0.0.1:{free_port()}"
