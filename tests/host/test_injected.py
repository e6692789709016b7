"""What a host says it injected is what the plan decides, worked out again from what was sent."""

from collections.abc import Iterable

from maniple.core import codec, topics
from maniple.core.clocks import node_clock
from maniple.core.envelope import Envelope
from maniple.core.faults import plan_of
from maniple.core.links import Link, RateQueue
from maniple.core.messages import Decided, Decisions
from maniple.core.node import Node
from maniple.core.scenario.types import Burst, ClockError, Fault, Partition, Scenario
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.host.virtual import VirtualHost
from tests.host.nodes import Answerer, Reporter, scenario_with

ROBOTS = ("r1", "r2", "r3")


def injected() -> Scenario:
    return scenario_with(
        faults=(
            Fault(
                latency_s=0.05,
                jitter_s=0.04,
                loss=0.1,
                burst=Burst(enter=0.1, leave=0.3),
                duplicate=0.2,
                reorder=0.1,
                corrupt=0.1,
            ),
            Fault(source="r2", rate_kbps=6.0, queue_s=0.5, windows=((2.0, 9.0),)),
            Fault(source="r3", topic="robot/*/odometry", loss=1.0, windows=((3.0, 5.0),)),
        ),
        partitions=(Partition(groups=(("r1",),), at_s=6.0, for_s=2.0),),
        clocks=(ClockError(node="r3", offset_s=50.0, skew_ppm=100.0),),
        seed=3,
    )


def recorded(scenario: Scenario) -> list[Envelope]:
    sent: list[Envelope] = []
    nodes: list[Node] = [Answerer(ROBOTS), *map(Reporter, ROBOTS)]
    host = VirtualHost(nodes, scenario, lambda envelope, _: sent.append(envelope))
    host.start()
    host.run(host.now + 10 * SECOND)
    host.stop(node.name for node in nodes)
    return sent


def worked_out(scenario: Scenario, sent: Iterable[Envelope], receiver: str) -> list[Decided]:
    """Every decision at a receiver, from the messages in the order they were sent."""
    plan, queues = plan_of(scenario, VIRTUAL_EPOCH), dict[tuple[int, str], RateQueue]()
    decided = []
    for one in sent:
        link = Link(plan, scenario.seed, one.source, receiver, one.topic, queues)
        true = node_clock(scenario, one.source, VIRTUAL_EPOCH).true(one.stamp_ns)
        cause, delay, copy, corrupted = link.decide(one.incarnation, one.seq, true, len(one.data))
        names = one.source, one.topic, one.incarnation, one.seq
        decided.append(Decided(*names, cause != "", delay, corrupted, -1 if copy is None else copy, cause))
    return decided


def test_decisions_are_those_of_the_plan() -> None:
    scenario = injected()
    sent = recorded(scenario)
    told: list[Decided] = []
    for envelope in sent:
        if envelope.topic == topics.DECISIONS and envelope.source == "controller":
            message = codec.decode(envelope.topic, envelope.data)
            assert isinstance(message, Decisions)
            told += message.decided
    odometry = [envelope for envelope in sent if envelope.topic.endswith("/odometry")]
    hoped = worked_out(scenario, odometry, "controller")
    assert told == hoped[: len(told)]
    assert len(told) >= len(hoped) - len(ROBOTS)  # the last words come when nobody listens
    assert {decided.cause for decided in told} == {"", "cut", "loss", "burst", "rate"}
    assert any(decided.corrupted for decided in told)
    assert any(decided.copy_delay_ns >= 0 for decided in told)


def test_the_same_plan_and_seed_give_the_same_bytes() -> None:
    one, other = recorded(injected()), recorded(injected())
    assert one == other
