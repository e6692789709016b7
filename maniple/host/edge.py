"""The place in a platoon of a process that is no node: of a driver, of a vehicle. It keeps no journal."""

from collections import Counter

from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import MessageError, RunError
from maniple.core.faults import NEVER, dies_by, plan_of
from maniple.core.messages import FaultPlan
from maniple.core.scenario.types import Scenario
from maniple.host.clock import Anchor
from maniple.host.fate import Fate, Meet, meet, say
from maniple.host.inbox import Arrived, Inbox, Item, Unfit
from maniple.host.joining import restore
from maniple.host.latched import Lives, mark_of
from maniple.host.liveness import ROUTER, Life
from maniple.transport.zenoh import ZenohSession

TELL_EVERY_S = 10.0
"""How often is told what was refused, at most, time of the run."""


class Membership:
    """One life of a process under a name: it shows itself, steps back for a newer one, meets its fate, and
    tells a router that came back what that has to know. What arrives goes through the host's `inbox`."""

    def __init__(
        self,
        name: str,
        incarnation: int,
        scenario: Scenario,
        clock: Anchor,
        fleet: ZenohSession,
        inbox: Inbox,
        meet: Meet = meet,
    ) -> None:
        self.name = name
        self.incarnation = incarnation
        self._clock = clock
        self._fleet = fleet
        self._inbox = inbox
        self._meet = meet
        self._plan = plan_of(scenario, NEVER)
        self._plan_mark = (-1, -1)
        self._fate = Fate(name, dies_by(name, scenario), clock.now())
        self._held: dict[str, Envelope] = {}
        self._lives = Lives()
        self._router_went = False
        self._newer = 0
        self._told: Counter[str] = Counter()
        self._tell_at = 0
        self.refused: Counter[str] = Counter()
        """What arrived and was not taken in, by reason."""

    @property
    def is_over(self) -> bool:
        """Whether a newer life has taken over."""
        return self._newer > 0

    def listen(self) -> None:
        """Hear who lives, and the fault plan."""
        self._fleet.watch(self._inbox.life)
        self._fleet.subscribe(topics.PLAN, self._inbox.arrived, self._inbox.unfit)
        for topic, data in self._fleet.ask(topics.PLAN).items():
            self._inbox.arrived(topic, data)
        self._fleet.settle()

    def announce(self) -> None:
        """Show that this life is there."""
        self._fleet.announce(self.name, self.incarnation)

    def take(self, item: Item) -> bool:
        """Deal with what arrived, if that is not the host's affair; whether it was dealt with."""
        if isinstance(item, Life):
            self._heard(item)
        elif isinstance(item, Unfit):
            self.refused[item.reason] += 1
        elif isinstance(item, Arrived) and item.topic == topics.PLAN:
            self._replan(item)
        else:
            return False
        return True

    def act(self) -> None:
        """Meet what the plan has in store now, and tell of what was refused."""
        now = self._clock.now()
        if event := self._fate.due(self._plan, now):
            self._meet(event, self._clock)
        if now >= self._tell_at and self.refused != self._told:
            self.tell()
            self._tell_at = now + round(TELL_EVERY_S * 1e9)

    def tell(self) -> None:
        """Say what was refused since this was said last."""
        if more := self.refused - self._told:
            counts = ", ".join(f"{number} {why}" for why, number in sorted(more.items()))
            say(f"{self.name} refused messages: {counts}")
            self._told = self.refused.copy()

    def require_newest(self) -> None:
        """Raises `RunError` where a newer life has taken over."""
        if self.is_over:
            raise RunError(
                f"{self.name} (incarnation {self.incarnation}) steps back: "
                f"incarnation {self._newer} has taken over"
            )

    def _heard(self, life: Life) -> None:
        node, incarnation, alive = life
        if node == ROUTER:
            if alive and self._router_went:
                restore(self._fleet, self._clock, self._held.values(), self._lives)
            self._router_went = not alive
            return
        self._lives.seen(node, incarnation)
        if node == self.name and alive and incarnation > self.incarnation:
            self._newer = incarnation

    def _replan(self, item: Arrived) -> None:
        """The newest plan counts."""
        try:
            envelope, plan = envelope_of(item.topic, item.data), codec.decode(item.topic, item.data)
        except MessageError:
            self.refused["malformed"] += 1
            return
        if isinstance(plan, FaultPlan) and (mark := mark_of(envelope)) > self._plan_mark:
            self._plan, self._plan_mark = plan, mark
            self._held[item.topic] = envelope
