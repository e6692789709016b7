"""The emergency stop, as an agent behind the real host logic obeys it."""

from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core import topics
from maniple.core.clocks import NodeClock
from maniple.core.messages import Command, Drive, EmergencyStop, Status
from maniple.core.time import SECOND
from tests.robot_agent.hosted import LIMITS, HostedAgent, enveloped


def ordered(
    agent: HostedAgent, stopped: bool, life: int, source: str = "operator", reason: str = ""
) -> list[object]:
    message = EmergencyStop(stopped=stopped, reason=reason, source=source, incarnation=life)
    return agent.hear(enveloped(topics.STOP, message))


def commanded(agent: HostedAgent, seq: int, answers: int = -1) -> None:
    """A command at full speed that answers the newest odometry, or another."""
    command = Command(
        source="controller",
        incarnation=1,
        seq=seq,
        layer="drive",
        values=(LIMITS.u_max, 0.5),
        answers=agent.stamps[answers],
        inputs_age_ns=0,
    )
    agent.hear(enveloped(topics.command("r1"), command))


def driven(agent: HostedAgent, start: int, end: int) -> float:
    """Ticks with fresh commands; the last speed."""
    for tick in range(start, end):
        agent.moves(tick)
        commanded(agent, tick)
        agent.tick()
    return agent.drive.u_mps


def test_it_stands_at_once_says_so_and_stays() -> None:
    agent = HostedAgent(NodeClock())
    assert driven(agent, 0, 20) > 0.2
    drive, status = ordered(agent, True, 5, reason="a dog")
    assert drive == agent.drive
    assert isinstance(drive, Drive)
    assert isinstance(status, Status)
    assert (drive.u_mps, drive.w_radps, drive.v_mps, drive.active) == (0.0, 0.0, 0.0, True)
    assert (status.mode, status.reason) == ("emergency", "emergency stop: a dog")
    assert driven(agent, 20, 40) == 0.0
    assert agent.drive.active
    assert ordered(agent, True, 6, reason="another") == []
    assert agent.status().reason == "emergency stop: another"


def test_armed_it_moves_only_on_what_was_computed_since() -> None:
    agent = HostedAgent(NodeClock())
    driven(agent, 0, 20)
    ordered(agent, True, 5)
    driven(agent, 20, 40)
    agent.moves(40)
    drive, status = ordered(agent, False, 6)
    assert isinstance(drive, Drive)
    assert isinstance(status, Status)
    assert (drive.u_mps, drive.active, status.mode, status.reason) == (0.0, True, "waiting", "no command yet")
    agent.moves(41)
    commanded(agent, 40, answers=39)
    agent.tick()
    assert (agent.drive.u_mps, agent.status().counters["refused_earlier"]) == (0.0, 1)
    assert driven(agent, 42, 43) > 0.0
    assert agent.status().mode == "tracking"


def test_a_release_that_is_older_than_the_stop_releases_nobody() -> None:
    agent = HostedAgent(NodeClock())
    ordered(agent, True, 5, "desk")
    assert ordered(agent, False, 4, "tablet") == []
    assert driven(agent, 0, 5) == 0.0
    assert ordered(agent, False, 6, "tablet") != []
    assert driven(agent, 5, 10) > 0.0
    ordered(agent, True, 5, "button")  # older than the release, from somebody not heard before
    assert driven(agent, 10, 12) > 0.0


def test_a_drive_that_was_off_stays_off() -> None:
    agent = HostedAgent(NodeClock())
    driven(agent, 0, 3)
    agent.now += 10**10
    agent.tick()
    assert (agent.status().mode, agent.drive.active) == ("fault", False)
    ordered(agent, True, 5)
    agent.tick()
    assert (agent.status().mode, agent.drive.active) == ("emergency", False)
    ordered(agent, False, 6)
    assert agent.drive.active


def test_a_drive_that_is_not_active_yet_is_not_made_so_before_it_is_armed() -> None:
    """A real one would be armed for that."""
    agent = HostedAgent(NodeClock())
    agent.moves(0, state="configured")
    agent.tick()
    assert agent.drive.active
    ordered(agent, True, 5)
    assert not agent.drive.active
    agent.moves(1, state="configured")
    agent.tick()
    assert not agent.drive.active
    ordered(agent, False, 6)
    assert agent.drive.active


def test_a_drive_that_is_driven_stays_on_also_after_a_fault_that_was_none() -> None:
    """It was silent for a moment, and had not heard that it was given up."""
    agent = HostedAgent(NodeClock())
    driven(agent, 0, 3)
    agent.now += SECOND
    agent.tick()
    assert not agent.drive.active
    driven(agent, 30, 32)
    assert (agent.status().mode, agent.drive.active) == ("tracking", True)
    ordered(agent, True, 5)
    assert agent.drive.active


def test_the_end_of_the_agent_is_the_end_of_the_emergency() -> None:
    agent = HostedAgent(NodeClock())
    driven(agent, 0, 3)
    ordered(agent, True, 5)
    agent.runner.stop((), agent.now)
    assert agent.status().mode == "stopped"


words = st.lists(st.tuples(st.integers(1, 4), st.booleans(), st.sampled_from(["a", "b"])), max_size=8)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(words)
def test_the_newest_word_of_any_operator_counts(said: list[tuple[int, bool, str]]) -> None:
    agent = HostedAgent(NodeClock())
    newest, stopped = 0, False
    for tick, (life, stop, source) in enumerate(said):
        agent.moves(2 * tick)
        ordered(agent, stop, life, source)
        if life > newest:
            newest, stopped = life, stop
        agent.moves(2 * tick + 1)
        commanded(agent, tick)
        agent.tick()
        assert (agent.status().mode == "emergency") == stopped
        assert (agent.drive.u_mps, agent.drive.w_radps) == (0.0, 0.0) or not stopped
