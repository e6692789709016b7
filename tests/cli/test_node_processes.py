"""Processes of a platoon that nobody supervises: how they begin, die and end, by real signals."""

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from maniple.core import codec, topics
from maniple.core.errors import TransportError
from maniple.core.messages import EmergencyStop, Odometry
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.joining import clock_of
from maniple.recording.reader import read
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import SMALL, start, write
from tests.host.test_latched import stop
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually, state

SOON_S = 2.0
"""Wall time within which who is told to end has ended; and on a busy machine:"""
SLACK_S = 3.0


class Processes:
    """The commands of one platoon."""

    def __init__(self, folder: Path, text: str, stack: ExitStack) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.scenario = write(folder, text)
        self._stack = stack

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        where = ("--listen",) if arguments[0] == "router" else ("--connect",)
        process = start(*arguments, "--scenario", self.scenario, *where, self.endpoint)
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        return process

    def session(self) -> ZenohSession:
        """On the router, as soon as it is there."""

        def connect() -> ZenohSession | None:
            try:
                return ZenohSession.client(self.endpoint, "maniple", timeout_s=1.0)
            except TransportError:
                return None

        session = eventually(connect)
        assert session is not None
        self._stack.callback(session.close)
        return session


@contextmanager
def processes(folder: Path, text: str = SMALL) -> Iterator[Processes]:
    with ExitStack() as stack:
        yield Processes(folder, text, stack)


def ended(process: subprocess.Popen[str], within_s: float = 60.0) -> tuple[int, str]:
    """Its exit status, and what it said on standard error."""
    _, err = process.communicate(timeout=within_s)
    return process.returncode, err


def lives(platoon: Processes, node: str) -> tuple[int, ...]:
    session = ZenohSession.client(platoon.endpoint, "maniple")
    try:
        return session.lives(node)
    finally:
        session.close()


def odometries(session: ZenohSession) -> list[Odometry]:
    heard: list[Odometry] = []
    session.subscribe("robot/r1/odometry", lambda topic, data: heard.append(codec.decode(topic, data)))  # type: ignore[arg-type]
    session.settle()
    return heard


@pytest.mark.slow
def test_who_finds_no_router_waits_as_long_as_it_is_told(tmp_path: Path) -> None:
    with processes(tmp_path) as platoon:
        agent = platoon.start("agent", "r1", "--wait", 1)
        status, err = ended(agent)
        assert status == 2
        assert f"can't reach a router at {platoon.endpoint} within 1 s" in err
        platoon.start("agent", "r1", "--wait", 60)
        time.sleep(1.0)  # the router comes late
        platoon.start("router")
        session = platoon.session()
        assert eventually(lambda: session.lives("r1")) == (1,)


