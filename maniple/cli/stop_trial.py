"""The test of the emergency stop before the platoon moves: everybody stands by it, and is armed again."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec

from central_controller.preflight import TESTED
from maniple.cli.operator import Order, latched, operator_session
from maniple.cli.stop_command import Confirmed, confirm, words
from maniple.core import codec, topics
from maniple.core.errors import ManipleError, MessageError
from maniple.core.messages import EmergencyStop, FormationState

if TYPE_CHECKING:
    from maniple.transport.zenoh import ZenohSession

REASON = "pre-flight check"

CONFIRM_S = 10.0
"""How long robots have to stand, and to be armed."""

_AGAIN_S = 5.0
"""After a test it takes so long until every robot has told that it was tested; else it is tested again."""
_POLL_S = 0.2

Step: TypeAlias = Literal["begun", "unasked", "wait", "test", "passed"]
"""What is to be done: nothing, as the platoon has begun, or its scenario asks for no pre-flight check; wait,
as something else is missing; test the emergency stop; nothing, as nothing is missing."""


class Trial(msgspec.Struct, frozen=True):
    """What became of a test."""

    ok: bool
    """Whether every robot that is there has stood, and is armed again."""
    why: str
    """Why not, or that it was; for people."""
    stop: Confirmed | None = None
    arm: Confirmed | None = None


def step_of(state: FormationState) -> Step:
    """What is to be done about the pre-flight check of a platoon, by what its controller says."""
    if {check.robot for check in state.preflight} != {robot.id for robot in state.roster}:
        return "unasked" if state.phase == "waiting" else "begun"
    if not all(check.holds for check in state.preflight if check.item != TESTED):
        return "wait"
    return "passed" if all(check.holds for check in state.preflight) else "test"


def try_stop(session: "ZenohSession", timeout_s: float = CONFIRM_S) -> Trial:
    """Let all robots stand, see that they do, arm them again and see that too. An emergency stop that
    somebody else has given, before or meanwhile, is left as it is.

    Interrupted in between, the stop stands. What another operator said just before this, and came to others
    only after it, is below it by its number, and is meant all the same.
    """
    others: list[EmergencyStop] = []
    session.subscribe(topics.STOP, lambda _, data: others.extend(_stop_in(data)))
    session.settle()
    said = latched(session, topics.STOP)
    if isinstance(said, EmergencyStop) and said.stopped:
        about = f" ({said.reason})" if said.reason else ""
        return Trial(False, f"not tested: an emergency stop stands{about}; maniple arm releases it")
    order = Order(session, topics.STOP, EmergencyStop(stopped=True, reason=REASON), timeout_s)
    stop = confirm(session, EmergencyStop(stopped=True, reason=REASON), timeout_s, order)
    if stop.overruled or _wants_stop(others):
        return Trial(False, "not tested: another operator has said something meanwhile", stop)
    arm = confirm(session, EmergencyStop(stopped=False, reason=REASON), timeout_s, order)
    if _wants_stop(others):
        confirm(session, EmergencyStop(stopped=True, reason=others[-1].reason), timeout_s)
        return Trial(False, "not tested: another operator has said something meanwhile", stop, arm)
    if stop.ok and arm.ok:
        took_s = max(stop.confirmed.values())
        return Trial(
            True, f"tested: {len(stop.confirmed)} robots stood after {took_s:.2f} s, and are armed", stop, arm
        )
    failed = "; ".join(words(found).replace("\n", "; ") for found in (stop, arm) if not found.ok)
    return Trial(False, f"failed: {failed}", stop, arm)


def _stop_in(data: bytes) -> Iterator[EmergencyStop]:
    with contextlib.suppress(MessageError):
        message = codec.decode(topics.STOP, data)
        if isinstance(message, EmergencyStop):
            yield message


def _wants_stop(others: Sequence[EmergencyStop]) -> bool:
    """Whether the last word of other operators is that everybody stands."""
    return bool(others) and others[-1].stopped


class Watch:
    """The newest word of the controller. `session` is needed for as long as this is."""

    def __init__(self, session: "ZenohSession") -> None:
        self._inbox: SimpleQueue[bytes] = SimpleQueue()
        session.subscribe(topics.FORMATION_STATE, lambda _, data: self._inbox.put(data))

    def newest(self, timeout_s: float) -> FormationState | None:
        """The last that has come since this was asked for, waiting for one; None where none comes."""
        until, newest = time.monotonic() + timeout_s, None
        while newest is None and (left := until - time.monotonic()) > 0:
            with contextlib.suppress(Empty, MessageError):
                newest = self._state(self._inbox.get(timeout=left))
        while not self._inbox.empty():
            with contextlib.suppress(MessageError):
                newest = self._state(self._inbox.get_nowait()) or newest
        return newest

    @staticmethod
    def _state(data: bytes) -> FormationState | None:
        message = codec.decode(topics.FORMATION_STATE, data)
        mine = message.source == topics.sender_of(topics.FORMATION_STATE)
        return message if mine and isinstance(message, FormationState) else None


@contextlib.contextmanager
def trying(connect: str, prefix: str, on_notice: Callable[[str], None]) -> Iterator[None]:
    """Meanwhile the emergency stop is tested as soon as everything else holds, and again for who comes later,
    until the platoon has begun. `on_notice` is told, from another thread."""
    end = threading.Event()

    def work() -> None:
        try:
            with operator_session(connect, prefix, CONFIRM_S) as session:
                _try_until_begun(session, end, on_notice)
        except ManipleError as error:
            on_notice(f"emergency stop not tested: {error}; maniple preflight does that")

    thread = threading.Thread(target=work, name="stop test", daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join(_POLL_S)


def _try_until_begun(session: "ZenohSession", end: threading.Event, on_notice: Callable[[str], None]) -> None:
    watch, told, again = Watch(session), "", 0.0
    while not end.is_set():
        state = watch.newest(_POLL_S)
        if state is None:
            continue
        step = step_of(state)
        if step == "begun":
            return
        if step == "test" and time.monotonic() >= again:
            found = try_stop(session)
            again = time.monotonic() + _AGAIN_S
            if found.why != told:
                told = found.why
                on_notice(f"emergency stop {found.why}")
