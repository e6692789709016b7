"""Tells ROS 2 how a running platoon is. It listens and tells: nothing goes from ROS 2 to the platoon.

Importing this imports protobuf and rosbags.
"""

import time
from collections import Counter
from collections.abc import Callable

import msgspec

from maniple.core import codec, topics
from maniple.core.errors import MessageError
from maniple.core.messages import Status
from maniple.core.scenario.parse import digest_of, to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, to_seconds
from maniple.host.clock import Anchor
from maniple.host.inbox import Arrived, Inbox, Stop, Unfit
from maniple.host.joining import clock_of
from maniple.host.liveness import ROUTER, Life
from maniple.host.recorder import keys_of
from maniple.recording.ros2 import Names, Said, Translation
from maniple.transport.ros2 import RosPublisher, RosSession
from maniple.transport.ros2_keys import Qos
from maniple.transport.zenoh import ZenohSession

NODE = "maniple_bridge"
"""What it is called in ROS 2."""

LOOK_S = 1.0
"""So often it is looked whether the routers are there, wall time."""

_POLL_S = 0.1


class Told(msgspec.Struct, frozen=True, kw_only=True):
    """What a bridge has told; what `--json` prints."""

    wall_s: float
    heard: int
    """Messages of the platoon that were taken in."""
    refused: dict[str, int]
    """Those that were not, by reason."""
    told: int
    """Messages of ROS 2."""
    topics: dict[str, int]
    """The same by topic."""


class Ros2Bridge:
    """Publishes what a platoon says, until it is stopped. Stamps are by this computer's wall clock, when a
    message arrived: those of ROS 2 beside it compare them with theirs."""

    def __init__(
        self,
        fleet: ZenohSession,
        ros: RosSession,
        scenario: Scenario,
        names: Names,
        say: Callable[[str], None],
    ) -> None:
        self._fleet = fleet
        self._ros = ros
        self._scenario = scenario
        self._names = names
        self._say = say
        self._digest = digest_of(to_json(scenario))
        self._inbox = Inbox()
        self._publishers: dict[str, RosPublisher] = {}
        self._strange: set[str] = set()
        self._refused: Counter[str] = Counter()
        self._there = {"the platoon": True, "ROS 2": True}
        self._router_went = False
        self._heard = 0
        self._clock: Anchor
        self._begin()

    def stop(self) -> None:
        """Make `run` end; safe from a signal handler and from any thread."""
        self._inbox.stop()

    def run(self) -> Told:
        """Tell until `stop`."""
        began = time.monotonic_ns()
        self._fleet.watch(self._inbox.life)
        for pattern in self._wanted():
            self._fleet.subscribe(pattern, self._inbox.arrived, self._inbox.unfit, topics.has_known_senders)
        self._fleet.settle()
        self._take_latched()
        look_at = 0.0
        while self._deal():
            if time.monotonic() >= look_at:
                look_at = time.monotonic() + LOOK_S
                self._look()
        counts = {name: one.published for name, one in sorted(self._publishers.items())}
        return Told(
            wall_s=to_seconds(time.monotonic_ns() - began),
            heard=self._heard,
            refused=dict(sorted(self._refused.items())),
            told=sum(counts.values()),
            topics=counts,
        )

    def _begin(self) -> None:
        """Know nothing of the run yet: it is new, or its router is."""
        self._clock = clock_of(self._fleet)
        self._translation = Translation(self._scenario, self._names, stamp_of=self._wall)

    def _wanted(self) -> list[str]:
        """The topics that matter, of all robots at once."""
        robot = self._scenario.robots[0].id
        return [
            row.pattern.replace("{id}", "*")
            for row in topics.TOPICS
            if self._translation.wants(row.pattern.replace("{id}", robot))
        ]

    def _take_latched(self) -> None:
        """What was said before, as the router keeps it."""
        for name in sorted(keys_of(self._scenario)):
            if self._translation.wants(name) and topics.topic(name).latched:
                for topic, data in self._fleet.ask(name).items():
                    self._take(topic, data, self._clock.now())

    def _deal(self) -> bool:
        """With what has arrived; whether to go on."""
        for item in self._inbox.take(_POLL_S):
            if isinstance(item, Arrived):
                self._take(item.topic, item.data, self._clock.at(item.monotonic_ns))
            elif isinstance(item, Unfit):
                self._refused[item.reason] += 1
            elif isinstance(item, Life):
                self._lived(item)
            elif isinstance(item, Stop):
                return False
        return True

    def _take(self, topic: str, data: bytes, now: Time) -> None:
        if not self._translation.wants(topic):
            return
        try:
            message = codec.decode(topic, data)
        except MessageError:
            self._refused["malformed"] += 1
            return
        if not topics.may_send(topic, message.source):
            self._refused["sender"] += 1
            return
        self._heard += 1
        if isinstance(message, Status):
            self._compare(message)
        for one in self._translation.see(topic, message, now):
            self._publish(one)

    def _publish(self, said: Said) -> None:
        topic = said.topic
        publisher = self._publishers.get(topic.name)
        if publisher is None:
            qos = Qos(latched=topic.latched, depth=topic.depth)
            publisher = self._publishers[topic.name] = self._ros.advertise(topic.name, topic.type, qos)
        publisher.publish(said.message)

    def _lived(self, life: Life) -> None:
        """A liveliness token appeared, or is gone: with the router all may be new."""
        if life.node != ROUTER:
            return
        if life.alive and self._router_went:
            self._begin()
            self._take_latched()
        self._router_went = not life.alive

    def _compare(self, status: Status) -> None:
        """Say once who runs another scenario than this."""
        robot = status.source
        if status.scenario and not self._digest.startswith(status.scenario) and robot not in self._strange:
            self._strange.add(robot)
            self._say(
                f"{robot} runs another scenario than the one given here: what is said of it may be wrong"
            )

    def _look(self) -> None:
        """Say when a router goes or is back; sessions connect again by themselves."""
        for whose, session in (("the platoon", self._fleet), ("ROS 2", self._ros)):
            there = session.connected
            if there != self._there[whose]:
                self._there[whose] = there
                self._say(f"the router of {whose} {'is back' if there else 'is gone: waiting for it'}")

    def _wall(self, time_ns: Time) -> Time:
        """A time of the run by this computer's wall clock."""
        return time.time_ns() - round((self._clock.now() - time_ns) / self._clock.speed)
