"""Virtual time: order, latency, faults, and the same bytes every time."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.messages import Alive, Command, Decisions
from maniple.core.node import Node
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
