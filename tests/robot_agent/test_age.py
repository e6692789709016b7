"""Age, not arrival: whatever the network does, a robot moves only on what was computed from fresh inputs.

A robot's agent behind the real host logic, its clock off and drifting, and commands that come in any order,
late, twice, in bursts, and forged.
"""

from typing import Any, NamedTuple

from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core import topics
from maniple.core.clocks import NodeClock
from maniple.core.messages import Command, Stamp
from maniple.core.time import MILLISECOND, SECOND, to_seconds
from tests.robot_agent.hosted import HOLD_S, LIMITS, STOP_S, T0, TICK, HostedAgent, enveloped

TICKS = 80
EPSILON = 1e-9

ODD: tuple[dict[str, Any], ...] = (
    {"layer": "kinematics"},
    {"values": (1e30, 1e30)},
    {"third": -1e30},
    {"inputs_age_ns": -SECOND},
    {"stop_after_s": -1.0},
)
"""What no controller means; refused."""


class Sent(NamedTuple):
    """A command on its way: it answers the odometry of tick `answers`, `late` ticks after that."""

    answers: int
    late: int
    speed: float
    inputs_age_ms: int
    stop_after_s: float
    odd: dict[str, Any]
    twice: bool


sent = st.builds(
    Sent,
    answers=st.integers(0, TICKS - 1),
    late=st.integers(0, 40),
    speed=st.floats(-0.7, 0.7),
    inputs_age_ms=st.sampled_from([0, 0, 50, 400, 900, 5000]),
    stop_after_s=st.sampled_from([0.0, 0.0, 0.3, 9.0]),
    odd=st.sampled_from([{}, {}, {}, *ODD]),
    twice=st.booleans(),
)
plans = st.lists(sent, max_size=45)
partitions = st.none() | st.tuples(st.integers(0, TICKS), st.integers(5, 40))
clocks = st.builds(
    NodeClock,
    epoch=st.just(T0),
    offset=st.sampled_from([0, -900 * SECOND, 10**6 * SECOND]),
    skew=st.sampled_from([0.0, -10_000.0, 10_000.0]),
)


def due(plan: list[Sent], partition: tuple[int, int] | None) -> dict[int, list[tuple[int, Sent]]]:
    """What arrives at each tick, numbered in the order it was sent; what a partition held back comes at its
    end, at once."""
    arrivals: dict[int, list[tuple[int, Sent]]] = {}
    for seq, one in enumerate(sorted(plan, key=lambda one: one.answers)):
        at = one.answers + one.late
        if partition is not None and partition[0] <= at < sum(partition):
            at = sum(partition)
        for tick in (at, at + 3) if one.twice else (at,):
            arrivals.setdefault(tick, []).append((seq, one))
    return arrivals


def command_of(one: Sent, seq: int, stamps: list[Stamp]) -> Command:
    given: dict[str, Any] = {
        "source": "controller",
        "incarnation": 1,
        "seq": seq,
        "stamp_ns": 7,
        "layer": "drive",
        "values": (one.speed, 0.0),
        "answers": stamps[one.answers],
        "inputs_age_ns": one.inputs_age_ms * MILLISECOND,
        "stop_after_s": one.stop_after_s,
    }
    return Command(**(given | one.odd))


def allowed(command: Command | None, arrived: int, now: int) -> float:
    """The speed that the rule of ages leaves of what was commanded."""
    if command is None:
        return 0.0
    age = to_seconds(max(now - command.answers.stamp_ns, now - arrived + command.inputs_age_ns))
    share = command.stop_after_s / STOP_S if 0 < command.stop_after_s < STOP_S else 1.0
    hold, stop = HOLD_S * share, STOP_S * share
    return command.values[0] * min(max((stop - age) / (stop - hold), 0.0), 1.0)


@settings(deadline=None, derandomize=True, max_examples=150)
@given(plans, partitions, clocks)
def test_it_moves_only_towards_what_the_newest_command_still_allows(
    plan: list[Sent], partition: tuple[int, int] | None, clock: NodeClock
) -> None:
    agent = HostedAgent(clock)
    arrivals, newest = due(plan, partition), -1
    held: Command | None = None
    arrived = 0
    for tick in range(TICKS):
        agent.moves(tick)
        for seq, one in arrivals.get(tick, ()):
            command = command_of(one, seq, agent.stamps)
            agent.hear(enveloped(topics.command("r1"), command))
            if seq > newest:
                newest = seq
                if not one.odd:
                    held, arrived = command, agent.now
        was, now, dt_s = agent.tick()
        aim = allowed(held, arrived, agent.now)
        assert abs(now - aim) <= abs(was - aim) + EPSILON
        assert min(was, aim) - EPSILON <= now <= max(was, aim) + EPSILON
        if aim == 0.0:
            assert abs(now) <= max(abs(was) - LIMITS.brake * dt_s, 0.0) + EPSILON


def test_a_burst_of_old_commands_after_a_partition_moves_nobody() -> None:
    """All of them arrive, none as old as the limit when it was sent; the last is 1.5 s old."""
    agent = HostedAgent(NodeClock())
    for tick in range(60):
        agent.moves(tick)
        if tick == 59:
            for seq in range(30):
                one = Sent(seq, 0, 0.5, 0, 0.0, {}, False)
                agent.hear(enveloped(topics.command("r1"), command_of(one, seq, agent.stamps)))
        assert agent.tick()[1] == 0.0
    status = agent.status()
    assert (status.mode, status.reason) == ("waiting", "the command is 1.5 s old")
    agent.moves(60)
    fresh = command_of(Sent(60, 0, 0.5, 0, 0.0, {}, False), 30, agent.stamps)
    agent.hear(enveloped(topics.command("r1"), fresh))
    assert agent.tick()[1] > 0.0


def test_what_no_controller_means_is_counted() -> None:
    agent = HostedAgent(NodeClock())
    for tick in range(len(ODD)):
        agent.moves(tick)
        one = Sent(tick, 0, 0.5, 0, 0.0, ODD[tick], False)
        agent.hear(enveloped(topics.command("r1"), command_of(one, tick, agent.stamps)))
        assert agent.tick()[1] == 0.0
    counters = agent.status().counters
    assert (counters["refused_layer"], counters["refused_absurd"]) == (1, len(ODD) - 1)


def test_more_than_the_robot_can_do_is_clipped_and_counted() -> None:
    agent = HostedAgent(NodeClock())
    for tick in range(TICKS):
        agent.moves(tick)
        one = Sent(tick, 0, 50.0, 0, 0.0, {"third": 3.0}, False)
        agent.hear(enveloped(topics.command("r1"), command_of(one, tick, agent.stamps)))
        agent.tick()
    assert (agent.drive.u_mps, agent.drive.v_mps) == (LIMITS.u_max, 0.0)
    status = agent.status()
    assert status.guard == "speed"
    assert 0 < status.counters["clipped"] < TICKS


def test_odometry_says_how_long_ago_the_command_it_applies_arrived() -> None:
    agent = HostedAgent(NodeClock())
    agent.moves(0)
    agent.hear(
        enveloped(topics.command("r1"), command_of(Sent(0, 0, 0.1, 0, 0.0, {}, False), 0, agent.stamps))
    )
    agent.tick()
    assert agent.moves(3).held_ns == 3 * TICK
