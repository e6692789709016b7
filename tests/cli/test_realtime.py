"""Whole runs as real processes over Zenoh: what they achieve, what is left of them, and what ends them."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

import maniple
from maniple.cli import realtime
from maniple.core import codec, topics
from maniple.core.edges import driver_of, scanner_of, vehicle_of
from maniple.core.messages import Command, Decisions, FormationState, Motion, Truth, unpack_floats
from maniple.core.time import SECOND, Time
from maniple.host.clock import Anchor
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import PAPER, SMALL, platoon, speeds, start, truths, write
from tests.transport.test_zenoh import free_port
from tests.waiting import children_of, eventually, runs

LONG = SMALL.replace("end = [1.5, 0]", "end = [500, 0]")
SPEED = 3.0
NODES = ("router", "recorder", "simulator", "agent", "controller")
AT_ONCE_S = 10.0
"""What is to be over in 5 s on a machine that is not busy with other things."""


class Run:
    """`maniple run` in a process of its own."""

    def __init__(self, folder: Path, *arguments: object, **options: Any) -> None:
        self.log = folder / "run.mcap"
        self.before = leftovers()
        self.seen: dict[int, str] = {}
        self.process = start("run", *arguments, "--json", "--log", self.log, **options)

    def children(self) -> dict[str, int]:
        """Process ids of the platoon as it is, by name of the node."""
        found = {}
        for pid, arguments in children_of(self.process.pid).items():
            command, *rest = arguments[arguments.index("maniple") + 1 :] if "maniple" in arguments else [""]
            if command in NODES:  # between fork and exec a child has its parent's arguments, or none
                found[rest[0] if command == "agent" else command] = pid
            elif command == "vehicle":
                found[vehicle_of(rest[0])] = pid
            elif command == "driver":
                found[scanner_of(rest[1]) if "--scans" in rest else driver_of(rest[1])] = pid
        self.seen |= {pid: name for name, pid in found.items()}
        return found

    def option(self, name: str) -> str:
        """What the nodes were given for an option."""
        pid = self.children()["controller"]
        arguments = children_of(self.process.pid)[pid]
        return arguments[arguments.index(name) + 1]

    def finish(self, within_s: float = 60.0) -> tuple[int, dict[str, Any], str]:
        """Exit status, result and standard error; all its processes have ended then, and left nothing."""
        out, err = self.process.communicate(timeout=within_s)
        assert not [name for pid, name in self.seen.items() if runs(pid)]
        assert leftovers() <= self.before
        return self.process.returncode, json.loads(out) if out else {}, err


def leftovers() -> set[Path]:
    """What Zenoh or a process of ours might leave behind."""
    names = [*Path("/dev/shm").iterdir(), *Path("/tmp").iterdir()]
    return {path for path in names if path.parent.name == "shm" or "zenoh" in path.name.lower()}


@contextmanager
def running(folder: Path, *arguments: object, **options: Any) -> Iterator[Run]:
    """A run that is ended by force at the end, if nothing else ended it."""
    run = Run(folder, *arguments, **options)
    try:
        yield run
    finally:
        run.children()
        run.process.kill()
        run.process.communicate()
        for pid in run.seen:
            if runs(pid):
                os.kill(pid, signal.SIGKILL)


@contextmanager
def under_way(
    folder: Path, text: str = LONG, speed: float = SPEED
) -> Iterator[tuple[Run, SimpleQueue[Truth]]]:
    """A run whose robots move, and the ground truth as it comes."""
    truth: SimpleQueue[Truth] = SimpleQueue()
    states: SimpleQueue[FormationState] = SimpleQueue()

    def hear(topic: str, data: bytes) -> None:
        message = codec.decode(topic, data)
        if isinstance(message, Truth):
            truth.put(message)
        elif isinstance(message, FormationState):
            states.put(message)

    with running(folder, write(folder, LONG), "--speed", speed) as run:
        eventually(lambda: len(run.children()) == 7)
        with ZenohSession.client(run.option("--connect"), "maniple") as session:
            session.subscribe(topics.TRUTH, hear)
            session.subscribe(topics.FORMATION_STATE, hear)
            await_state(states, lambda state: state.task_time_s > 5.0)
            yield run, truth


def drained(queue: SimpleQueue[Truth]) -> list[Truth]:
    return [queue.get_nowait() for _ in range(queue.qsize())]


def assert_nothing_missing(log: Path) -> None:
    info = describe(read(log))
    assert info.complete
    gaps = {
        channel.topic: channel.streams for channel in info.channels if channel.missing or channel.headless
    }
    assert not gaps
    assert info.missing == 0


def assert_came_through(run: Run, errors: float = 0.03, within_s: float = 400.0) -> dict[str, Any]:
    status, found, err = run.finish(within_s)
    assert status == 0, (found, err)
    assert found["mode"] == "realtime"
    assert found["completed"] is True
    assert found["collisions"] == 0
    assert found["min_clearance_m"] > 0
    for values in (found["final_error"], found["estimated_final_error"]):
        assert max(values.values()) <= errors, values
    assert "Traceback" not in err
    return found


@pytest.mark.slow
def test_three_robots(tmp_path: Path) -> None:
    with running(tmp_path, write(tmp_path), "--speed", 5) as run:
        eventually(lambda: len(run.children()) == 7)
        assert set(run.children()) == {"router", "recorder", "simulator", "controller", "r1", "r2", "r3"}
        found = assert_came_through(run)
    assert found["messages"]["lost_injected"] == found["messages"]["lost_other"] == 0
    assert_nothing_missing(run.log)
    recording = read(run.log)
    assert recording.metadata["mode"] == "realtime"
    assert {state.phase for _, state in recording.decoded(FormationState)} == {"waiting", "running", "done"}
    assert (speeds(truths(run.log)[-1]) < 1e-3).all()


@pytest.mark.slow
def test_ctrl_c_ends_everything(tmp_path: Path) -> None:
    """At real speed, the slowest to stand."""
    with under_way(tmp_path, speed=1.0) as (run, _):
        begin = time.monotonic()
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
        assert time.monotonic() - begin < AT_ONCE_S
    assert status == 130
    assert found["interrupted"] is True
    assert found["completed"] is False
    assert "Traceback" not in err
    assert read(run.log).complete
    assert (speeds(truths(run.log)[-1]) < 1e-3).all()


def test_a_recorder_that_can_not_write_ends_the_start(tmp_path: Path) -> None:
    def small_disk() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    with running(tmp_path, write(tmp_path), preexec_fn=small_disk) as run:
        status, _, err = run.finish()
    assert status == 1
    assert "recorder (process " in err
    assert "can't write" in err
    assert "Traceback" not in err
    assert not run.log.exists()


@pytest.mark.slow
def test_the_paper_scene(tmp_path: Path) -> None:
    with running(tmp_path, PAPER, "--speed", SPEED) as run:
        eventually(lambda: len(run.children()) >= 10)
        found = assert_came_through(run)
    assert found["peak_error"]["position_m"] > 0.1
    assert_nothing_missing(run.log)


@pytest.mark.slow
@pytest.mark.parametrize("layer", ["kinematics", "avoidance"])
def test_the_paper_scene_with_layers_on_the_robots(tmp_path: Path, layer: str) -> None:
    with running(tmp_path, PAPER, "--speed", SPEED, "--set", f"placement.robot_from={layer}") as run:
        assert_came_through(run)
    assert {message.layer for _, message in read(run.log).decoded(Command)} == {layer}


@pytest.mark.slow
def test_a_bad_network_loses_the_same_messages_in_both_hosts(tmp_path: Path) -> None:
    faults = "faults=[{loss=0.3, latency_s=0.1, jitter_s=0.05}]"
    with running(tmp_path, PAPER, "--speed", SPEED, "--set", faults) as run:
        status, found, err = run.finish(400.0)
    virtual = maniple.run(PAPER, virtual=True, overrides=[faults], log=tmp_path / "virtual.mcap")
    assert virtual.ok
    assert status == 0, (found, err)
    assert (found["completed"], found["collisions"]) == (True, 0)
    assert found["messages"]["lost_injected"] / found["messages"]["sent"] == pytest.approx(0.3, abs=0.02)
    real, simulated = decisions(run.log), decisions(Path(virtual.log))
    both = real.keys() & simulated.keys()
    assert len(both) > 0.9 * min(len(real), len(simulated))
    assert all(real[key] == simulated[key] for key in both)


def decisions(log: Path) -> dict[tuple[str, str, str, int], tuple[bool, int]]:
    """Dropped and delay, by (receiver, source, topic, seq)."""
    return {
        (record.source, one.source, one.topic, one.seq): (one.dropped, one.delay_ns)
        for _, record in read(log).decoded(Decisions)
        for one in record.decided
    }


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["r2", "controller", "recorder", "simulator", "router"])
def test_the_death_of_a_process_ends_the_run(tmp_path: Path, victim: str) -> None:
    with under_way(tmp_path) as (run, truth):
        anchor = Anchor.parse(run.option("--anchor"))
        assert (speeds([truth.get(timeout=20), *drained(truth)][-1]) > 0.05).any()
        pid = run.children()[victim]
        begin = time.monotonic()
        killed_at = anchor.now()
        os.kill(pid, signal.SIGKILL)
        status, found, err = run.finish()
        assert time.monotonic() - begin < 10.0
        heard = drained(truth)
    assert status == 1
    assert found == {}
    assert f"{victim} (process {pid}) was killed by SIGKILL" in err
    assert str(run.log) in err
    assert "Traceback" not in err
    records = list(read(run.log).messages())
    assert records[-1].log_time_ns > killed_at - round(0.5 * SPEED * SECOND)
    assert read(run.log).complete == (victim != "recorder")
    if victim not in ("simulator", "router"):
        assert_they_stand(heard, killed_at)
    if victim == "r2":
        assert_brakes_by_itself(run.log, heard, killed_at)


def assert_they_stand(heard: list[Truth], killed_at: Time) -> None:
    """Within a second, in scenario time, of the end of commands."""
    assert heard[-1].stamp_ns > killed_at + SECOND
    assert (speeds(heard[-1]) < 1e-3).all()


def assert_brakes_by_itself(log: Path, heard: list[Truth], killed_at: Time) -> None:
    """The drive that hears nothing any more brakes after its timeout."""
    timeout_s = read(log).scenario.models["pioneer-3dx"].drive_timeout_s
    late = [m for m in heard if m.stamp_ns > killed_at + round((timeout_s + 1.0) * SECOND)]
    assert late
    assert all(speeds(message)[1] < 1e-3 for message in late)


@pytest.mark.slow
def test_a_killed_robot_is_left_out_and_comes_back(tmp_path: Path) -> None:
    """The fourth of six is killed; the others are in formation again; a new agent makes them six."""
    scenario = Path(__file__).parents[2] / "scenarios" / "lost-robot.toml"
    calm = ("--set", "crashes=[]", "--set", "controller.lost_after_s=12")  # 4 s of a busy machine
    states: SimpleQueue[FormationState] = SimpleQueue()

    def hear(topic: str, data: bytes) -> None:
        message = codec.decode(topic, data)
        assert isinstance(message, FormationState)
        states.put(message)

    def wait_for(robots: int) -> FormationState:
        """Until as many are in formation, as the controller sees it."""

        def formed(state: FormationState) -> bool:
            errors = unpack_floats(state.errors, 6)
            close = len(errors) == robots - 2 and bool(np.abs(errors).max() < 0.1)
            return close and not state.waits_for and state.task_time_s > 2.0

        return await_state(states, formed)

    with running(tmp_path, scenario, "--speed", SPEED, *calm) as run:
        eventually(lambda: len(run.children()) == 10)
        connect = run.option("--connect")
        with ZenohSession.client(connect, "maniple") as session:
            session.subscribe(topics.FORMATION_STATE, hear)
            wait_for(6)
            pid = run.children()["r4"]
            os.kill(pid, signal.SIGKILL)
            lost = wait_for(5)
            assert lost.chain == ("r1", "r2", "r3", "r5", "r6")
            assert [report.state for report in lost.roster if report.id == "r4"] == ["lost"]
            again = ("--scenario", scenario, "--connect", connect, "--anchor", run.option("--anchor"))
            with start("agent", "r4", *again) as agent:
                back = wait_for(6)
                assert sorted(back.chain) == ["r1", "r2", "r3", "r4", "r5", "r6"]
                status, result, err = run.finish(within_s=200.0)
                agent.send_signal(signal.SIGINT)
                agent.communicate(timeout=30)
    assert (status, result["completed"], result["collisions"]) == (0, True, 0)
    assert "r4" in result["lost_robots"]
    assert f"r4 (process {pid}) was killed by SIGKILL; 5 robots go on" in err
    assert "r4 is back (incarnation 2)" in err
    assert result["final_error"]["position_m"] < 0.1


@pytest.mark.slow
def test_a_stray_controller_does_not_take_over(tmp_path: Path) -> None:
    """It is refused, whatever it calls itself, and the run goes on."""
    with under_way(tmp_path) as (run, _):
        stray = ("controller", "--scenario", tmp_path / "small.toml", "--connect", run.option("--connect"))
        for options in ((), ("--incarnation", 2)):
            with start(*stray, *options) as process:
                _, err = process.communicate(timeout=60)
            assert process.returncode == 2
            assert "controller is running already (incarnation 1)" in err
            assert run.process.poll() is None
        run.process.send_signal(signal.SIGINT)
        status, found, err = run.finish()
    assert status == 130, err
    assert found["restarts"] == {}


@pytest.mark.slow
def test_without_its_supervisor_a_platoon_ends_by_itself(tmp_path: Path) -> None:
    with under_way(tmp_path) as (run, truth):
        run.process.kill()
        run.process.wait()
        eventually(lambda: not any(runs(pid) for pid in run.seen), within_s=15.0)
        heard = drained(truth)
    assert read(run.log).complete
    assert len(heard) > 10
    motions = [message for record, message in read(run.log).decoded(Motion) if record.topic == "hw/r1/motion"]
    assert motions


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["r1", "controller", "simulator", "router"])
def test_ctrl_c_with_a_frozen_process(tmp_path: Path, frozen: str) -> None:
    with under_way(tmp_path) as (run, _):
        os.kill(run.children()[frozen], signal.SIGSTOP)
        begin = time.monotonic()
        run.process.send_signal(signal.SIGINT)
        status, _, err = run.finish()
        assert time.monotonic() - begin < AT_ONCE_S
    assert status == 130, err
    assert read(run.log).complete


@pytest.mark.slow
@pytest.mark.parametrize("hanging", ["r1", "controller", "simulator"])
def test_termination_with_a_process_that_hangs_for_good(tmp_path: Path, hanging: str) -> None:
    """It is frozen again as often as it is thawed; the recorder still has its time."""
    with under_way(tmp_path) as (run, _):
        pid = run.children()[hanging]
        begin = time.monotonic()
        run.process.send_signal(signal.SIGTERM)
        eventually(lambda: freeze(pid), within_s=10.0)
        status, _, err = run.finish()
        assert time.monotonic() - begin < AT_ONCE_S
    assert status == 130, err
    assert read(run.log).complete


def freeze(pid: int) -> bool:
    """Whether the process has ended; else it is stopped."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
    return not runs(pid)


