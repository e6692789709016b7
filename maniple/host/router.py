"""The router: relays everything, keeps the last value of every latched topic, numbers lives, and tells who
joins a run what time it is there. One that starts in the middle of a run learns all this from those it finds
(docs/decisions/0009-integrity-and-latched-values.md).
"""

import threading
import time
from collections import Counter
from math import inf

import msgspec

from maniple.core import codec, topics
from maniple.core.faults import NEVER, back_at, dead, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.host.clock import Anchor
from maniple.host.fate import Fate, Meet, meet
from maniple.host.joining import CLOCK, HELD, SEEN, TOLD, Seen
from maniple.host.latched import LatchedStore, Lives
from maniple.host.liveness import ROUTER
from maniple.transport.zenoh import ZenohSession

PATIENCE_S = 1.5
"""How long a stopped router goes on for those who still have something to say, wall time."""

GRACE_S = 1.0
"""A router may have had a life before: so long after its start it hears of that before it numbers lives, says
what time it is, or begins the run; wall time."""

_POLL_S = 0.05


class Service:
    """What a router session does beside relaying. Its callbacks run on threads of Zenoh's.

    `clock` is None where the run's is not known: it is that of those it finds, or begins here.
    """

    def __init__(
        self,
        session: ZenohSession,
        clock: Anchor | None = None,
        scenario: Scenario | None = None,
        grace_s: float = GRACE_S,
    ) -> None:
        self.clock = clock or Anchor.here()
        self.refused: Counter[str] = Counter()
        self._own_clock = clock is None
        self._session = session
        self._scenario = scenario
        self._lives = Lives()
        self._store = LatchedStore(self._lives)
        self._alive: set[tuple[str, int]] = set()
        self._shown: set[str] = set()
        self._begun = scenario is None
        self._lock = threading.Lock()
        self._changed = threading.Event()
        self._settled_at = time.monotonic() + grace_s
        self._unfit = lambda _, why: self._refuse(why)

    def start(self) -> None:
        """Subscribe, answer, and show that a router is here."""
        self._session.watch(self._life)  # first: who speaks is known by then
        for row in topics.TOPICS:
            if row.latched:
                expression = row.pattern.replace("{id}", "*")
                self._session.subscribe(expression, self._keep, self._unfit)
                self._session.serve(expression, self._store.answer)
        self._session.subscribe(f"{TOLD}/**", self._told, self._unfit)
        self._session.serve("incarnation/*", self._number)
        self._session.serve("claim/*", self._claim)
        self._session.serve("claim/*/*", self._claim)
        self._session.serve(CLOCK, self._tell_clock)
        self._session.announce(ROUTER, 1)

    def plan(self) -> FaultPlan:
        """The fault plan that holds; nothing timed before the run has begun."""
        plan = self._store.message(topics.PLAN)
        return plan if isinstance(plan, FaultPlan) else FaultPlan(since_ns=NEVER)

    def begin(self) -> None:
        """Publish the scenario's plan once every robot and the controller were seen, if none is known: the
        run begins with that, whether there is anything in the plan or not."""
        if self._begun or self._scenario is None or not self.settled:
            return
        with self._lock:
            if self._store.newest(topics.PLAN) is not None:
                self._begun = True
                return
            wanted = {"controller", *(robot.id for robot in self._scenario.robots)}
            if not wanted <= self._shown:
                return
            now = self.clock.now()
            plan = msgspec.structs.replace(
                plan_of(self._scenario, now), source=ROUTER, incarnation=1, stamp_ns=now
            )
            self._begun = self._store.keep(topics.PLAN, data := codec.encode(plan)) == "news"
        self._session.put(topics.PLAN, data)

    @property
    def settled(self) -> bool:
        """Whether what was before this router's life has had the time to be told."""
        return time.monotonic() >= self._settled_at

    def await_leaving(self, until: float) -> None:
        """Wait until nobody else is here, or for a monotonic time, s."""
        while self._alive and (left := until - time.monotonic()) > 0:
            self._changed.wait(left)
            self._changed.clear()

    def _keep(self, topic: str, data: bytes) -> None:
        with self._lock:
            kept = self._store.keep(topic, data)
        if kept in ("sender", "malformed"):
            self._refuse(kept)

    def _told(self, name: str, data: bytes) -> None:
        """A host tells what was before: first who has lived, then what it holds."""
        if name == SEEN:
            self._learn(data)
        else:
            self._restore(name.removeprefix(HELD), data)

    def _learn(self, data: bytes) -> None:
        """Take over who has lived, and the clock of a run that is older than this router."""
        try:
            seen = msgspec.json.decode(data, type=Seen)
            clock = Anchor.learnt(seen.clock, time.monotonic_ns())
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            self._refuse("malformed")
            return
        older = clock.monotonic_ns < self.clock.monotonic_ns
        if self._own_clock and older and not self.settled:
            self.clock = clock
        for node, incarnation in seen.lives.items():
            self._seen(node, incarnation)

    def _restore(self, topic: str, data: bytes) -> None:
        """Keep what a host holds; what is said but once may be news to those that came since, too."""
        with self._lock:
            kept = self._store.keep(topic, data)
        if kept in ("sender", "malformed"):
            self._refuse(kept)
        elif kept == "news" and not topics.topic(topic).rate_hz:
            self._session.put(topic, data)

    def _life(self, node: str, incarnation: int, alive: bool) -> None:
        if node == ROUTER:
            return
        (self._alive.add if alive else self._alive.discard)((node, incarnation))
        self._shown.add(node)
        self._changed.set()
        self._seen(node, incarnation)

    def _seen(self, node: str, incarnation: int) -> None:
        with self._lock:
            self._lives.seen(node, incarnation)
            self._store.announced()

    def _refuse(self, why: str) -> None:
        with self._lock:
            self.refused[why] += 1

    def _number(self, name: str) -> dict[str, bytes]:
        """The number of the next life of a node, asked for as "incarnation/NODE"."""
        self._settle()
        return {name: str(self._lives.next(name.split("/")[1])).encode()}

    def _claim(self, name: str) -> dict[str, bytes]:
        """The number of a new life, claimed as "claim/NODE", or as "claim/NODE/NUMBER" by one that has it."""
        _, node, *wanted = name.split("/")
        if wanted and not (wanted[0].isascii() and wanted[0].isdecimal() and len(wanted[0]) < 19):
            self._refuse("malformed")
            return {}
        if not wanted:
            self._settle()
        with self._lock:
            life = self._lives.claim(node, int(wanted[0]) if wanted else None)
        return {name: str(life).encode()}

    def _tell_clock(self, name: str) -> dict[str, bytes]:
        if self._own_clock:
            self._settle()
        return {name: self.clock.told(time.monotonic_ns()).encode()}

    def _settle(self) -> None:
        """Wait until what was before this router's life has been told; on a thread of the question's own."""
        time.sleep(max(self._settled_at - time.monotonic(), 0.0))


