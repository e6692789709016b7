"""The realtime host over real Zenoh: the nodes of the virtual tests, each with a host and a thread."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

import msgspec
import pytest

from maniple.core import codec, topics
from maniple.core.envelope import envelope_of
from maniple.core.errors import RunError
from maniple.core.messages import (
    Alive,
    Call,
    Command,
    Decisions,
    EmergencyStop,
    FaultPlan,
    Journal,
    Message,
    Odometry,
    Refused,
)
from maniple.core.node import Node, Outgoing
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Time
from maniple.host.clock import Anchor
from maniple.host.fate import Death, Meet, Pause, meet
from maniple.host.joining import clock_of
from maniple.host.realtime import RealtimeHost
from maniple.host.router import RouterHost
from maniple.transport.zenoh import MAX_BYTES, ZenohSession, crc_of
from tests.host.nodes import Answerer, Reporter, command, scenario_with
from tests.host.test_latched import stop
from tests.transport.test_zenoh import DEADLINE_S, free_port
from tests.waiting import eventually

Said = SimpleQueue[tuple[str, bytes]]


@contextmanager
def platoon(
    scenario: Scenario, *nodes: Node, speed: float = 5.0, meet: Meet = meet
) -> Iterator[tuple[str, Said]]:
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
        session = stack.enter_context(ZenohSession.router(endpoint, "test"))
        router = RouterHost(session, clock, scenario, grace_s=0.0)
        router.start()
        stack.callback(start(lambda: router.run(0.0)).join, DEADLINE_S)
        stack.callback(router.stop)
        ear = stack.enter_context(ZenohSession.client(endpoint, "test"))
        ear.subscribe("**", listen)
        ear.settle()
        for end in ended.values():  # what was said last is heard before the ear closes
            stack.callback(end.wait, DEADLINE_S)
        for node in nodes:
            session = stack.enter_context(ZenohSession.client(endpoint, "test"))
            host = RealtimeHost(node, 1, scenario, clock, session, session, meet)
            thread = start(host.run)
            stack.callback(thread.join, DEADLINE_S)
            stack.callback(host.stop)
        yield endpoint, said


def start(run: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=run)
    thread.start()
    return thread


@contextmanager
def hosted(
    endpoint: str, node: Node, scenario: Scenario, life: int = 1, clock: Anchor | None = None
) -> Iterator[SimpleQueue[str]]:
    """Another node of a platoon; yields where it says, when it ends, what failed."""
    ended: SimpleQueue[str] = SimpleQueue()
    with ZenohSession.client(endpoint, "test") as session:
        host = RealtimeHost(node, life, scenario, clock or Anchor.here(5.0), session, session)
        thread = start(lambda: ended.put(failure_of(host)))
        try:
            yield ended
        finally:
            host.stop()
            thread.join(DEADLINE_S)


def failure_of(host: RealtimeHost) -> str:
    try:
        host.run()
    except RunError as error:
        return str(error)
    return ""


def hear(said: Said, topic: str, count: int) -> list[bytes]:
    """The next `count` messages of a topic, which come while others do."""
    found: list[bytes] = []
    until = time.monotonic() + count * DEADLINE_S
    while len(found) < count:
        name, data = said.get(timeout=max(until - time.monotonic(), 0.0))
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


def told(reporter: Reporter, kind: type[Message]) -> list[Message]:
    return [message for _, message in list(reporter.heard) if isinstance(message, kind)]


def order(clock: Anchor, number: int, **changes: Any) -> bytes:
    """A plan as an operator sends it, beginning now."""
    head = {"source": "operator", "incarnation": number, "since_ns": clock.now()}
    return codec.encode(msgspec.convert(head | changes, FaultPlan))


def clock_at(endpoint: str) -> Anchor:
    with ZenohSession.client(endpoint, "test") as session:
        return clock_of(session)


def test_a_plan_counts_from_when_it_comes_and_late_joiners_have_it() -> None:
    scenario = scenario_with()
    early, late = Reporter("r1"), Reporter("r2")
    everything = {"source": "controller", "topic": "robot/*/command", "loss": 1.0}
    with (
        platoon(scenario, early, Answerer(("r1", "r2"))) as (endpoint, said),
        ZenohSession.client(endpoint, "test") as operator,
    ):
        clock = clock_at(endpoint)
        eventually(lambda: told(early, Command))
        operator.settle()
        operator.put(topics.PLAN, order(clock, 1, faults=[everything]))
        hear(said, topics.DECISIONS, 1)
        count = len(told(early, Command))
        with hosted(endpoint, late, scenario, clock=clock):
            decided = 0
            while decided < 10:
                message = codec.decode(topics.DECISIONS, hear(said, topics.DECISIONS, 1)[0])
                assert isinstance(message, Decisions)
                decided += sum(one.topic == "robot/r2/command" for one in message.decided)
            assert told(late, Command) == []
            assert len(told(early, Command)) == count
            operator.put(topics.PLAN, order(clock, 2))
            eventually(lambda: told(late, Command))
            operator.put(topics.PLAN, order(clock, 1, faults=[everything]))  # an old one changes nothing
            before = len(told(early, Command))
            eventually(lambda: len(told(early, Command)) > before + 5)
            operator.put_raw(topics.PLAN, b"\x93")
            eventually(lambda: len(told(early, Command)) > before + 10)


def test_a_process_meets_what_the_plan_has_in_store_for_it_once() -> None:
    met: SimpleQueue[Death | Pause] = SimpleQueue()
    freezes = [{"node": "r1", "at_s": at, "for_s": 0.5} for at in (1.0, 2.0)]
    scenario = scenario_with(freezes=freezes, crashes=[{"node": "r1", "at_s": 3.0}])
    nodes = (Reporter(), Answerer())
    with platoon(scenario, *nodes, meet=lambda event, _: met.put(event)) as (_, said):
        events = [met.get(timeout=DEADLINE_S) for _ in range(3)]
        hear(said, "robot/r1/odometry", 1)
    assert [type(event) for event in events] == [Pause, Pause, Death]


def test_a_cut_link_hides_a_life_after_the_lease_and_shows_it_again() -> None:
    partition = {"groups": [["r1"], ["controller"]], "at_s": 1.0, "for_s": 4.0}
    reporter = Reporter()
    scenario = scenario_with(partitions=[partition], network={"lease_s": 1.0})
    with platoon(scenario, reporter, Answerer()) as (_, said):
        eventually(lambda: len([m for m in lives(reporter) if m == ("controller", True)]) == 2)
        plan = codec.decode(topics.PLAN, hear(said, topics.PLAN, 1)[0])
        assert isinstance(plan, FaultPlan)
    changes = [
        ((at - plan.since_ns) / SECOND, message.alive)
        for at, message in reporter.heard
        if isinstance(message, Alive) and message.node == "controller"
    ]
    (_, first), (gone_s, gone), (back_s, back) = changes
    assert (first, gone, back) == (True, False, True)
    assert gone_s >= 1.0 + 1.0
    assert back_s >= 1.0 + 4.0


def lives(reporter: Reporter) -> list[tuple[str, bool]]:
    return [(m.node, m.alive) for m in told(reporter, Alive) if isinstance(m, Alive)]


def test_of_two_with_one_name_the_older_stops_and_says_who_took_over() -> None:
    older, newer = Reporter(), Reporter()
    scenario = scenario_with()
    with platoon(scenario) as (endpoint, said), hosted(endpoint, older, scenario) as ended:
        hear(said, "robot/r1/odometry", 3)
        with hosted(endpoint, newer, scenario, life=2) as at_the_end:
            assert ended.get(timeout=DEADLINE_S) == (
                "r1 (incarnation 1) steps back: incarnation 2 has taken over"
            )
            assert older.stopped
            seen = [envelope_of("robot/r1/odometry", d) for d in hear(said, "robot/r1/odometry", 20)]
            assert seen[-1].incarnation == 2
            assert not newer.stopped
        assert at_the_end.get(timeout=DEADLINE_S) == ""


class Failing(Reporter):
    """Fails at its tenth report."""

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        self.heard.append((now, Message()))
        if sum(type(message) is Message for _, message in self.heard) == 10:
            raise ZeroDivisionError("one over nothing")
        return super().on_timer(timer, now)


def test_a_node_that_fails_is_stopped_and_says_its_last(capfd: pytest.CaptureFixture[str]) -> None:
    scenario, broken = scenario_with(), Failing()
    with platoon(scenario) as (endpoint, said), hosted(endpoint, broken, scenario) as ended:
        failure = ended.get(timeout=DEADLINE_S)
        assert failure == "r1 (incarnation 1) failed: ZeroDivisionError: one over nothing"
        *_, last = (codec.decode("robot/r1/odometry", d) for d in hear(said, "robot/r1/odometry", 10))
    assert isinstance(last, Odometry)
    assert last.x_m == -1.0  # what it says when it is stopped
    assert "Traceback" in capfd.readouterr().err


def test_what_is_not_what_was_sent_is_refused_and_counted() -> None:
    reporter = Reporter()
    with (
        platoon(scenario_with(), reporter) as (endpoint, said),
        ZenohSession.client(endpoint, "test") as foe,
    ):
        hear(said, "robot/r1/odometry", 1)
        whole = codec.encode(command(source="controller"))
        foe.put_raw("robot/r1/command", whole[:-1] + b"\x01", crc_of(whole))
        eventually(lambda: told(reporter, Refused))
        while len(told(reporter, Refused)) < 2:  # a busy network drops what is huge by itself
            foe.put_raw("robot/r1/command", bytes(MAX_BYTES + 1))
            hear(said, "robot/r1/odometry", 3)
    first, second, *_ = (m for m in told(reporter, Refused) if isinstance(m, Refused))
    assert (first.reason, second.reason) == ("corrupted", "huge")


def test_garbage_on_every_topic_is_counted_and_the_node_goes_on() -> None:
    reporter = Reporter()
    names = [row.pattern.replace("{id}", "r1") for row in topics.TOPICS]
    payloads = [b"", b"\xc1", b"\x80", bytes(100), codec.encode(Odometry(**FORGED))]
    with (
        platoon(scenario_with(), reporter) as (endpoint, said),
        ZenohSession.client(endpoint, "test") as foe,
    ):
        hear(said, "robot/r1/odometry", 1)
        for name in (*names, "no/topic", "platoon", "a" * 300):
            for data in payloads:
                foe.put_raw(name, data)
        told_of = ("robot/r1/command", topics.PLAN)  # what it listens to
        expected = len(told_of) * len(payloads)
        eventually(
            lambda: sum(m.count for m in told(reporter, Refused) if isinstance(m, Refused)) >= expected
        )
        hear(said, "robot/r1/odometry", 20)
    refused = [m for m in told(reporter, Refused) if isinstance(m, Refused)]
    assert {m.topic for m in refused} == set(told_of)
    assert sum(m.count for m in refused) == expected


FORGED: dict[str, Any] = {
    "source": "r1",
    "incarnation": 2**61,
    "seq": 2**61,
    "frame_id": "r1",
    **dict.fromkeys(("x_m", "y_m", "psi_rad", "u_mps", "w_radps"), 0.0),
}


def test_a_clock_that_is_off_is_the_nodes_own_affair() -> None:
    """It is shown its own; delays, timers and windows are right all the same."""
    off = {"node": "r1", "offset_s": 1e5, "skew_ppm": 10_000.0}
    scenario = scenario_with(clocks=[off], faults=[{"source": "r1", "latency_s": 0.4}])
    reporter = Reporter()
    with platoon(scenario, reporter, Answerer()) as (_, said):
        reports = [envelope_of("robot/r1/odometry", d) for d in hear(said, "robot/r1/odometry", 30)]
        hear(said, "robot/r1/command", 5)
    stamps = [report.stamp_ns for report in reports]
    assert min(stamps) - time.time_ns() > 0.9e5 * SECOND
    gaps = sorted(after - before for before, after in pairwise(stamps))
    assert gaps[len(gaps) // 2] == pytest.approx(SECOND / 10, rel=0.3)


class Ordered(Reporter):
    """One that listens for the emergency stop."""

    def __init__(self, name: str = "r1") -> None:
        super().__init__(name)
        self.subscriptions |= {topics.STOP}


def test_an_emergency_stop_survives_the_router() -> None:
    """Killed without a word and started anew: it knows again what it knew, and so does who comes then."""
    scenario = scenario_with()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    clock = Anchor.here(5.0)
    ordered, late = Ordered(), Ordered("r2")
    with ExitStack() as stack:
        first = ZenohSession.router(endpoint, "test")
        RouterHost(first, clock).start()
        stack.enter_context(hosted(endpoint, ordered, scenario, life=4, clock=clock))
        with ZenohSession.client(endpoint, "test") as operator:
            operator.put(topics.STOP, stop(7))
            eventually(lambda: told(ordered, EmergencyStop))
        first.close()
        second = stack.enter_context(ZenohSession.router(endpoint, "test"))
        RouterHost(second).start()
        asker = stack.enter_context(ZenohSession.client(endpoint, "test"))
        assert eventually(lambda: asker.ask(topics.STOP)) == {topics.STOP: stop(7)}
        assert asker.ask("incarnation/r1") == {"incarnation/r1": b"5"}
        assert clock_of(asker).epoch_ns == clock.epoch_ns
        with hosted(endpoint, late, scenario, clock=clock):
            eventually(lambda: told(late, EmergencyStop))
        assert len(told(ordered, EmergencyStop)) == 1
        assert told(ordered, Refused) == []  # said again, it is dropped silently


def test_who_spoke_before_a_node_came_is_believed() -> None:
    """The first that arrives may be of a life whose token was there long before."""
    scenario = scenario_with()
    ended = threading.Event()
    with platoon(scenario) as (endpoint, _), ZenohSession.client(endpoint, "test") as session:
        session.announce("controller", 1)

        def speak() -> None:
            seq = 0
            while not ended.wait(0.0005):
                said = command(source="controller", seq=seq, incarnation=1)
                session.put(topics.command("r1"), codec.encode(said))
                seq += 1

        speaker = start(speak)
        try:
            for _ in range(5):
                assert not refusals_of_a_newcomer(endpoint, scenario)
        finally:
            ended.set()
            speaker.join(DEADLINE_S)


def refusals_of_a_newcomer(endpoint: str, scenario: Scenario) -> list[Refused]:
    """What a node was not let hear until it heard a command."""
    reporter = Reporter()
    with hosted(endpoint, reporter, scenario):
        eventually(lambda: any(isinstance(message, Command) for _, message in reporter.heard))
    return [message for _, message in reporter.heard if isinstance(message, Refused)]
