"""What a host says to a router, and asks it: the clock and the plan of the run, a life, and what the router
may have forgotten."""

import time
from collections.abc import Iterable

import msgspec

from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.errors import MessageError, TransportError
from maniple.core.faults import NEVER
from maniple.core.messages import FaultPlan
from maniple.core.time import MILLISECOND, Duration
from maniple.host.clock import Anchor
from maniple.host.latched import Lives
from maniple.host.liveness import ROUTER
from maniple.transport.zenoh import ZenohSession, crc_of

CLOCK = "clock"
"""Asked: EPOCH:ELAPSED:SPEED."""

TOLD = "@told"
"""What hosts tell a router that came back: nothing that `**` matches."""
SEEN = "@told/seen"
"""First who has lived and what time it is,"""
HELD = "@told/held/"
"""and with the topic behind it what is latched."""

PLAYED = b"played"
"""What a recording that is played answers to a claim: no node can take part in it."""

_POLL_S = 0.05
_ASK_S = 5.0
_EXACT: Duration = 50 * MILLISECOND
_CLOCK_TRIES = 4


class Seen(msgspec.Struct, frozen=True):
    """What a host tells a router that came back."""

    clock: str
    """EPOCH:ELAPSED:SPEED, as `Anchor.told` says it."""
    lives: dict[str, int]
    """The highest incarnation of every node it has seen."""


def restore(session: ZenohSession, clock: Anchor, held: Iterable[Envelope], lives: Lives) -> None:
    """Tell a router that came back what it knew, as far as it is known here."""
    held = tuple(held)
    for envelope in held:
        if topics.has_known_senders(envelope.topic):
            lives.seen(envelope.source, envelope.incarnation)
    seen = msgspec.json.encode(Seen(clock.told(time.monotonic_ns()), dict(lives.all())))
    session.put_raw(SEEN, seen, crc_of(seen))
    for envelope in held:
        session.put_raw(f"{HELD}{envelope.topic}", envelope.data, crc_of(envelope.data))


def await_router(session: ZenohSession, patience_s: float = 2.0) -> bool:
    """Wait until the router at the other end serves, too; False: within this time it does not, so it is a
    router of another kind."""
    until = time.monotonic() + patience_s
    while not session.lives(ROUTER):
        if time.monotonic() >= until:
            return False
        time.sleep(_POLL_S)
    return True


def claim(session: ZenohSession, node: str, wanted: int | None = None, patience_s: float = 3.5) -> int:
    """Which life of a node starts now, as the router counts them, or this one if it is `wanted` and was not
    there before; where nobody counts, the wanted one or 1.

    One that was cut off is given `patience_s` to be missed: its lease ends within that.

    Raises:
        TransportError: the node lives, the wanted life was there already, or what is there is a recording.
    """
    until = time.monotonic() + patience_s
    while lives := session.lives(node):
        if time.monotonic() >= until:
            raise TransportError(f"{node} is running already (incarnation {lives[-1]}): stop that one first")
        time.sleep(_POLL_S)
    name = f"claim/{node}" if wanted is None else f"claim/{node}/{wanted}"
    answer = session.ask(name, _ASK_S).get(name, str(wanted or 1).encode())
    if answer == PLAYED:
        raise TransportError(f"{node} can't join: a recording is played there, nobody lives")
    life = int(answer)
    if wanted not in (None, life):
        raise TransportError(f"incarnation {wanted} of {node} was there already: the next is {life}")
    return life


def plan_kept(session: ZenohSession) -> FaultPlan:
    """The fault plan that a router keeps; where it keeps none, one in which nothing happens."""
    nothing = FaultPlan(since_ns=NEVER)
    try:
        plan = codec.decode(topics.PLAN, session.ask(topics.PLAN)[topics.PLAN])
    except (KeyError, MessageError):
        return nothing
    return plan if isinstance(plan, FaultPlan) else nothing


def clock_of(session: ZenohSession) -> Anchor:
    """The clock of the run that a router belongs to, as exact as its answer is fast; where none tells it, the
    wall clock."""
    best: tuple[Duration, Anchor] | None = None
    for _ in range(_CLOCK_TRIES):
        asked = time.monotonic_ns()
        answer = session.ask(CLOCK, _ASK_S).get(CLOCK)
        took = time.monotonic_ns() - asked
        if answer is None:
            break
        try:
            clock = Anchor.learnt(answer.decode(), asked + took // 2)
        except ValueError:
            raise TransportError(
                f"what tells the time there is no router of maniple: {answer[:40]!r}"
            ) from None
        if best is None or took < best[0]:
            best = took, clock
        if took < _EXACT:
            break
    return Anchor.here() if best is None else best[1]
