"""The two ends of `round_trip`, each a process: `python -m benchmarks.round_trip_peers KIND ROLE ...`."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from queue import Empty, SimpleQueue

import msgspec

from benchmarks.common import RATE_HZ
from maniple.core import codec, topics
from maniple.core.messages import Command, Odometry, Stamp
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import Formation, Line, Robot, Scenario
from maniple.core.time import Duration, Time, from_seconds, period
from maniple.host.clock import Anchor
from maniple.host.realtime import RealtimeHost
from maniple.transport.zenoh import ZenohSession

PREFIX = "benchmark"
PATIENCE_S = 20.0
"""For the first answer, and then for all."""

ROBOT = {"bare": "r1", "host": "r2"}
_STAMP = Stamp(incarnation=1, seq=1000, stamp_ns=time.time_ns())
ODOMETRY = Odometry(
    frame_id="r1/1", x_m=1.234, y_m=-0.567, psi_rad=0.1, u_mps=0.1, w_radps=0.01, applied=_STAMP
)
COMMAND = Command(layer="drive", values=(0.1, 0.01), answers=_STAMP, inputs_age_ns=from_seconds(0.05))


def main(kind: str, role: str, endpoint: str, incarnation: str, count: str) -> None:
    """Answer until killed, or ask `count` times and print how long each took, ns, as JSON."""
    with ZenohSession.client(endpoint, PREFIX) as session:
        if role == "asker":
            ask = bare_asker if kind == "bare" else host_asker
            sys.stdout.buffer.write(msgspec.json.encode(ask(session, int(incarnation), int(count))))
        elif kind == "bare":
            bare_answerer(session, int(incarnation))
        else:
            host(Answerer(), session, int(incarnation)).run()


def wire(message: Odometry | Command, source: str, incarnation: int) -> bytes:
    """The bytes of a message as a host sends it."""
    stamped = msgspec.structs.replace(
        message, source=source, incarnation=incarnation, seq=1000, stamp_ns=_STAMP.stamp_ns
    )
    return codec.encode(stamped)


def bare_asker(session: ZenohSession, incarnation: int, count: int) -> list[int]:
    """Puts bytes at 20 Hz; the callback of the answer takes the time."""
    robot = ROBOT["bare"]
    data = wire(ODOMETRY, robot, incarnation)
    arrived: SimpleQueue[int] = SimpleQueue()
    session.subscribe(topics.command(robot), lambda _topic, _data: arrived.put(time.monotonic_ns()))
    session.settle()
    taken: list[int] = []
    due, until = time.monotonic(), time.monotonic() + PATIENCE_S + count / RATE_HZ
    while len(taken) < count and due < until:
        due += 1.0 / RATE_HZ
        time.sleep(max(due - time.monotonic(), 0.0))
        begin = time.monotonic_ns()
        session.put(topics.odometry(robot), data)
        try:
            taken.append(arrived.get(timeout=0.5 / RATE_HZ) - begin)
        except Empty:
            continue  # the other end is not there yet
    return taken


def bare_answerer(session: ZenohSession, incarnation: int) -> None:
    """Puts bytes back from the callback."""
    robot = ROBOT["bare"]
    data = wire(COMMAND, "controller", incarnation)
    session.subscribe(topics.odometry(robot), lambda _topic, _data: session.put(topics.command(robot), data))
    session.settle()
    SimpleQueue[None]().get()


def host_asker(session: ZenohSession, incarnation: int, count: int) -> list[int]:
    """The same through a host: from what a node returns to what a node is given."""
    asker = Asker(count, lambda: running.stop())
    running = host(asker, session, incarnation)
    running.run()
    return asker.taken


def host(node: "Asker | Answerer", session: ZenohSession, incarnation: int) -> RealtimeHost:
    """A realtime host without faults."""
    scenario = Scenario(
        name="round-trip",
        robots=(Robot(id=ROBOT["host"]),),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
    )
    return RealtimeHost(node, incarnation, scenario, Anchor.here(), session, session)


class Asker:
    """Sends odometry at 20 Hz; a benchmark's node, it reads the clock as it is called."""

    name = ROBOT["host"]
    subscriptions = frozenset({topics.command(name)})
    timers: Mapping[str, Duration] = {"odometry": period(RATE_HZ)}

    def __init__(self, count: int, done: Callable[[], None]) -> None:
        self._count = count
        self._done = done
        self._sent_ns = 0
        self._left = round((PATIENCE_S + count / RATE_HZ) * RATE_HZ)
        self.taken: list[int] = []

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        self.taken.append(time.monotonic_ns() - self._sent_ns)
        if len(self.taken) == self._count:
            self._done()
        return ()

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        self._left -= 1
        if self._left == 0:
            self._done()
        outgoing = (Outgoing(topics.odometry(self.name), ODOMETRY),)
        self._sent_ns = time.monotonic_ns()
        return outgoing

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        return ()


class Answerer:
    """Answers every odometry with a command."""

    name = "controller"
    subscriptions = frozenset({topics.odometry(ROBOT["host"])})
    timers: Mapping[str, Duration] = {}

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        return (Outgoing(topics.command(ROBOT["host"]), COMMAND),)

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        return ()


if __name__ == "__main__":
    main(*sys.argv[1:])
