"""The end of a run that nobody supervises, on real sessions: who is asked to end, when, and in what order."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

from maniple.cli import finish
from maniple.cli.finish import Finisher
from maniple.cli.loading import completed
from maniple.core import codec, topics
from maniple.core.errors import RunError
from maniple.core.messages import FormationState
from maniple.host.ending import ask_to_end, end_when_asked
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import platoon, start, write
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

ROBOTS = ["r1", "r2", "r3"]
FLEET, HARDWARE = 0, 1


class Platoon:
    """Nodes that are nothing but alive until they are asked to end, on two networks."""

    def __init__(self, stack: ExitStack) -> None:
        self.ended: list[str] = []
        self._asked: SimpleQueue[tuple[str, int] | None] = SimpleQueue()
        self._lives: dict[tuple[str, int], ZenohSession] = {}
        self._endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        for network, endpoint in enumerate(self._endpoints):
            self._live("router", network, ZenohSession.router(endpoint, "maniple"))
        self.fleet, self.hardware = (
            stack.enter_context(ZenohSession.client(endpoint, "maniple")) for endpoint in self._endpoints
        )
        for node in ("controller", *ROBOTS, "recorder"):
            self.start(node)
        self.start("simulator", HARDWARE)
        self._thread = threading.Thread(target=self._end)
        self._thread.start()
        stack.callback(self.close)

    def start(self, node: str, network: int = FLEET, life: int = 1) -> None:
        self._live(node, network, ZenohSession.client(self._endpoints[network], "maniple"), life)

    def kill(self, node: str, network: int = FLEET) -> None:
        self._lives.pop((node, network)).close()

    def says(self, phase: str) -> None:
        """Of the controller."""
        state = FormationState(
            source="controller",
            incarnation=1,
            seq=0,
            stamp_ns=1,
            phase=phase,  # type: ignore[arg-type]
            task_time_s=0.0,
            task_duration_s=1.0,
            reference=(0.0, 0.0, 0.0),
            reference_velocity=(0.0, 0.0, 0.0),
            chain=tuple(ROBOTS),
            errors=b"",
            roster=(),
        )
        self._lives["recorder", FLEET].put(topics.FORMATION_STATE, codec.encode(state))

    def close(self) -> None:
        self._asked.put(None)
        self._thread.join()
        for node, network in reversed(list(self._lives)):
            self.kill(node, network)

    def _live(self, node: str, network: int, session: ZenohSession, life: int = 1) -> None:
        session.announce(node, life)
        end_when_asked(session, node, lambda: self._asked.put((node, network)))
        self._lives[node, network] = session

    def _end(self) -> None:
        while asked := self._asked.get():
            if asked in self._lives:
                self.ended.append(asked[0])
                self.kill(*asked)


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Platoon]:
    monkeypatch.setattr(finish, "POLL_S", 0.02)
    monkeypatch.setattr(finish, "RUNDOWN_S", 0.1)
    monkeypatch.setattr(finish, "END_EACH_S", 1.0)
    with ExitStack() as stack:
        yield Platoon(stack)


class Finishing:
    """`Finisher.run` in a thread."""

    def __init__(self, nodes: Platoon, limit_s: float = 60.0) -> None:
        self.said: list[str] = []
        self.outcome: list[Any] = []
        scenario = completed(platoon(3))
        self.finisher = Finisher(scenario, nodes.fleet, nodes.hardware, self.said.append)
        self._thread = threading.Thread(target=self._run, args=(limit_s,))
        self._thread.start()

    def _run(self, limit_s: float) -> None:
        try:
            self.outcome.append(self.finisher.run(limit_s))
        except RunError as error:
            self.outcome.append(str(error))

    def result(self) -> Any:
        self._thread.join(60.0)
        return self.outcome[0]


def hear_of_running(nodes: Platoon, finishing: Finishing) -> None:
    """Say it until it is heard: what is put before somebody has subscribed is lost."""

    def heard() -> bool:
        nodes.says("running")
        return "the platoon is running" in finishing.said

    eventually(heard)


def in_order(ended: list[str]) -> bool:
    return (
        ended[0] == "controller"
        and sorted(ended[1:4]) == ROBOTS
        and ended[4:6] == ["simulator", "recorder"]
        and ended[6:] == ["router", "router"]
    )


def test_when_the_task_is_done_all_are_ended_in_order(nodes: Platoon) -> None:
    finishing = Finishing(nodes)
    hear_of_running(nodes, finishing)
    assert nodes.ended == []
    nodes.says("done")
    assert finishing.result() is True
    assert in_order(nodes.ended), nodes.ended
    assert finishing.said == ["the platoon is running", "the task is done"]


def test_a_simulator_that_starts_again_ends_the_run(nodes: Platoon) -> None:
    finishing = Finishing(nodes)
    eventually(lambda: finishing.finisher.worlds == {1})
    nodes.kill("simulator", HARDWARE)
    nodes.start("simulator", HARDWARE, life=2)
    assert finishing.result() == "the simulator was started again, which is another world"
    assert in_order(nodes.ended), nodes.ended


def test_a_simulator_that_stays_away_ends_the_run_and_one_that_comes_back_does_not(
    nodes: Platoon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finish, "SIMULATOR_GONE_S", 1.0)
    finishing = Finishing(nodes)
    eventually(lambda: finishing.finisher.worlds == {1})
    nodes.kill("simulator", HARDWARE)
    nodes.start("simulator", HARDWARE)
    eventually(lambda: nodes.hardware.lives("simulator") == (1,))
    assert finishing.outcome == []
    nodes.kill("simulator", HARDWARE)
    assert finishing.result() == "the simulator has been gone for 1 s"
    assert [node for node in nodes.ended if node != "router"] == ["controller", *nodes.ended[1:4], "recorder"]


def test_a_task_that_takes_too_long_is_ended(nodes: Platoon) -> None:
    assert Finishing(nodes, limit_s=0.2).result() == "the task was not done within 0 s"
    assert in_order(nodes.ended), nodes.ended


def test_interrupted_it_leaves_everybody_as_they_are(nodes: Platoon) -> None:
    finishing = Finishing(nodes)
    finishing.finisher.interrupt()
    assert finishing.result() is False
    assert nodes.ended == []


def test_garbage_is_not_the_end(nodes: Platoon) -> None:
    finishing = Finishing(nodes)
    nodes.fleet.put_raw(topics.FORMATION_STATE, b"garbage")
    hear_of_running(nodes, finishing)
    finishing.finisher.interrupt()
    assert finishing.result() is False


@pytest.mark.parametrize("seconds", ["-1", "0", "nan", "inf", "soon"])
def test_a_duration_has_to_be_one(seconds: str, tmp_path: Path) -> None:
    process = start("finish", "--scenario", write(tmp_path), f"--duration={seconds}")
    _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert f"{seconds}: must be a number of seconds above 0" in said


def test_a_router_that_nobody_supervises_ends_when_asked(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    process = start("router", "--listen", endpoint)
    with ZenohSession.client(endpoint, "maniple", 60.0) as session:
        eventually(lambda: ask_to_end(session, "router"))
        assert process.wait(60) == 0
    process.communicate()
