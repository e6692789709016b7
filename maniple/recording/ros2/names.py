"""What ROS 2 calls things: topics, their types and what late subscribers get, and frames (REP 105)."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from maniple.core.edges import WORLD
from maniple.core.errors import ArgumentError, ScenarioError
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time

_NAMESPACE = re.compile(r"/?|(/?[A-Za-z][A-Za-z0-9_]*)(/[A-Za-z][A-Za-z0-9_]*)*")


class Topic(NamedTuple):
    """One topic of ROS 2."""

    name: str
    """Absolute, as "/maniple/r1/odom"."""
    type: str
    """As "nav_msgs/msg/Odometry"."""
    latched: bool = False
    """Whether who subscribes later is given the last messages (durability "transient local"),"""
    depth: int = 10
    """and at most so many."""


class Said(NamedTuple):
    """One message for ROS 2."""

    topic: Topic
    message: Any
    """One of rosbags' own dataclasses, of the topic's type."""
    time: Time
    """Log time of the message it comes from."""


class Names:
    """The topics and frames of a scenario's platoon under a namespace, as "/maniple" or "/".

    Raises:
        ArgumentError: it is no namespace of ROS 2.
        ScenarioError: two robots would have the same name there.
    """

    def __init__(self, scenario: Scenario, namespace: str = "/maniple") -> None:
        if not _NAMESPACE.fullmatch(namespace) or "__" in namespace:
            raise ArgumentError(
                f"namespace {namespace!r}: must be one of ROS 2, of letters, digits and single underscores, "
                "as /maniple or /a/b; / for none"
            )
        self._root = f"/{namespace.strip('/')}".rstrip("/")
        self._robots = {robot.id: name_of(robot.id) for robot in scenario.robots}
        for robot, name in self._robots.items():
            for other in (one for one, same in self._robots.items() if same == name and one != robot):
                raise ScenarioError(
                    f"robots {robot!r} and {other!r}: ROS 2 knows only letters, digits and single "
                    f"underscores, so that both would be {name!r} there; rename one"
                )
        self.tf = Topic("/tf", "tf2_msgs/msg/TFMessage", depth=100)
        self.tf_static = Topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True, depth=1)
        self.log = Topic("/rosout", "rcl_interfaces/msg/Log", latched=True, depth=1000)
        self.diagnostics = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self.reference = self._topic("formation/reference", "geometry_msgs/msg/PoseStamped")
        self.way = self._topic("formation/path", "nav_msgs/msg/Path", latched=True)
        self.errors = self._topic("formation/errors", "std_msgs/msg/Float64MultiArray")
        self.markers: Mapping[str, Topic] = {
            what: self._topic(f"{what}/markers", "visualization_msgs/msg/MarkerArray")
            for what in ("formation", "robots", "obstacles")
        }
        """By the last part of the viewer's channel."""
        self.odometry = self._of_robots("odom", "nav_msgs/msg/Odometry")
        self.pose = self._of_robots("pose", "geometry_msgs/msg/PoseStamped")
        self.true_pose = self._of_robots("true_pose", "geometry_msgs/msg/PoseStamped")
        self.drive = self._of_robots("drive", "geometry_msgs/msg/TwistStamped")
        self.scan = self._of_robots("scan", "sensor_msgs/msg/LaserScan")
        self.points = self._of_robots("points", "sensor_msgs/msg/PointCloud2")
        self.path = self._of_robots("path", "nav_msgs/msg/Path")

    def __iter__(self) -> Iterator[Topic]:
        """All topics that there can be something on."""
        yield from (
            self.tf,
            self.tf_static,
            self.log,
            self.diagnostics,
            self.reference,
            self.way,
            self.errors,
        )
        yield from self.markers.values()
        for kind in (
            self.odometry,
            self.pose,
            self.true_pose,
            self.drive,
            self.scan,
            self.points,
            self.path,
        ):
            yield from kind.values()

    def odom_frame(self, robot: str) -> str:
        """The frame its odometry is given in."""
        return f"{self._robots[robot]}/odom"

    def base_frame(self, robot: str) -> str:
        """The middle of its axle, x forward, where it is believed to be."""
        return f"{self._robots[robot]}/base_link"

    def true_frame(self, robot: str) -> str:
        """The same where it really is."""
        return f"{self._robots[robot]}/base_link_true"

    def sensor_frame(self, robot: str) -> str:
        """Its range finder."""
        return f"{self._robots[robot]}/laser"

    def frame(self, viewer_frame: str) -> str:
        """What a frame of the viewer channels is called here."""
        if viewer_frame == WORLD:
            return WORLD
        robot, _, part = viewer_frame.partition("/")
        return self.true_frame(robot) if part == "true" else self.base_frame(robot)

    def _topic(self, name: str, kind: str, latched: bool = False) -> Topic:
        return Topic(f"{self._root}/{name}", kind, latched, 1 if latched else 10)

    def _of_robots(self, name: str, kind: str) -> Mapping[str, Topic]:
        return {robot: self._topic(f"{part}/{name}", kind) for robot, part in self._robots.items()}


def name_of(robot: str) -> str:
    """A robot's name in ROS 2: only letters, digits and single underscores, and no digit first."""
    name = re.sub("[-_]+", "_", robot)
    return f"r{name}" if name[0].isdigit() else name
