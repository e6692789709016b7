"""What every command to a running platoon shares: its session, its options, how it speaks and asks."""

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, NamedTuple

import msgspec
import typer

from maniple.cli.node_commands import LOCAL
from maniple.core import codec, topics
from maniple.core.edges import robot_of
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import ArgumentError, MessageError, RunError, TransportError
from maniple.core.messages import FormationState, Message
from maniple.core.scenario.check import RESERVED
from maniple.core.scenario.parse import parameters_of
from maniple.core.scenario.types import Links

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

OPERATOR = "operator"
"""The sender of what operators say."""

AGAIN_S = 0.5
"""What is not answered is sent again after so long: the network may lose it."""

_ENDPOINT = re.compile(r"[a-z0-9_-]+/.+")

Connect = Annotated[str, typer.Option(envvar="MANIPLE_CONNECT", help="Router of the fleet network.")]
Prefix = Annotated[str, typer.Option(help="Of the keys, as in the scenario.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Timeout = Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds to wait for an answer.")]


class Known(NamedTuple):
    """Who belongs to a platoon and who of them is there, as the network tells."""

    robots: tuple[str, ...]
    """Those of the controller's roster in its order, then those that live without being in it."""
    alive: Mapping[str, tuple[int, ...]]
    """The incarnations of every process that is there: of robots, controller, simulator, recorder, router."""
    beside: tuple[str, ...] = ()
    """The processes of robots beside their agents that are there: drivers, scanners and vehicles."""


@contextmanager
def operator_session(connect: str, prefix: str, timeout_s: float) -> Iterator["ZenohSession"]:
    """A session on the fleet network of a running platoon.

    Raises:
        BadParameter: `connect` is no endpoint.
        ScenarioError: `prefix` can't be one of keys.
        RunError: nothing answers there within the time, or what was done with the session failed.
        ArgumentError: what was asked for is not valid there. Both texts name the endpoint.
    """
    from maniple.transport.zenoh import ZenohSession

    require_endpoint(connect)
    links = parameters_of(Links, {"prefix": prefix})
    try:
        with ZenohSession.client(connect, links.prefix, timeout_s) as session:
            yield session
    except (RunError, TransportError) as error:
        text = str(error)
        raise RunError(text if connect in text else f"{connect}: {text}") from None
    except ArgumentError as error:
        raise ArgumentError(f"{connect}: {error}") from None


def require_endpoint(endpoint: str, option: str = "--connect") -> None:
    """Refuse what is no endpoint.

    Raises:
        BadParameter: it is none.
    """
    if not _ENDPOINT.fullmatch(endpoint):
        raise typer.BadParameter(f"{endpoint!r}: an endpoint looks like {LOCAL}", param_hint=option)


def latched(session: "ZenohSession", topic: str, timeout_s: float = 2.0) -> Message | None:
    """The last message of a topic, as the router keeps it; None where there is none, or no valid one."""
    kept = _kept(session, topic, timeout_s)
    try:
        return None if kept is None else codec.decode(topic, kept.data)
    except MessageError:
        return None


class Order:
    """A message of the operator on a latched topic, that may be sent until it is heard.

    Each is a life of the operator of its own, numbered by the wall clock, or by the message before where
    that is ahead: of two operators whose clocks differ the one who speaks last counts.
    """

    def __init__(self, session: "ZenohSession", topic: str, message: Message, timeout_s: float = 2.0) -> None:
        from maniple.host.joining import clock_of

        kept = _kept(session, topic, timeout_s)
        self.incarnation = time.time_ns() if kept is None else max(time.time_ns(), kept.incarnation + 1)
        self._session, self._topic, self._message = session, topic, message
        self._clock, self._seq, self._first = clock_of(session), 0, 0

    def send(self) -> Message:
        """Send it, the next of its life, by the clock of the run; returns it as sent."""
        sent = msgspec.structs.replace(
            self._message,
            source=OPERATOR,
            incarnation=self.incarnation,
            seq=self._seq,
            stamp_ns=self._clock.now(),
        )
        self._session.put(self._topic, codec.encode(sent))
        self._seq += 1
        return sent

    def go_on(self, message: Message) -> None:
        """From here on say this, in the same life: what another operator said meanwhile stays above it."""
        self._message, self._first = message, self._seq

    def kept(self, timeout_s: float) -> bool:
        """Whether the router keeps it, or something newer."""
        kept = _kept(self._session, self._topic, timeout_s)
        return kept is not None and (kept.incarnation, kept.seq) >= (self.incarnation, self._first)


def publish(session: "ZenohSession", topic: str, message: Message, timeout_s: float) -> Message:
    """Send a message on a latched topic until the router keeps it, or something newer; returns it as sent.

    Raises:
        RunError: it does not within the time.
    """
    order, until = Order(session, topic, message, timeout_s), time.monotonic() + timeout_s
    while (now := time.monotonic()) < until:
        sent = order.send()
        again = min(now + AGAIN_S, until)
        while (left := again - time.monotonic()) > 0:
            if order.kept(left):
                return sent
            time.sleep(min(0.01, left))
    raise RunError(f"the router did not take {topic} within {timeout_s:g} s")


def nodes_known(session: "ZenohSession", timeout_s: float = 2.0) -> Known:
    """The robots of the platoon, and every node that is there."""
    alive = session.everyone(timeout_s)
    state = latched(session, topics.FORMATION_STATE, timeout_s)
    roster = tuple(robot.id for robot in state.roster) if isinstance(state, FormationState) else ()
    others = sorted(alive.keys() - {*roster, *RESERVED})
    beside = tuple(name for name in others if robot_of(name))
    return Known((*roster, *(name for name in others if name not in beside)), alive, beside)


def _kept(session: "ZenohSession", topic: str, timeout_s: float) -> Envelope | None:
    data = session.ask(topic, timeout_s).get(topic)
    try:
        return None if data is None else envelope_of(topic, data)
    except MessageError:
        return None
