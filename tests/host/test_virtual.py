"""Virtual time: order, latency, faults, and the same bytes every time."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import pytest
from msgspec.structs import replace

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.messages import Alive, Command, Decisions, FaultPlan, Goal, Message
from maniple.core.node import Node, Outgoing, Received
from maniple.core.scenario.types import Crash, Fault, Freeze
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH, Time
from maniple.host.virtual import VirtualHost, timer_phase
from tests.host.nodes import Answerer, Reporter, scenario_with


def run(seconds: float, **changes: Any) -> tuple[list[tuple[Time, Envelope]], dict[str, Reporter]]:
    robots = {name: Reporter(name) for name in ("r2", "r1")}
    said: list[tuple[Time, Envelope]] = []
    nodes: list[Node] = [*robots.values(), Answerer(("r1", "r2"))]
    host = VirtualHost(nodes, scenario_with(**changes), lambda envelope, at: said.append((at, envelope)))
    host.start()
    begin = host.now
    host.run(begin + round(seconds * SECOND))
    assert host.now == begin + round(seconds * SECOND)
    host.stop(["controller", "r1", "r2"])
    return said, robots


def test_every_report_is_answered_after_two_latencies() -> None:
    _, robots = run(10.0)
    commands = [(at, m) for at, m in robots["r1"].heard if isinstance(m, Command)]
    assert len(commands) == 100
    assert {at - m.answers.stamp_ns for at, m in commands} == {2 * MILLISECOND}


def test_times_of_the_tap_never_go_back() -> None:
    said, _ = run(5.0)
    times = [at for at, _ in said]
    assert times == sorted(times)


def test_the_same_run_says_the_same_bytes_and_another_seed_other_ones() -> None:
    assert run(5.0)[0] == run(5.0)[0]
    assert run(5.0)[0] != run(5.0, seed=2)[0]


def test_timers_keep_their_phase() -> None:
    said, _ = run(3.0)
    reports = [e.stamp_ns for _, e in said if e.topic == topics.odometry("r1")][:-1]
    phase = timer_phase(1, "r1", "report", SECOND // 10)
    assert [t % (SECOND // 10) for t in reports] == [phase] * len(reports)


def test_nodes_hear_who_lives_and_who_stopped() -> None:
    _, robots = run(1.0)
    lives = [(m.node, m.alive) for _, m in robots["r2"].heard if isinstance(m, Alive)]
    assert lives == [("controller", True), ("r1", True), ("controller", False), ("r1", False)]


def test_loss_and_delay_are_what_the_decisions_say() -> None:
    fault = {"source": "r*", "destination": "controller", "loss": 0.3, "latency_s": 0.1, "jitter_s": 0.02}
    said, robots = run(60.0, faults=[fault])
    decided = [
        d
        for _, e in said
        if e.topic == topics.DECISIONS
        for m in [codec.decode(e.topic, e.data)]
        if isinstance(m, Decisions)
        for d in m.decided
    ]
    answered = {
        m.answers.seq: at - m.answers.stamp_ns for at, m in robots["r1"].heard if isinstance(m, Command)
    }
    mine = {d.seq: d for d in decided if d.source == "r1"}
    lost = {seq for seq, d in mine.items() if d.dropped}
    assert 0.2 < len(lost) / len(mine) < 0.4
    assert not lost & set(answered)
    for seq, delay in answered.items():
        assert delay == mine[seq].delay_ns + 2 * MILLISECOND
        assert 80 * MILLISECOND <= mine[seq].delay_ns <= 120 * MILLISECOND


def test_halt_ends_the_run_at_the_event_it_is_at() -> None:
    def tap(envelope: Envelope, _: Time) -> None:
        if envelope.topic == topics.odometry("r1") and envelope.seq == 3:
            host.halt()

    host = VirtualHost([Reporter()], scenario_with(), tap)
    host.start()
    begin = host.now
    host.run(begin + 60 * SECOND)
    assert host.now - begin < SECOND


@pytest.mark.parametrize("period", [1, 7, SECOND])
def test_phases_lie_within_the_period(period: int) -> None:
    assert all(0 <= timer_phase(seed, "r1", "t", period) < period for seed in range(50))


def crashing(seconds: float, host: str | None = None, **crash: Any) -> tuple[list[Envelope], Node]:
    """Two reporters and a controller, one of which dies and may come back."""
    said: list[Envelope] = []
    factories: dict[str, Callable[[int], Node]] = {
        "r1": lambda _: Reporter("r1"),
        "r2": lambda _: Reporter("r2"),
        "controller": lambda _: Answerer(("r1", "r2")),
    }
    nodes: list[Node] = [make(1) for make in factories.values()]
    scenario = scenario_with(crashes=[crash], controller={} if host is None else {"host": host})
    virtual = VirtualHost(nodes, scenario, lambda envelope, _: said.append(envelope), factories)
    virtual.start()
    virtual.run(virtual.now + round(seconds * SECOND))
    virtual.stop(["controller", "r1", "r2"])
    return said, nodes[0]


def lives_of(said: list[Envelope], node: str) -> dict[int, list[float]]:
    """First and last stamp of every life of a node, s since the start."""
    lives: dict[int, list[float]] = {}
    for envelope in said:
        if envelope.source == node:
            lives.setdefault(envelope.incarnation, []).append((envelope.stamp_ns - VIRTUAL_EPOCH) / SECOND)
    return {life: [min(stamps), max(stamps)] for life, stamps in lives.items()}


def test_a_node_dies_without_a_word_and_comes_back_in_its_next_life() -> None:
    said, _ = crashing(10.0, node="r2", at_s=3.0, restart_after_s=2.0)
    lives = lives_of(said, "r2")
    assert lives[1] == pytest.approx([0.0, 3.0], abs=0.11)
    assert lives[2] == pytest.approx([5.0, 10.0], abs=0.11)
    reports = [e.stamp_ns for e in said if e.topic == topics.odometry("r2") and e.incarnation == 2]
    assert {b - a for a, b in pairwise(reports[:-1])} == {SECOND // 10}  # no timer of the first life goes on
    assert crashing(10.0, node="r2", at_s=3.0, restart_after_s=2.0)[0] == said


def test_the_others_hear_of_it_and_the_new_life_gets_what_is_latched() -> None:
    _, first = crashing(10.0, node="r2", at_s=3.0, restart_after_s=2.0)
    assert isinstance(first, Reporter)
    news = [(m.node, m.node_incarnation, m.alive) for _, m in first.heard if isinstance(m, Alive)]
    assert ("r2", 1, False) in news
    assert ("r2", 2, True) in news


def test_what_is_stopped_while_it_is_dead_stays_so() -> None:
    said: list[Envelope] = []
    factories: dict[str, Callable[[int], Node]] = {
        "r1": lambda _: Reporter("r1"),
        "r2": lambda _: Reporter("r2"),
    }
    scenario = scenario_with(crashes=[{"node": "r2", "at_s": 1.0, "restart_after_s": 2.0}])
    nodes = [make(1) for make in factories.values()]
    host = VirtualHost(nodes, scenario, lambda envelope, _: said.append(envelope), factories)
    host.start()
    host.run(host.now + 2 * SECOND)
    host.stop(["r2"])
    host.run(host.now + 2 * SECOND)
    assert set(lives_of(said, "r2")) == {1}


def test_nothing_is_decided_on_what_a_dead_node_was_sent() -> None:
    """One whose restart was not to be would receive nothing; nor does one that is between two lives."""
    said: list[Envelope] = []
    factories: dict[str, Callable[[int], Node]] = {
        "r1": lambda _: Reporter("r1"),
        "controller": lambda _: Answerer(("r1",)),
    }
    crash = {"node": "controller", "at_s": 1.0, "restart_after_s": 3.0}
    scenario = scenario_with(crashes=[crash], faults=[{"latency_s": 0.01}])
    nodes = [make(1) for make in factories.values()]
    host = VirtualHost(nodes, scenario, lambda envelope, _: said.append(envelope), factories)
    host.start()
    host.run(host.now + 6 * SECOND)
    host.stop(["controller", "r1"])
    sent = {(e.incarnation, e.seq): e.stamp_ns for e in said if e.topic == topics.odometry("r1")}
    when = []
    for envelope in said:
        if envelope.topic == topics.DECISIONS and envelope.source == "controller":
            message = codec.decode(envelope.topic, envelope.data)
            assert isinstance(message, Decisions)
            when += [(sent[d.incarnation, d.seq] - VIRTUAL_EPOCH) / SECOND for d in message.decided]
    assert when
    assert all(at <= 1.0 or at >= 3.9 for at in when)


def test_a_controller_on_a_robot_dies_with_it() -> None:
    said, _ = crashing(6.0, host="r1", node="r1", at_s=2.0)
    assert lives_of(said, "controller")[1][1] == pytest.approx(2.0, abs=0.21)
    assert lives_of(said, "r2")[1][1] == pytest.approx(6.0, abs=0.01)


def test_links_within_a_computer_have_no_faults() -> None:
    fault = {"loss": 0.5, "latency_s": 0.1}
    said: list[tuple[Time, Envelope]] = []
    robots = [Reporter("r1"), Reporter("r2")]
    scenario = scenario_with(faults=[fault], controller={"host": "r1"})
    host = VirtualHost(
        [*robots, Answerer(("r1", "r2"))], scenario, lambda envelope, at: said.append((at, envelope))
    )
    host.start()
    host.run(host.now + 10 * SECOND)
    ages = [{at - m.answers.stamp_ns for at, m in robot.heard if isinstance(m, Command)} for robot in robots]
    assert max(ages[0]) < MILLISECOND
    assert min(ages[1]) >= 200 * MILLISECOND


def stamps(said: list[tuple[Time, Envelope]], topic: str, source: str) -> list[float]:
    """When a node said something on a topic, true time, s since the start."""
    latency = MILLISECOND
    return [
        (at - latency - VIRTUAL_EPOCH) / SECOND for at, e in said if (e.topic, e.source) == (topic, source)
    ]


def alive_by(reporter: Reporter, node: str) -> list[tuple[float, bool]]:
    """What a node was told of another's life, and when."""
    return [
        ((at - VIRTUAL_EPOCH) / SECOND, m.alive)
        for at, m in reporter.heard
        if isinstance(m, Alive) and m.node == node
    ]


