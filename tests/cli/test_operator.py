"""What operators' commands share, against a real router."""

import time
from collections.abc import Iterator

import msgspec
import pytest
import typer

from maniple.cli.operator import Known, Order, latched, nodes_known, operator_session, publish
from maniple.core import codec, topics
from maniple.core.errors import RunError, ScenarioError, TransportError
from maniple.core.messages import EmergencyStop, FormationState, RobotReport
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.transport.test_zenoh import free_port
from tests.waiting import eventually

STOP = EmergencyStop(stopped=True, reason="a test")


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Of a router that keeps latched values, in a run that is at 7 s."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(address, "maniple") as router:
        serve(router, Anchor(7 * SECOND, time.monotonic_ns(), 1.0))
        yield address


@pytest.fixture
def session(endpoint: str) -> Iterator[ZenohSession]:
    with operator_session(endpoint, "maniple", 20.0) as opened:
        yield opened


def test_what_is_published_is_latched_by_the_clock_of_the_run(session: ZenohSession) -> None:
    assert latched(session, topics.STOP) is None
    sent = publish(session, topics.STOP, STOP, 20.0)
    assert latched(session, topics.STOP) == sent
    assert sent == msgspec.structs.replace(
        STOP, source="operator", incarnation=sent.incarnation, seq=sent.seq, stamp_ns=sent.stamp_ns
    )
    assert 7 * SECOND <= sent.stamp_ns < 60 * SECOND


def test_an_operator_whose_clock_is_behind_still_has_the_last_word(session: ZenohSession) -> None:
    ahead = time.time_ns() + 3600 * SECOND
    other = msgspec.structs.replace(STOP, source="operator", incarnation=ahead)
    session.put(topics.STOP, codec.encode(other))
    eventually(lambda: latched(session, topics.STOP))
    sent = publish(session, topics.STOP, EmergencyStop(stopped=False), 20.0)
    assert sent.incarnation == ahead + 1
    assert latched(session, topics.STOP) == sent


def test_what_cannot_be_decoded_is_as_good_as_nothing_but_is_followed() -> None:
    """Of a router of somebody else, that keeps what it gets."""
    address = f"tcp/127.0.0.1:{free_port()}"
    ahead = time.time_ns() + 3600 * SECOND
    garbage = {"source": "operator", "incarnation": ahead, "seq": 0, "stamp_ns": 0, "stopped": "very"}
    with ZenohSession.router(address, "maniple") as router:
        router.serve(topics.STOP, lambda name: {name: msgspec.msgpack.encode(garbage)})
        with operator_session(address, "maniple", 20.0) as session:
            assert latched(session, topics.STOP) is None
            order = Order(session, topics.STOP, STOP)
            first, again = order.send(), order.send()
    assert (first.incarnation, again.incarnation, again.seq) == (ahead + 1, ahead + 1, first.seq + 1)
    assert again.stamp_ns > first.stamp_ns


def test_a_router_that_keeps_nothing_is_told_of() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohSession.router(address, "maniple"),
        pytest.raises(RunError, match=f"{address}: the router did not take platoon/stop within 0.3 s"),
        operator_session(address, "maniple", 20.0) as session,
    ):
        publish(session, topics.STOP, STOP, 0.3)


def test_robots_are_those_of_the_roster_and_those_that_live(session: ZenohSession, endpoint: str) -> None:
    roster = tuple(
        RobotReport(id=name, state="present", odometry_age_s=0.0, mode="") for name in ("r2", "r1")
    )
    state = FormationState(
        phase="running",
        task_time_s=0.0,
        task_duration_s=1.0,
        reference=(0.0, 0.0, 0.0),
        reference_velocity=(0.0, 0.0, 0.0),
        chain=(),
        errors=b"",
        roster=roster,
        source="controller",
    )
    with ZenohSession.client(endpoint, "maniple") as platoon:
        for node, life in (("controller", 1), ("r1", 2), ("r1", 3), ("r7", 1)):
            platoon.announce(node, life)
        eventually(lambda: "r7" in session.everyone())
        lives = {"controller": (1,), "r1": (2, 3), "r7": (1,), "router": (1,)}
        assert nodes_known(session) == Known(("r1", "r7"), lives)
        platoon.put(topics.FORMATION_STATE, codec.encode(state))
        eventually(lambda: latched(session, topics.FORMATION_STATE))
        assert nodes_known(session) == Known(("r2", "r1", "r7"), lives)
        assert session.lives("r1") == (2, 3)


def test_failures_name_the_endpoint(endpoint: str) -> None:
    with pytest.raises(RunError) as caught, operator_session(endpoint, "maniple", 20.0):
        raise TransportError("gone")
    assert str(caught.value) == f"{endpoint}: gone"
    with pytest.raises(RunError) as caught, operator_session("tcp/127.0.0.1:1", "m", 0.3):
        pass
    assert str(caught.value) == "can't reach a router at tcp/127.0.0.1:1 within 0.3 s"


def test_mistakes_are_told_before_anything_is_opened() -> None:
    with pytest.raises(typer.BadParameter), operator_session("localhost", "maniple", 1.0):
        pass
    with pytest.raises(ScenarioError), operator_session("tcp/127.0.0.1:1", "a//b", 1.0):
        pass
