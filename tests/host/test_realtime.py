"""The realtime host over real Zenoh: the nodes of the virtual tests, each with a host and a thread."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from queue import SimpleQueue

import pytest

from maniple.core import codec, topics
from maniple.core.envelope import envelope_of
from maniple.core.messages import Alive, Call, Command, Decisions, Journal, Refused
from maniple.core.node import Node
from maniple.core.scenario.types import Scenario
from maniple.host.clock import Anchor
from maniple.host.realtime import RealtimeHost
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.host.nodes import Answerer, Reporter, scenario_with
from tests.transport.test_zenoh import DEADLINE_S, free_port

Said = SimpleQueue[tuple[str, bytes]]


@contextmanager
def platoon(scenario: Scenario, *nodes: Node, speed: float = 5.0) -> Iterator[tuple[str, Said]]:
    """A router, the nodes, and everything that is said; all stopped in the end, in order."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    clock = Anchor.here(speed)
    said: Said = SimpleQueue()
    ended = {f"journal/{node.name}": threading.Event() for node in nodes}

    def listen(topic: str, data: bytes) -> None:
        said.put((topic, data))
        if topic in ended and any(call.kind == "stop" for call in calls_of(topic, data)):
            ended[topic].set()

    with ExitStack() as stack:
        router = stack.enter_context(ZenohSession.router(endpoint, "test"))
        serve(router)
        ear = stack.enter_context(ZenohSession.client(endpoint, "test"))
        ear.subscribe("**", listen)
        ear.settle()
        for end in ended.values():  # what was said last is heard before the ear closes
            stack.callback(end.wait, DEADLINE_S)
        for node in nodes:
            session = stack.enter_context(ZenohSession.client(endpoint, "test"))
            host = RealtimeHost(node, 1, scenario, clock, session, session)
            thread = threading.Thread(target=host.run)
            thread.start()
            stack.callback(thread.join, DEADLINE_S)
            stack.callback(host.stop)
        yield endpoint, said


def hear(said: Said, topic: str, count: int) -> list[bytes]:
    """The next `count` messages of a topic."""
    found: list[bytes] = []
    while len(found) < count:
        name, data = said.get(timeout=DEADLINE_S)
        if name == topic:
            found.append(data)
    return found


def test_reports_are_answered_and_numbered_without_a_gap() -> None:
    reporter = Reporter()
    with platoon(scenario_with(), reporter, Answerer()) as (_, said):
        heard = [codec.decode("robot/r1/command", data) for data in hear(said, "robot/r1/command", 20)]
    assert [message.seq for message in heard] == list(range(20))
    answered = [message for _, message in reporter.heard if isinstance(message, Command)]
    assert [message.seq for message in answered] == list(range(answered[0].seq, answered[-1].seq + 1))
    assert reporter.stopped


def test_the_last_word_of_a_stopped_node_is_sent() -> None:
    with platoon(scenario_with(), Reporter()) as (_, said):
        hear(said, "robot/r1/odometry", 2)
    rest = []
    while not said.empty():
        rest.append(said.get_nowait())
    last = [codec.decode(topic, data) for topic, data in rest if topic == "robot/r1/odometry"][-1]
    assert getattr(last, "x_m", None) == -1.0
    calls = [call for topic, data in rest for call in calls_of(topic, data)]
    assert calls[-1].kind == "stop"


def test_garbage_and_strangers_are_refused_and_the_node_lives_on() -> None:
    reporter = Reporter()
    with platoon(scenario_with(), reporter) as (endpoint, said), ZenohSession.client(endpoint, "test") as foe:
        hear(said, "robot/r1/odometry", 1)
        foe.put_raw("robot/r1/command", b"\xc1")
        foe.put_raw("robot/r1/command", b"")
        hear(said, "robot/r1/odometry", 20)
    reasons = [message.reason for _, message in reporter.heard if isinstance(message, Refused)]
    assert reasons == ["malformed", "malformed"]


def test_nodes_see_each_other_live() -> None:
    reporter = Reporter()
    with platoon(scenario_with(), Answerer(), reporter) as (_, said):
        hear(said, "robot/r1/command", 1)
    assert ("controller", True) in [(m.node, m.alive) for _, m in reporter.heard if isinstance(m, Alive)]


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_injected_delay_and_loss_are_those_of_the_decisions(loss: float) -> None:
    fault = {"source": "r1", "loss": loss, "latency_s": 0.2, "jitter_s": 0.05}
    scenario = scenario_with(faults=[fault])
    with platoon(scenario, Reporter(), Answerer()) as (_, said):
        reports = [envelope_of("robot/r1/odometry", d) for d in hear(said, "robot/r1/odometry", 40)]
        waited = hear(said, "journal/controller", 3)
    everything = [("journal/controller", data) for data in waited]
    while not said.empty():
        everything.append(said.get_nowait())
    decided = {}
    received = {}
    for topic, data in everything:
        message = codec.decode(topic, data)
        if isinstance(message, Decisions):
            decided.update({d.seq: d for d in message.decided})
        for call in calls_of(topic, data):
            if call.name == "robot/r1/odometry":
                received[call.seq] = call.now_ns
    stamps = {report.seq: report.stamp_ns for report in reports}
    assert received
    for seq in received.keys() & decided.keys() & stamps.keys():
        assert not decided[seq].dropped
        assert received[seq] - stamps[seq] >= decided[seq].delay_ns


def calls_of(topic: str, data: bytes) -> tuple[Call, ...]:
    if not topic.startswith("journal/"):
        return ()
    message = codec.decode(topic, data)
    assert isinstance(message, Journal)
    return message.calls


def test_everything_said_is_in_the_table() -> None:
    with platoon(scenario_with(), Reporter(), Answerer()) as (_, said):
        hear(said, "robot/r1/command", 5)
    while not said.empty():
        assert topics.topic(said.get_nowait()[0]).recorded
