"""What a node is told of who lives: liveliness tokens, as far as the network lets it know. Pure."""

from collections.abc import Collection
from typing import NamedTuple

from maniple.core.faults import cut
from maniple.core.messages import FaultPlan
from maniple.core.time import Duration, Time

ROUTER = "router"


class Life(NamedTuple):
    """A life of a node begins, or ends, as far as can be told."""

    node: str
    incarnation: int
    alive: bool


class Liveness:
    """Turns what is heard of liveliness tokens into what the node `own` is told. All in true scenario time.

    - Over a cut link nothing new is learnt; after `lease` everybody behind it counts as gone.
    - When the router goes, all tokens go at once: that is the link, not the platoon. Nobody counts as gone
      until it is back, and then those whose tokens are not back after `grace`. So that this can be told
      apart, an end is only believed after `settle`.

    `local` are nodes on the same computer: no link to them can be cut.
    """

    def __init__(
        self,
        own: str,
        lease: Duration,
        settle: Duration = 0,
        grace: Duration = 0,
        local: Collection[str] = (),
    ) -> None:
        self._own = own
        self._lease = lease
        self._settle = settle
        self._grace = grace
        self._local = local
        self._tokens: dict[tuple[str, int], tuple[bool, Time]] = {}
        self._told: set[tuple[str, int]] = set()
        self._cut_since: dict[str, Time] = {}
        self._router_since: tuple[bool, Time] | None = None

    def heard(self, node: str, incarnation: int, alive: bool, now: Time) -> None:
        """A token appeared, or is gone."""
        self._tokens[node, incarnation] = alive, now
        if node == ROUTER:
            self._router_since = alive, now

    def visible(self, plan: FaultPlan, now: Time) -> list[Life]:
        """What has changed for the node since the last call."""
        changes = []
        for (node, incarnation), (alive, since) in list(self._tokens.items()):
            told = (node, incarnation) in self._told
            shown = self._shown(plan, node, alive, since, told, now)
            if shown != told:
                (self._told.add if shown else self._told.remove)((node, incarnation))
                changes.append(Life(node, incarnation, shown))
            if not (alive or shown):
                del self._tokens[node, incarnation]
        return changes

    def _shown(self, plan: FaultPlan, node: str, alive: bool, since: Time, told: bool, now: Time) -> bool:
        if node != ROUTER and node not in self._local and cut(plan, node, self._own, now):
            return told and now - self._cut_since.setdefault(node, now) < self._lease
        self._cut_since.pop(node, None)
        return alive or (told and now < self._gone_at(node, since, now))

    def _gone_at(self, node: str, since: Time, now: Time) -> Time:
        """When a token that has been gone since `since` is believed to be gone."""
        end = since + self._settle
        if self._router_since is None or node == ROUTER:
            return end
        routed, changed = self._router_since
        if not routed:
            return now + 1
        return max(end, changed + self._grace) if since < changed else end
