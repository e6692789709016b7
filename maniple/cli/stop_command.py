"""`maniple stop` and `maniple arm`: the emergency stop of a running platoon, and its release."""

import time
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from maniple.cli.node_commands import LOCAL
from maniple.cli.operator import (
    AGAIN_S,
    Connect,
    Json,
    Known,
    Order,
    Prefix,
    Timeout,
    latched,
    nodes_known,
    operator_session,
)
from maniple.core import codec, topics
from maniple.core.errors import MessageError, RunError
from maniple.core.messages import EmergencyStop, Message, Odometry, Status

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

STILL_MPS, STILL_RADPS = 0.01, 0.02
"""A robot whose own odometry says less stands."""

_ASK_S = 2.0

_NOT_GIVEN = (
    "no stop was given: robots of a platoon that can't be reached stand, by their guards, only once their "
    "commands get old"
)

Reason = Annotated[str, typer.Option("--reason", metavar="TEXT", help="For whoever sees the robots stand.")]


class Confirmed(msgspec.Struct, frozen=True):
    """What became of an emergency stop or of its release; what `--json` prints."""

    stopped: bool
    """What was asked for."""
    ok: bool
    """Whether there are robots, all that are there have done it, and it is kept for those that come."""
    confirmed: dict[str, float]
    """The robots that say so, and after how many seconds they did."""
    missing: dict[str, str]
    """The robots that are there and do not, and what is known of them."""
    absent: tuple[str, ...]
    """The robots of the controller's roster that are not there: they are told when they are back."""
    kept: bool
    """Whether the router keeps it for robots that come later."""
    overruled: bool
    """Whether an operator has said something else since."""
    connect: str = ""
    """Where it was said."""


class Witness:
    """What one robot has said since it was told to stand, or that it may move. Pure: it is told what
    arrives, and when."""

    def __init__(self, stopped: bool) -> None:
        self._stopped = stopped
        self._mode = ""
        self._since: float | None = None
        self._still: bool | None = None
        self._speed = ""
        self.at: float | None = None
        """When it had done it, in the time of `heard`; None before that."""

    def heard(self, message: Message, now: float) -> None:
        """The robot said something."""
        if isinstance(message, Status):
            self._mode = message.mode
            obeys = (message.mode == "emergency") == self._stopped
            self._since = (self._since if self._since is not None else now) if obeys else None
        elif isinstance(message, Odometry):
            speed = max(abs(message.u_mps), abs(message.v_mps))
            self._still = speed < STILL_MPS and abs(message.w_radps) < STILL_RADPS
            self._speed = f"{speed:.2f} m/s, {abs(message.w_radps):.2f} rad/s"
        else:
            return
        if self._since is None:
            self.at = None
        elif self.at is None and (not self._stopped or (self._still and isinstance(message, Odometry))):
            self.at = now

    @property
    def doubt(self) -> str:
        """Why it is not known to have done it."""
        if not self._mode:
            return "has not said how it is"
        if self._since is None:
            return f"is {self._mode}"
        return "has not said how fast it is" if self._still is None else f"still moves, {self._speed}"


def stop(
    reason: Reason = "",
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 10.0,
) -> None:
    """Emergency stop: every robot stands until it is armed again, whatever else it is told.

    Needs no controller. Exit status 0 if every robot that is there says that it stands, 1 if not.
    """
    _order(EmergencyStop(stopped=True, reason=reason), connect, prefix, json, timeout)


def arm(
    reason: Reason = "",
    connect: Connect = LOCAL,
    prefix: Prefix = "maniple",
    json: Json = False,
    timeout: Timeout = 10.0,
) -> None:
    """Release the emergency stop: robots move again on what the controller tells them from now on.

    Exit status 0 if every robot that is there says that it is armed, 1 if not.
    """
    _order(EmergencyStop(stopped=False, reason=reason), connect, prefix, json, timeout)