@pytest.mark.slow
@pytest.mark.parametrize("router_is", ["there", "frozen", "dead"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_who_is_told_to_end_is_gone_soon(tmp_path: Path, number: signal.Signals, router_is: str) -> None:
    """Whatever its router does."""
    with processes(tmp_path) as platoon:
        router = platoon.start("router")
        session = platoon.session()
        nodes = [platoon.start("recorder", "--log", tmp_path / "a.mcap")]
        eventually(lambda: lives(platoon, "recorder"))
        nodes += [platoon.start("agent", "r1"), platoon.start("controller"), platoon.start("simulator")]
        for name in ("r1", "controller", "simulator"):
            eventually(lambda name=name: lives(platoon, name))  # type: ignore[misc]
        heard = odometries(session)
        eventually(lambda: heard)
        if router_is == "frozen":
            router.send_signal(signal.SIGSTOP)
            eventually(lambda: state(router.pid) == "T")
        elif router_is == "dead":
            router.kill()
            router.wait()
        for node in nodes:
            node.send_signal(number)
        until = time.monotonic() + SOON_S + SLACK_S
        for node in nodes:
            assert ended(node, max(until - time.monotonic(), 0.1)) == (0, "")
        if router_is == "there":
            router.send_signal(number)
            assert router.wait(SOON_S + SLACK_S) == 0


@pytest.mark.slow
def test_one_name_one_life(tmp_path: Path) -> None:
    with processes(tmp_path) as platoon:
        platoon.start("router")
        session = platoon.session()
        first = platoon.start("agent", "r1")
        eventually(lambda: session.lives("r1"))
        second = platoon.start("agent", "r1", "--incarnation", 7)
        status, err = ended(second)
        assert (status, "r1 is running already (incarnation 1)" in err) == (2, True)
        first.kill()
        first.wait()
        status, err = ended(platoon.start("agent", "r1", "--incarnation", 1))
        assert (status, "incarnation 1 of r1 was there already: the next is 2" in err) == (2, True)
        platoon.start("agent", "r1")
        assert eventually(lambda: session.lives("r1")) == (2,)


@pytest.mark.slow
def test_a_thawed_process_steps_back_for_the_one_in_its_place(tmp_path: Path) -> None:
    text = SMALL + "network.lease_s = 0.5\n"
    with processes(tmp_path, text) as platoon:
        platoon.start("router")
        session = platoon.session()
        older = platoon.start("agent", "r1")
        eventually(lambda: session.lives("r1"))
        older.send_signal(signal.SIGSTOP)
        platoon.start("agent", "r1")
        assert eventually(lambda: (found := session.lives("r1")) == (2,) and found)
        older.send_signal(signal.SIGCONT)
        status, err = ended(older)
        assert status == 1
        assert "r1 (incarnation 1) steps back: incarnation 2 has taken over" in err
        assert eventually(lambda: session.lives("r1")) == (2,)


@pytest.mark.slow
def test_a_router_is_killed_and_the_emergency_stop_holds(tmp_path: Path) -> None:
    """Who was there holds it; who comes after the router's death gets it; the clock of the run goes on."""
    with processes(tmp_path) as platoon:
        router = platoon.start("router")
        platoon.start("agent", "r1")
        platoon.start("recorder", "--log", tmp_path / "a.mcap")
        platoon.session()
        with ZenohSession.client(platoon.endpoint, "maniple") as session:
            eventually(lambda: lives(platoon, "r1") and lives(platoon, "recorder"))
            clock = clock_of(session)
            session.put(topics.STOP, stop(5))
            assert eventually(lambda: session.ask(topics.STOP)) == {topics.STOP: stop(5)}
            router.send_signal(signal.SIGKILL)
            router.wait()
            platoon.start("router")
            assert eventually(lambda: session.ask(topics.STOP)) == {topics.STOP: stop(5)}
            assert eventually(lambda: session.ask("incarnation/r1")) == {"incarnation/r1": b"2"}
            joined = clock_of(session)
            assert joined.epoch_ns == clock.epoch_ns
            assert abs(joined.now() - clock.now()) < SECOND
            modes: list[str] = []
            session.subscribe(
                "robot/r2/status",
                lambda topic, data: modes.append(codec.decode(topic, data).mode),  # type: ignore[attr-defined]
            )
            platoon.start("agent", "r2")
            assert eventually(lambda: "emergency" in modes)
            assert isinstance(codec.decode(topics.STOP, session.ask(topics.STOP)[topics.STOP]), EmergencyStop)


CRASHES = """
[[crashes]]
node = "r1"
at_s = 1.0
restart_after_s = 3.0
[[crashes]]
node = "r2"
at_s = 1.5
[[freezes]]
node = "r3"
at_s = 2.0
for_s = 2.0
"""


@pytest.mark.slow
def test_each_process_does_to_itself_what_the_plan_says(tmp_path: Path) -> None:
    with processes(tmp_path, SMALL + CRASHES) as platoon:
        platoon.start("router")
        platoon.session()
        controller = platoon.start("controller")
        agents = {name: platoon.start("agent", name) for name in ("r1", "r2", "r3")}
        eventually(lambda: state(agents["r3"].pid) == "T")
        for name in ("r1", "r2"):
            assert agents[name].wait(60) == -signal.SIGKILL
        status, err = ended(platoon.start("agent", "r2"))
        assert (status, err) == (0, "r2 is dead for good by the fault plan (r2 crashes at 1.5 s)\n")
        again = platoon.start("agent", "r1")
        assert eventually(lambda: lives(platoon, "r1")) == (2,)
        eventually(lambda: state(agents["r3"].pid) != "T")
        again.send_signal(signal.SIGINT)
        status, err = ended(again)
        assert status == 0
        assert err in ("", "r1 is dead by the fault plan until 4 s of the run: waits\n")
        assert controller.poll() is None


@pytest.mark.slow
def test_a_recording_goes_on_in_its_next_part(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with processes(tmp_path) as platoon:
        platoon.start("router")
        session = platoon.session()
        for part in ("a.mcap", "a-2.mcap", "a-3.mcap"):
            recorder = platoon.start("recorder", "--log", log, "--next")
            eventually(lambda: session.lives("recorder"))
            recorder.send_signal(signal.SIGTERM)
            assert ended(recorder) == (0, "")
            eventually(lambda: not session.lives("recorder"))
            assert read(tmp_path / part).scenario_json
        status, err = ended(platoon.start("recorder", "--log", log))
        assert status == 2
        assert f"{log} exists already; a recording is never overwritten" in " ".join(err.split())


def test_all_that_join_share_the_epoch_of_the_run(tmp_path: Path) -> None:
    with processes(tmp_path) as platoon:
        anchor = Anchor(7 * SECOND, time.monotonic_ns(), 2.0)
        platoon.start("router", "--anchor", anchor)
        session = platoon.session()
        joined = eventually(lambda: (clock := clock_of(session)).epoch_ns == anchor.epoch_ns and clock)
        assert joined == Anchor(anchor.epoch_ns, joined.monotonic_ns, 2.0)  # type: ignore[union-attr]
