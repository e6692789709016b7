"""`maniple status`: who of a running platoon lives, and how everybody and every link is."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from maniple.cli import fault_text
from maniple.cli.interrupt import on_interrupt
from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import (
    Connect,
    Json,
    Prefix,
    Timeout,
    latched,
    nodes_known,
    operator_session,
)
from maniple.cli.platoon_state import PlatoonState, RecorderState, state_of
from maniple.core import codec, topics
from maniple.core.errors import MessageError
from maniple.core.messages import EmergencyStop, FaultPlan, FormationState, Message

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

GATHER_S = 1.5
"""How long is listened at most, in time of the run: everybody has said how it is by then."""
LONGEST_S = 6.0
"""And by the wall clock, where the run is slow."""
ANSWER_S = 1.0
"""How long a recorder is given to say how it is, wall time."""
RECORDER = "recorder"
_PAUSE_S = 0.3

Watch = Annotated[bool, typer.Option("--watch", help="Again and again, until interrupted.")]


class Listener:
    """Keeps what nodes say of themselves as it arrives."""

    def __init__(self, session: "ZenohSession") -> None:
        self._newest: dict[str, Message] = {}
        self._news = threading.Event()
        for name in (topics.status("*"), topics.links("*"), topics.FORMATION_STATE):
            session.subscribe(name, self._arrived)

    def wait(self, wanted: set[str], timeout_s: float) -> None:
        """Until something has arrived on all of these topics, or for so long."""
        until = time.monotonic() + timeout_s
        while not wanted <= self._newest.keys() and (left := until - time.monotonic()) > 0:
            self._news.wait(left)
            self._news.clear()

    def take(self) -> dict[str, Message]:
        """What has arrived since this was asked for last, the newest of each topic."""
        taken, self._newest = self._newest, {}
        return taken

    def _arrived(self, topic: str, data: bytes) -> None:
        try:
            message = codec.decode(topic, data)
        except MessageError:
            return
        if topics.sender_of(topic) == message.source:
            self._newest[topic] = message
            self._news.set()


def status(
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    watch: Watch = False,
    timeout: Timeout = 5.0,
) -> None:
    """Show who is there, how every robot is, what the links lose, and what holds the platoon.

    Exit status 0 if every robot of the controller's roster is there and no emergency stop holds, 1 if not.
    """
    interrupted = threading.Event()
    with (
        operator_session(connect, prefix, timeout) as session,
        _output(json, watch) as show,
        on_interrupt(interrupted.set),
    ):
        listener = Listener(session)
        while True:
            state = look(session, listener, connect)
            show(state)
            if not watch or interrupted.wait(_PAUSE_S):
                break
    if interrupted.is_set():
        raise typer.Exit(130)
    raise typer.Exit(0 if state.ok else 1)


@contextmanager
def _output(as_json: bool, watch: bool) -> Iterator[Callable[[PlatoonState], None]]:
    """What shows a state: a line of JSON, a table, or a table that replaces the one before."""
    if as_json:
        yield lambda state: typer.echo(msgspec.json.encode(state).decode())
        return
    from rich.console import Console
    from rich.live import Live

    from maniple.cli.status_text import picture

    console = Console()
    if not (watch and console.is_terminal):
        yield lambda state: console.print(picture(state))
        return
    with Live(console=console, auto_refresh=False, vertical_overflow="visible") as live:
        yield lambda state: live.update(picture(state), refresh=True)


def look(session: "ZenohSession", listener: Listener, connect: str = "") -> PlatoonState:
    """How the platoon is: listens until everybody who is there has said how it is, or has had the time to."""
    from maniple.host.joining import clock_of

    clock, known = clock_of(session), nodes_known(session)
    talkers = [name for name in known.alive if name == "controller" or name in known.robots]
    wanted = {topics.links(name) for name in talkers}
    wanted |= {topics.FORMATION_STATE if name == "controller" else topics.status(name) for name in talkers}
    listener.wait(wanted, min(GATHER_S / min(clock.speed, 1.0), LONGEST_S))
    heard, known = listener.take(), nodes_known(session)
    said, plan = latched(session, topics.STOP), latched(session, topics.PLAN)
    formation = heard.get(topics.FORMATION_STATE) or latched(session, topics.FORMATION_STATE)
    return state_of(
        connect,
        known,
        heard,
        formation if isinstance(formation, FormationState) else None,
        said if isinstance(said, EmergencyStop) else None,
        fault_text.report(plan if isinstance(plan, FaultPlan) else None, clock.now()),
        _recorders(session) if RECORDER in known.alive else (),
    )


def _recorders(session: "ZenohSession") -> tuple[RecorderState, ...]:
    """What the recorders that are there do."""
    from maniple.host.recorder_orders import Order, order_all

    answers = order_all(session, Order("state"), ANSWER_S)
    return tuple(RecorderState(one.recorder, one.state, one.reason, one.file) for one in answers)