def confirm(
    session: "ZenohSession", message: EmergencyStop, timeout_s: float, order: Order | None = None
) -> Confirmed:
    """Say it until every robot that is there has done it, or the time is over. With `order` it goes on with
    what that said before."""
    inbox: SimpleQueue[tuple[str, bytes, float]] = SimpleQueue()
    for name in (topics.status("*"), topics.odometry("*")):
        session.subscribe(name, lambda topic, data: inbox.put((topic, data, time.monotonic())))
    if order is None:
        order = Order(session, topics.STOP, message, timeout_s)
    else:
        order.go_on(message)
    order.send()
    began = time.monotonic()
    known, witnesses = nodes_known(session), dict[str, Witness]()
    due, until = began + AGAIN_S, began + timeout_s
    while not _all_have(known, witnesses) and (now := time.monotonic()) < until:
        if now >= due:
            order.send()
            known, due = nodes_known(session, AGAIN_S), now + AGAIN_S
        _take(inbox, message.stopped, witnesses, min(due, until) - time.monotonic())
    kept = order.kept(_ASK_S)
    newest = latched(session, topics.STOP, _ASK_S)
    overruled = newest is not None and newest.incarnation > order.incarnation
    return _outcome(message.stopped, known, witnesses, began, kept=kept, overruled=overruled)


def _take(
    inbox: "SimpleQueue[tuple[str, bytes, float]]",
    stopped: bool,
    witnesses: dict[str, Witness],
    wait_s: float,
) -> None:
    """Wait for something to arrive and tell the witness it is from."""
    try:
        topic, data, at = inbox.get(timeout=max(wait_s, 0.0))
        message = codec.decode(topic, data)
    except (Empty, MessageError):
        return
    if message.source == topics.sender_of(topic):
        witnesses.setdefault(message.source, Witness(stopped)).heard(message, at)


def _all_have(known: Known, witnesses: dict[str, Witness]) -> bool:
    there = [name for name in known.robots if name in known.alive]
    return bool(there) and all(name in witnesses and witnesses[name].at is not None for name in there)


def _outcome(
    stopped: bool, known: Known, witnesses: dict[str, Witness], began: float, *, kept: bool, overruled: bool
) -> Confirmed:
    confirmed, missing = {}, {}
    for name in known.robots:
        if name in known.alive:
            witness = witnesses.get(name, Witness(stopped))
            if witness.at is None:
                missing[name] = witness.doubt
            else:
                confirmed[name] = round(witness.at - began, 3)
    absent = tuple(name for name in known.robots if name not in known.alive)
    ok = bool(confirmed) and not missing and kept
    return Confirmed(stopped, ok, confirmed, missing, absent, kept, overruled)


def _order(message: EmergencyStop, connect: str, prefix: str, as_json: bool, timeout_s: float) -> None:
    reached = False
    try:
        with operator_session(connect, prefix, timeout_s) as session:
            reached = True
            found = msgspec.structs.replace(confirm(session, message, timeout_s), connect=connect)
    except RunError as error:
        if reached or not message.stopped:
            raise
        raise RunError(f"{error}\n{_NOT_GIVEN}") from None
    if as_json:
        typer.echo(msgspec.json.encode(found).decode())
    else:
        typer.echo(words(found))
    raise typer.Exit(0 if found.ok else 1)


def words(found: Confirmed) -> str:
    """What became of it, for people."""
    done = "stands" if found.stopped else "is armed"
    lines = [f"{name} {done}, after {after:.2f} s" for name, after in found.confirmed.items()]
    lines += [f"{name} does not confirm: it {doubt}" for name, doubt in found.missing.items()]
    lines += [f"{name} is not there; it is told when it is back" for name in found.absent]
    if not found.kept:
        lines.append("the router does not keep it: robots that come later are not told")
    if found.overruled:
        lines.append("another operator has said something since")
    if not (found.confirmed or found.missing):
        lines.append("no robot is there")
    lines[-1] += f" ({found.connect})"
    return "\n".join(lines)