def serve(session: ZenohSession, clock: Anchor | None = None, grace_s: float = 0.0) -> Service:
    """Make a router session keep and serve latched values and incarnations, and the clock of a run; it has
    had no life before, unless given a grace."""
    service = Service(session, clock, grace_s=grace_s)
    service.start()
    return service


class RouterHost:
    """Runs a router until it is stopped and everybody else has left, or has had the time to."""

    def __init__(
        self,
        session: ZenohSession,
        clock: Anchor | None = None,
        scenario: Scenario | None = None,
        grace_s: float = GRACE_S,
        meet: Meet = meet,
    ) -> None:
        self._service = Service(session, clock, scenario, grace_s)
        self._meet = meet
        self._serves = False
        self._stopping = False

    @property
    def refused(self) -> Counter[str]:
        """What was not kept, by reason."""
        return self._service.refused

    def start(self) -> None:
        """Begin to serve; `run` does, if this was not called."""
        if not self._serves:
            self._service.start()
            self._serves = True

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._stopping = True

    def run(self, patience_s: float = PATIENCE_S) -> float:
        """Serve until `stop`, then until all others are gone, `patience_s` at most.

        Returns how long it is to be away before it serves again, s of wall time: it has begun while the plan
        has it dead, which it could not know; infinite: for good; 0: it was stopped.
        """
        service, began_ns = self._service, time.monotonic_ns()
        self.start()
        fate: Fate | None = None
        while not self._stopping:
            time.sleep(_POLL_S)
            if not service.settled:
                continue
            service.begin()
            clock, plan = service.clock, service.plan()
            fate = fate or Fate(ROUTER, (ROUTER,), clock.at(began_ns))
            if event := fate.due(plan, clock.now()):
                self._meet(event, clock)
            elif crash := dead(plan, (ROUTER,), clock.now()):
                return (
                    clock.wall_seconds(back_at(plan, crash) - clock.now()) if crash.restart_after_s else inf
                )
        service.await_leaving(time.monotonic() + patience_s)
        return 0.0
