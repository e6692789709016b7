"""The session with a robot that speaks ROS 2: opened and closed in the background, what arrives queues up."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from maniple.core.errors import ManipleError
from maniple.core.time import Time
from maniple.transport.ros2 import Network, RosPublisher, RosSession, RosSubscription
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, TWIST, TWIST_STAMPED
from maniple.transport.ros2_keys import SENSOR_DATA, Attachment, Qos
from maniple.transport.ros2_messages import Velocity3, twist, twist_stamped

Heard: TypeAlias = deque[tuple[Any, Attachment]]
"""Messages and who sent them, oldest first."""

_TRY_S = 2.0
_KEPT = 200
"""More than arrives between two looks, unless the process stood still: then the newest count."""


class RobotTopics(NamedTuple):
    """Full names, and which of them are used."""

    cmd_vel: str
    odom: str
    scan: str
    stamped: bool
    """Whether velocities are TwistStamped."""
    drives: bool
    """Whether velocities and odometry are of interest;"""
    scans: bool
    """whether scans are."""

    @property
    def velocity_type(self) -> str:
        """Of the messages on `cmd_vel`."""
        return TWIST_STAMPED if self.stamped else TWIST


class Joined(NamedTuple):
    """What there is once the session is open."""

    ros: RosSession
    subscriptions: tuple[RosSubscription, ...]
    velocities: RosPublisher | None


class RobotLink:
    """One session, from when it begins to be opened until it is closed."""

    def __init__(self, endpoint: str, network: Network, node: str, topics: RobotTopics) -> None:
        self._endpoint, self._network, self._node, self._topics = endpoint, network, node, topics
        self._lock = threading.Lock()
        self._closed = False
        self._joined: Joined | None = None
        self._failure = ""
        self.odometries: Heard = deque(maxlen=_KEPT)
        self.scans: Heard = deque(maxlen=_KEPT)
        self.commands: Heard = deque(maxlen=_KEPT)
        """What others than this program command."""
        threading.Thread(target=self._open).start()

    @property
    def joined(self) -> Joined | None:
        """The open session."""
        return self._joined

    @property
    def failure(self) -> str:
        """Why it could not be opened; empty where it was, or still is being."""
        return self._failure

    @property
    def connected(self) -> bool:
        """Whether its router is there."""
        return self._joined is not None and self._joined.ros.connected

    def publish(self, velocity: Velocity3, stamp_ns: Time, frame_id: str) -> None:
        """Tell the robot a velocity; `stamp_ns` by its clock, 0 where that is not known."""
        if self._joined is not None and self._joined.velocities is not None:
            stamped = self._topics.stamped
            said = twist_stamped(velocity, stamp_ns, frame_id) if stamped else twist(velocity)
            self._joined.velocities.publish(said)

    def close(self) -> None:
        """Leave the network, in the background: what was published before is still sent."""
        with self._lock:
            self._closed = True
            joined, self._joined = self._joined, None
        if joined is not None:
            threading.Thread(target=joined.ros.close).start()

    def _open(self) -> None:
        try:
            ros = RosSession.open(self._endpoint, self._node, "/", self._network, _TRY_S)
        except ManipleError as error:
            self._failure = str(error)
            return
        joined = self._join(ros)
        with self._lock:
            if not self._closed:
                self._joined = joined
                return
        ros.close()

    def _join(self, ros: RosSession) -> Joined:
        topics, velocities = self._topics, None
        subscriptions: list[RosSubscription] = []
        if topics.drives:
            taken, commands = topics.velocity_type, _into(self.commands)
            subscriptions += (
                ros.subscribe(topics.odom, ODOMETRY, _into(self.odometries), SENSOR_DATA),
                ros.subscribe(topics.cmd_vel, taken, commands, announced=False),
            )
            velocities = ros.advertise(topics.cmd_vel, taken, Qos(depth=1))
        if topics.scans:
            subscriptions.append(ros.subscribe(topics.scan, LASER_SCAN, _into(self.scans), SENSOR_DATA))
        return Joined(ros, tuple(subscriptions), velocities)


def _into(heard: Heard) -> Callable[[Any, Attachment], None]:
    return lambda message, origin: heard.append((message, origin))