@pytest.mark.slow
@pytest.mark.parametrize("processes", [0, 1, 2, 5])
def test_ctrl_c_during_the_start(tmp_path: Path, processes: int) -> None:
    """Before the first process is there, and with so many of them."""
    with running(tmp_path, write(tmp_path, LONG)) as run:
        if processes:
            eventually(lambda: len(run.children()) >= processes)
        else:
            eventually(lambda: Path(f"/proc/{run.process.pid}/cmdline").read_text())
        run.process.send_signal(signal.SIGINT)
        begin = time.monotonic()
        eventually(lambda: run.children() == {} and run.process.poll() is not None, within_s=20.0)
        assert time.monotonic() - begin < AT_ONCE_S
        status, _, err = run.finish()
    assert status in ((130, -signal.SIGINT) if processes == 0 else (130,)), err


@pytest.mark.slow
def test_runs_share_a_machine(tmp_path: Path) -> None:
    """They start together in one folder, and neither says where to record."""
    scene = write(tmp_path)
    both = [start("run", scene, "--speed", 3, "--json", cwd=tmp_path) for _ in range(2)]
    found = [json.loads(process.communicate(timeout=120)[0]) for process in both]
    assert [process.returncode for process in both] == [0, 0]
    logs = {tmp_path / one["log"] for one in found}
    assert len(logs) == 2
    for log in logs:
        assert_nothing_missing(log)
        assert {message.source for _, message in read(log).decoded(FormationState)} == {"controller"}