def test_a_frozen_node_says_nothing_skips_its_timers_and_then_gets_what_waited() -> None:
    said, robots = run(10.0, freezes=[{"node": "r2", "at_s": 3.0, "for_s": 4.0}])
    spoken = stamps(said, topics.odometry("r2"), "r2")
    assert not [t for t in spoken if 3.0 < t < 7.0]
    phase = timer_phase(1, "r2", "report", SECOND // 10) / SECOND
    assert {round((t - phase) % 0.1, 6) % 0.1 for t in spoken[:-1]} == {0.0}, "it keeps its phase"
    assert len(spoken) == pytest.approx(60, abs=2), "and does not catch up"
    assert alive_by(robots["r1"], "r2")[1:] == [(5.0, False), (7.0, True)]


def test_what_was_sent_to_a_frozen_node_arrives_when_it_goes_on() -> None:
    _, robots = run(10.0, freezes=[{"node": "controller", "at_s": 3.0, "for_s": 1.0}])
    commands = [(at - VIRTUAL_EPOCH, m) for at, m in robots["r1"].heard if isinstance(m, Command)]
    late = [at for at, m in commands if 3 * SECOND < m.answers.stamp_ns - VIRTUAL_EPOCH < 4 * SECOND]
    assert len(late) == 10
    assert set(late) == {4 * SECOND + MILLISECOND}
    assert len(alive_by(robots["r1"], "controller")) == 2, "it was shorter than the lease"


def test_a_node_sees_only_its_own_clock_and_its_timers_go_by_it() -> None:
    error = {"node": "r1", "offset_s": -1000.0, "skew_ppm": 5000.0}
    said, robots = run(100.0, clocks=[error])
    true = stamps(said, topics.odometry("r1"), "r1")[:-1]
    shown = [e.stamp_ns for _, e in said if e.topic == topics.odometry("r1")][:-1]
    assert shown[0] == pytest.approx(VIRTUAL_EPOCH - 1000 * SECOND, abs=SECOND)
    assert {b - a for a, b in pairwise(shown)} <= {SECOND // 10 + k for k in (-1, 0, 1)}
    assert (true[-1] - true[0]) * 1.005 == pytest.approx((shown[-1] - shown[0]) / SECOND, abs=1e-6)
    ages = [at - m.answers.stamp_ns for at, m in robots["r1"].heard if isinstance(m, Command)]
    assert max(ages) - min(ages) < MILLISECOND, "the round trip by its own clock"


def test_a_partition_ends_what_is_heard_and_after_the_lease_who_lives() -> None:
    cut = {"groups": [["r2"]], "at_s": 2.0, "for_s": 4.0}
    _, robots = run(10.0, partitions=[cut])
    gap = [(at - VIRTUAL_EPOCH) / SECOND for at, m in robots["r2"].heard if isinstance(m, Command)]
    assert not [t for t in gap if 2.01 < t < 6.0]
    (ends, gone), (back, there) = alive_by(robots["r2"], "controller")[1:3]
    assert (gone, there) == (False, True)
    assert ends == pytest.approx(4.1, abs=0.2)
    assert back == pytest.approx(6.1, abs=0.2)
    assert len([m for _, m in robots["r1"].heard if isinstance(m, Command)]) == 100


def test_the_same_faults_say_the_same_bytes() -> None:
    plan: dict[str, Any] = {
        "faults": [{"loss": 0.2, "duplicate": 0.1, "corrupt": 0.1, "reorder": 0.1, "jitter_s": 0.1}],
        "freezes": [{"node": "r1", "at_s": 1.0, "for_s": 0.5}],
        "clocks": [{"node": "r2", "offset_s": 7.0, "skew_ppm": -100}],
    }
    assert run(5.0, **plan)[0] == run(5.0, **plan)[0]


def told(seconds: float, *plans: tuple[float, FaultPlan], **changes: Any) -> list[Envelope]:
    """Two reporters and a controller under plans that come while they run."""
    said: list[Envelope] = []
    factories: dict[str, Callable[[int], Node]] = {
        "r1": lambda _: Reporter("r1"),
        "r2": lambda _: Reporter("r2"),
        "controller": lambda _: Answerer(("r1", "r2")),
    }
    inputs = [_from_operator(at_s, life, plan) for life, (at_s, plan) in enumerate(plans, 1)]
    nodes: list[Node] = [make(1) for make in factories.values()]
    host = VirtualHost(
        nodes, scenario_with(**changes), lambda envelope, _: said.append(envelope), factories, inputs
    )
    host.start()
    host.run(host.now + round(seconds * SECOND))
    host.stop(["controller", "r1", "r2"])
    return said


def _from_operator(at_s: float, life: int, message: Message) -> tuple[Time, Envelope]:
    now = VIRTUAL_EPOCH + round(at_s * SECOND)
    sent = replace(message, source="operator", incarnation=life, stamp_ns=now)
    return now, envelope_of(topics.PLAN, codec.encode(sent))


def reports_between(said: list[Envelope], begin: float, end: float) -> int:
    """How many odometries of r2 were answered of those sent in that time."""
    commands = [
        m
        for e in said
        if e.topic == topics.command("r2") and isinstance(m := codec.decode(e.topic, e.data), Command)
    ]
    stamps = [(m.answers.stamp_ns - VIRTUAL_EPOCH) / SECOND for m in commands]
    return sum(begin <= stamp < end for stamp in stamps)


PLAN = FaultPlan(since_ns=VIRTUAL_EPOCH)


def test_a_plan_that_comes_later_takes_the_place_of_the_one_before() -> None:
    cut = replace(PLAN, faults=(Fault(source="r2", loss=1.0),))
    said = told(9.0, (3.0, cut), (6.0, PLAN))
    assert [reports_between(said, *span) for span in ((0, 3), (3, 6), (6, 8.9))] == [30, 0, 29]
    assert [e.stamp_ns - VIRTUAL_EPOCH for e in said if e.topic == topics.PLAN] == [3 * SECOND, 6 * SECOND]


def test_a_plan_that_is_not_newer_changes_nothing() -> None:
    cut = replace(PLAN, faults=(Fault(source="r2", loss=1.0),))
    said = told(6.0, (2.0, cut), (1.0, PLAN))  # the later life came first
    assert reports_between(said, 2.0, 5.9) == 39


@pytest.mark.parametrize("at_s", [4.0, 1.0])
def test_a_later_plan_may_kill_and_bring_back(at_s: float) -> None:
    """Also one whose time has passed: done late is done."""
    crash = replace(PLAN, crashes=(Crash(node="r2", at_s=at_s, restart_after_s=3.0),))
    lives = lives_of(told(10.0, (2.0, crash)), "r2")
    assert lives[1] == pytest.approx([0.0, max(at_s, 2.0)], abs=0.11)
    assert lives[2] == pytest.approx([at_s + 3.0, 10.0], abs=0.11)


def test_who_is_dead_for_good_lives_again_when_the_plan_says_so_no_more() -> None:
    crash = {"node": "r2", "at_s": 1.0}
    lives = lives_of(told(10.0, (4.0, PLAN), crashes=[crash]), "r2")
    assert lives[1] == pytest.approx([0.0, 1.0], abs=0.11)
    assert lives[2] == pytest.approx([4.0, 10.0], abs=0.11)


def test_a_crash_that_was_called_off_does_not_happen() -> None:
    crash = {"node": "r2", "at_s": 5.0}
    assert lives_of(told(8.0, (4.0, PLAN), crashes=[crash]), "r2")[1][1] == pytest.approx(8.0, abs=0.11)


@pytest.mark.parametrize(("at_s", "for_s", "frozen"), [(3.0, 2.0, 2.0), (1.0, 3.0, 2.0), (0.5, 1.0, 0.0)])
def test_a_later_plan_may_freeze_for_what_is_left(at_s: float, for_s: float, frozen: float) -> None:
    freeze = replace(PLAN, freezes=(Freeze(node="r2", at_s=at_s, for_s=for_s),))
    said = told(8.0, (2.0, freeze))
    reports = [e.stamp_ns for e in said if e.topic == topics.odometry("r2")]
    assert max(b - a for a, b in pairwise(reports)) == pytest.approx(
        max(frozen, 0.1) * SECOND, abs=0.11 * SECOND
    )


def test_what_operators_say_is_latched_for_who_comes_later() -> None:
    goal = replace(Goal(id="here"), source="operator", incarnation=1, stamp_ns=VIRTUAL_EPOCH)
    said: list[Envelope] = []
    heard: list[Message] = []

    class Listener(Reporter):
        def __init__(self, name: str) -> None:
            super().__init__(name)
            self.subscriptions = frozenset({topics.FORMATION_GOAL})

        def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
            heard.append(message.message)
            return ()

    factories: dict[str, Callable[[int], Node]] = {"r2": lambda _: Listener("r2")}
    inputs = [
        (VIRTUAL_EPOCH + SECOND, envelope_of(topics.FORMATION_GOAL, codec.encode(goal))),
        _from_operator(2.0, 1, replace(PLAN, crashes=(Crash(node="r2", at_s=3.0, restart_after_s=1.0),))),
    ]
    host = VirtualHost(
        [Listener("r2")], scenario_with(), lambda envelope, _: said.append(envelope), factories, inputs
    )
    host.start()
    host.run(host.now + 6 * SECOND)
    assert heard == [goal, goal]