@pytest.mark.slow
def test_a_port_that_is_taken_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found free is another run's router when ours comes to listen: ours moves on and does not
    join the other."""
    taken = f"tcp/127.0.0.1:{free_port()}"
    found = [taken, f"tcp/127.0.0.1:{free_port()}"]
    heard: list[Any] = []
    joined: SimpleQueue[str] = SimpleQueue()
    monkeypatch.setattr(realtime, "free_endpoint", lambda: found.pop(0))
    with ZenohSession.router(taken, "maniple") as other:
        other.announce("router", 1)
        other.subscribe("**", lambda topic, _: joined.put(topic))
        result = maniple.run(
            platoon(3), speed=5, duration_s=3, log=tmp_path / "a.mcap", on_progress=heard.append
        )
    assert not found
    assert joined.empty()
    assert heard[-1].connect != taken
    assert read(result.log).complete


@pytest.mark.slow
def test_a_disk_that_fills_up(tmp_path: Path) -> None:
    limit = 400_000
    with running(
        tmp_path,
        write(tmp_path, LONG),
        "--speed",
        5,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    ) as run:
        eventually(lambda: len(run.children()) == 7)
        status, _, err = run.finish()
    assert status == 1
    assert "recorder (process " in err
    assert "can't write" in err
    assert "Traceback" not in err
    assert len(truths(run.log)) > 10


@pytest.mark.slow
def test_nodes_started_by_hand(tmp_path: Path) -> None:
    """As in containers: each by its own command, with the scenario's file, no common clock, numbered by the
    router; ended one by one. A second life of a robot knows where it is and goes on."""
    scene, log = write(tmp_path, LONG), tmp_path / "a.mcap"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    options = ("--scenario", scene, "--connect", endpoint)
    lives: SimpleQueue[tuple[str, int, bool]] = SimpleQueue()
    states: SimpleQueue[FormationState] = SimpleQueue()
    nodes: dict[str, subprocess.Popen[str]] = {}
    try:
        router = nodes["router"] = start("router", "--listen", endpoint)
        assert router.stdout is not None
        assert router.stdout.readline() == f"listening on {endpoint}\n"
        with ZenohSession.client(endpoint, "maniple") as session:
            session.watch(lambda *life: lives.put(life))
            session.subscribe(topics.FORMATION_STATE, lambda t, data: states.put(codec.decode(t, data)))  # type: ignore[arg-type]
            nodes["recorder"] = start("recorder", "--log", log, *options)
            await_life(lives, "recorder", 1)
            for name in ("simulator", "controller"):
                nodes[name] = start(name, *options)
            for robot in ("r1", "r2", "r3"):
                nodes[robot] = start("agent", robot, *options)
            await_state(states, lambda state: state.task_time_s > 2.0)
            end(nodes["r1"])
            await_state(states, lambda state: state.roster[0].state == "absent")
            nodes["r1"] = start("agent", "r1", *options)
            await_life(lives, "r1", 2)
            before = await_state(states, lambda state: state.roster[0].state == "present")
            assert before.waits_for[:1] == ("r1",)
            await_state(states, lambda state: state.task_time_s > before.task_time_s + 1.0)
        for name in ("controller", "r1", "r2", "r3", "simulator", "recorder", "router"):
            end(nodes[name])
    finally:
        for process in nodes.values():
            process.kill()
            process.communicate()
    assert_nothing_missing(log)
    assert {message.incarnation for _, message in read(log).decoded(Truth)} == {1}
    assert (unpack_floats(truths(log)[-1].poses, 3)[:, 0] > -0.1).all()


def await_state(
    states: SimpleQueue[FormationState], what: Callable[[FormationState], bool], within_s: float = 120.0
) -> FormationState:
    """The first state for which `what` is true."""
    until = time.monotonic() + within_s
    while not what(state := states.get(timeout=60)):
        assert time.monotonic() < until, f"not within {within_s:g} s; last: {state}"
    return state


def await_life(lives: SimpleQueue[tuple[str, int, bool]], node: str, incarnation: int) -> None:
    while lives.get(timeout=60) != (node, incarnation, True):
        pass


def end(process: subprocess.Popen[str]) -> None:
    """Ended by SIGTERM, in order and in time."""
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=15)
    assert process.returncode == 0, err
    assert err == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["agent", "r9", "--scenario", "small.toml"],
            "'r9' is not in the scenario; robots are r1, r2, r3",
        ),
        (["controller", "--scenario", "missing.toml"], "missing.toml: can't be read"),
        (["controller", "--scenario", "small.toml", "--anchor", "1:2"], "must be EPOCH:MONOTONIC:SPEED"),
        (["simulator", "--scenario", "-"], "standard input holds no scenario"),
        (["simulator", "--scenario", "small.toml", "--connect", "nonsense"], "an endpoint looks like tcp/"),
        (["controller", "--scenario", "small.toml", "--anchor", "1:2:0"], "must be EPOCH:MONOTONIC:SPEED"),
        (["router", "--listen", "tcp/192.0.2.1:9"], "can't listen on tcp/192.0.2.1:9"),
        (["router", "--prefix", "a b*"], "prefix = 'a b*': must be text that matches"),
        (["recorder", "--scenario", "small.toml", "--log", "small.toml"], "exists already"),
    ],
)
def test_bad_input_of_a_node_is_one_message(tmp_path: Path, arguments: list[str], message: str) -> None:
    write(tmp_path)
    with start(*arguments, cwd=tmp_path, stdin=subprocess.DEVNULL) as process:
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.startswith("error: ")
    assert message in err
    assert "Traceback" not in err
