"""A robot that speaks ROS 2 as a driver: velocities out, odometry and laser scans in, over Zenoh.

It needs no ROS here. See docs/ros2.md for what the robot has to offer.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from maniple.control.limits import Velocity
from maniple.core.edges import WORLD
from maniple.core.errors import MessageError, RunError, ScenarioError
from maniple.core.geometry import Pose
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import SECOND, Duration, Time
from maniple.transport.ros2 import Network
from maniple.transport.ros2_cdr import LASER_SCAN, ODOMETRY, require
from maniple.transport.ros2_keys import Entity, names_of
from maniple.transport.ros2_messages import Velocity3, ns_of, pose_of, scan_of, velocity_of
from robot_agent.drivers.interface import LIFE_CYCLE, Capabilities, Step
from robot_agent.drivers.keeper import clipped
from robot_agent.drivers.ros2.link import Heard, Joined, RobotLink, RobotTopics
from robot_agent.drivers.ros2.source import Pacer, Source, has_jumped

T = TypeVar("T")

TAKEN_FOR: Duration = SECOND
"""Somebody else who commands the robot is not got in the way of until this long after the last word of it."""

_ENOUGH = 0.5
"""A robot that says where it is less often than this share of `rates.motion_hz` can't be controlled."""
_STANDING = Velocity()
_SHOWN = 6


class Ros2Driver:
    """Drives the robot whose topics `robots.ros2` names; or only brings its scans, where another drives it.

    Zenoh's threads only enqueue. All times are by the caller's clock, and no clock of the robot is compared
    with it: what has to carry a stamp gets one of the robot's clock, as its odometry tells it.
    """

    def __init__(self, scenario: Scenario, robot: Robot, endpoint: str = "") -> None:
        """Raises `ScenarioError` where the robot's parameters are no names of ROS 2."""
        ros2, model, rates = robot.ros2, scenario.model_of(robot), scenario.rates
        self._robot, self._ros2, self._rates = robot.id, ros2, rates
        self._topics = _topics_of(robot)
        self._endpoint = ros2.router or endpoint
        self._able = Capabilities(
            u_max_mps=model.u_max_mps,
            w_max_radps=model.w_max_radps,
            reverse=True,
            accepts_yaw_rate=True,
            motion_hz=rates.motion_hz,
            scan_hz=rates.scan_hz if self._topics.scans else 0.0,
            frame=WORLD if ros2.in_world else robot.id,
            v_max_mps=model.v_max_mps or 0.0,
        )
        self._mount = Pose(*model.sensor_mount)
        self._state: DriverState = "closed"
        self._asked: Step | None = None
        self._trouble = ""
        self._link: RobotLink | None = None
        self._failure = ""
        self._begin()

    def _begin(self) -> None:
        """As if nothing had been heard."""
        self._located, self._scanned = Source(), Source()
        self._motion_pace, self._scan_pace = Pacer(self._rates.motion_hz), Pacer(self._rates.scan_hz)
        self._pose: Pose | None = None
        self._pose_at: Time = 0
        self._robot_time: Time = 0
        self._frames = ("", "")
        self._other: Time | None = None
        self._refused: Counter[str] = Counter()
        self._why: dict[str, str] = {}
        self._why_at: Time = 0
        self._applied = _STANDING
        self._may_move = False
        self._told: tuple[DriverState, str] | None = None

    @property
    def capabilities(self) -> Capabilities:
        """Those of the robot's model."""
        return self._able

    @property
    def state(self) -> DriverState:
        """Where it is in its life."""
        return self._state

    @property
    def reason(self) -> str:
        """Why it is not where it was asked to be, or the robot can't be controlled."""
        return self._trouble

    def take(self, step: Step, now: Time) -> None:
        """Begin a step of the life cycle.

        Raises:
            RunError: the step is not open in this state.
            ScenarioError: no router is known.
            MissingExtraError: what ROS 2 needs is not installed.
        """
        if (self._state, step) not in LIFE_CYCLE:
            raise RunError(f"{self._robot}: a driver that is {self._state} has no step {step}")
        if step == "close":
            self._close(now)
        elif step == "fail":
            self._fail("given up", now)
        elif step == "connect":
            self._connect()
        elif step == "deactivate":
            self._stand(now)
            self._state = "configured"
        self._asked = step
        self._advance(now)

    def read(self, now: Time) -> Sequence[Motion | Scan]:
        """The newest that was heard since the last call, and no more often than promised; where that is
        nothing, how the driver is, if that has changed."""
        motion = scan = None
        link = self._link
        if link is not None and link.joined is not None:
            self._hear_commands(link.commands, now)
            motion = self._hear_odometry(link.odometries, now)
            scan = self._hear_scans(link.scans, now)
        self._advance(now)
        up = self._state in ("configured", "active")
        located = self._motion(motion if up else None)
        return [report for report in (located, scan if up else None) if report is not None]

    def write(self, drive: Drive, now: Time) -> Velocity:
        """Publish a velocity, if the driver is active. A robot that is not heard any more is told to stand;
        one that somebody else commands is told nothing."""
        if self._state != "active":
            return _STANDING
        if self._hindrance(now) or not drive.active:
            self._stand(now)
        else:
            order = clipped(drive, self._able)
            self._tell(Velocity(order.u_mps, order.w_radps, order.v_mps), now)
        return self._applied

    def see(self, pose: ExternalPose, now: Time) -> None:
        """The robot locates itself."""

    def stop(self, now: Time) -> None:
        """Tell the robot to stand, if this driver has told it to move."""
        if self._may_move:
            self._stand(now)

    def answers(self) -> Mapping[str, str]:
        """What the robot shows of itself, and what was heard of it."""
        joined = self._link and self._link.joined
        if not joined:
            return {}
        ros, topics = joined.ros, self._topics
        nodes = {f"{node.namespace.rstrip('/')}/{node.node}" for node in ros.entities("NN")}
        answers = {"router": self._endpoint, "nodes": _some(nodes)}
        if topics.drives:
            takers = _who(ros.entities("MS", topics.cmd_vel))
            answers["cmd_vel"] = f"{topics.cmd_vel}: {takers or 'nobody takes it'}"
            answers["odom"] = _topic(topics.odom, ros.entities("MP", topics.odom), self._located)
            if any(self._frames):
                answers["frames"] = " -> ".join(self._frames)
        if topics.scans:
            answers["scan"] = _topic(topics.scan, ros.entities("MP", topics.scan), self._scanned)
        if refused := self._refusals(joined):
            answers["refused"] = "; ".join(
                f"{count} on {topic} {self._why.get(topic, '')}".rstrip()
                for topic, count in sorted(refused.items())
            )
        return {what: said for what, said in answers.items() if said}

    def _connect(self) -> None:
        if self._link is not None and not self._link.failure:
            return
        require()
        if not self._endpoint:
            raise ScenarioError(
                f"robots.{self._robot}.ros2.router: no router is known; must be as 'tcp/192.168.1.12:7447', "
                "or --hardware must name the one of the hardware network"
            )
        self._begin()
        self._failure = "" if self._link is None else self._link.failure
        node = "maniple_" + re.sub(r"[^A-Za-z0-9]+", "_", self._robot)
        network = Network(self._ros2.layout, self._ros2.domain_id)
        self._link = RobotLink(self._endpoint, network, node, self._topics)

    def _close(self, now: Time) -> None:
        self.stop(now)
        if self._link is not None:
            self._link.close()
            self._link = None
        self._state, self._trouble = "closed", ""

    def _fail(self, why: str, now: Time) -> None:
        self.stop(now)
        self._state, self._trouble = "fault", why

    def _advance(self, now: Time) -> None:
        """Complete the step that is under way, if it may be; else say why not."""
        if self._state in ("closed", "fault"):
            if self._state == "closed" and self._asked == "connect":
                self._trouble = self._absence()
                self._reach("connected", self._trouble)
            return
        missing = self._missing(now)
        if self._state == "connected" and self._asked == "configure":
            self._reach("configured", missing)
        hindrance = missing or self._contest(now)
        if self._state == "configured" and self._asked == "activate":
            self._reach("active", hindrance)
        self._trouble = hindrance

    def _reach(self, state: DriverState, hindrance: str) -> None:
        if not hindrance:
            self._state, self._asked = state, None

    def _hindrance(self, now: Time) -> str:
        """Why the robot can't be controlled; empty where it can."""
        return self._missing(now) or self._contest(now)

    def _absence(self) -> str:
        """Why there is no robot; empty where one shows itself."""
        link = self._link
        if link is None or link.failure or link.joined is None:
            failure = link.failure if link is not None else ""
            return failure or self._failure or f"connects to the ROS 2 router at {self._endpoint}"
        if not link.connected:
            return f"the ROS 2 router at {self._endpoint} is gone"
        ros, topics = link.joined.ros, self._topics
        if topics.drives:
            there = ros.entities("MP", topics.odom) or ros.entities("MS", topics.cmd_vel) or link.odometries
            wanted = f"{topics.odom} or {topics.cmd_vel}"
        else:
            there, wanted = ros.entities("MP", topics.scan) or link.scans, topics.scan
        if there:
            return ""
        others = {entity.topic for entity in ros.entities("MP")}
        seen = f"there is {_some(others)}" if others else "there is no ROS 2 topic at all"
        return f"nobody shows {wanted} at {self._endpoint}; {seen}"

    def _missing(self, now: Time) -> str:
        """Why nothing can be told of the robot; empty where it can."""
        link, topics = self._link, self._topics
        if link is None or (joined := link.joined) is None or not link.connected:
            return f"the ROS 2 router at {self._endpoint} is gone"
        if not topics.drives:
            fresh = self._scanned.is_fresh(now)
            return "" if fresh else self._silence(joined, topics.scan, LASER_SCAN)
        if not self._located.is_fresh(now):
            return self._silence(joined, topics.odom, ODOMETRY)
        if self._located.is_disputed(now):
            return f"two programs publish on {topics.odom}"
        rate, least = self._located.rate_hz(), _ENOUGH * self._able.motion_hz
        if rate >= least:
            return ""
        if not rate:
            return f"listens to {topics.odom}"
        return f"{topics.odom} comes {rate:.0f} times a second; rates.motion_hz needs {least:g} or more"

    def _silence(self, joined: Joined, topic: str, kind: str) -> str:
        if self._refusals(joined)[topic]:
            return f"what comes on {topic} can't be used {self._why.get(topic, '')}".rstrip()
        types = {entity.type for entity in joined.ros.entities("MP", topic)} - {kind, ""}
        return f"no {kind} on {topic}" + (f", but {_some(types)}" if types else "")

    def _contest(self, now: Time) -> str:
        """Why the robot does not do what it is told; empty where it does."""
        link, topics = self._link, self._topics
        if not topics.drives or link is None or (joined := link.joined) is None:
            return ""
        if self._is_taken(now):
            return f"somebody else commands the robot on {topics.cmd_vel}"
        takers = joined.ros.entities("MS", topics.cmd_vel)
        if any(taker.type == topics.velocity_type for taker in takers):
            return ""
        if takers:
            said = f"{topics.cmd_vel} takes {_some({taker.type for taker in takers})}"
            return f"{said}, not {topics.velocity_type}: see robots.ros2.stamped"
        return f"nobody takes {topics.cmd_vel}"

    def _is_taken(self, now: Time) -> bool:
        return self._other is not None and now - self._other < TAKEN_FOR

    def _hear_commands(self, commands: Heard, now: Time) -> None:
        topic = self._topics.cmd_vel
        for message, _ in _drain(commands):
            if self._judged(topic, partial(velocity_of, message), now) is not None:
                self._other = now

    def _hear_odometry(self, heard: Heard, now: Time) -> tuple[Pose, Velocity3] | None:
        """The newest that counts. Where the odometry begins anew, the driver has to as well."""
        newest = None
        for message, origin in _drain(heard):
            said = self._judged(self._topics.odom, partial(pose_of, message), now)
            if said is None or self._state == "fault":
                continue
            verdict = self._located.hear(origin.gid, now)
            if verdict == "second":
                continue
            if self._began_anew(said[0], verdict == "anew", now):
                self._fail(f"the odometry on {self._topics.odom} began anew", now)
                continue
            self._pose, self._pose_at = said[0], now
            self._robot_time = ns_of(message.header.stamp)
            self._frames = (str(message.header.frame_id), str(message.child_frame_id))
            newest = said
        return newest if newest is not None and self._motion_pace.lets_pass(now) else None

    def _began_anew(self, pose: Pose, other: bool, now: Time) -> bool:
        if self._ros2.in_world or self._pose is None or self._state in ("closed", "connected"):
            return False
        return other or has_jumped(self._pose, pose, now - self._pose_at, self._able)

    def _hear_scans(self, heard: Heard, now: Time) -> Scan | None:
        newest = None
        for message, origin in _drain(heard):
            take = partial(scan_of, message, self._mount, self._ros2.unmeasured)
            scan = self._judged(self._topics.scan, take, now)
            if scan is not None and self._scanned.hear(origin.gid, now) != "second":
                newest = scan
        return newest if newest is not None and self._scan_pace.lets_pass(now) else None

    def _judged(self, topic: str, take: Callable[[], T], now: Time) -> T | None:
        """What was heard, or None where it can't be used: why, is remembered once a second."""
        try:
            return take()
        except MessageError as error:
            self._refused[topic] += 1
            if topic not in self._why or now - self._why_at >= SECOND:
                self._why[topic], self._why_at = f"({error})", now
            return None

    def _refusals(self, joined: Joined) -> Counter[str]:
        """How many messages could not be used, by topic."""
        counts = self._refused.copy()
        for subscription in joined.subscriptions:
            counts[subscription.topic] += subscription.bad + subscription.other
        return +counts

    def _motion(self, located: tuple[Pose, Velocity3] | None) -> Motion | None:
        """A report: with where the robot is, or without, of why it can't be controlled, if that is new."""
        if not self._topics.drives:
            return None
        status = (self._state, self._trouble)
        if located is None and (not self._trouble or status == self._told):
            return None
        self._told = status
        u, w, v = self._applied
        pose, twist = located or (None, Velocity3(0.0, 0.0, 0.0))
        return Motion(
            ticks=(),
            applied=(u, w),
            applied_v_mps=v,
            state=self._state,
            controllable=not self._trouble,
            reason=self._trouble,
            pose=None if pose is None else (pose.x, pose.y, pose.psi),
            twist=(twist.u, twist.w, twist.v),
        )

    def _stand(self, now: Time) -> None:
        """Tell the robot to stand, unless somebody else commands it."""
        self._may_move = False
        if self._is_taken(now):
            self._applied = _STANDING
        else:
            self._tell(_STANDING, now)

    def _tell(self, velocity: Velocity, now: Time) -> None:
        u, w, v = self._applied = velocity
        self._may_move = self._may_move or velocity != _STANDING
        if self._link is not None:
            stamp = self._robot_time and self._robot_time + now - self._pose_at
            self._link.publish(Velocity3(u, w, v), stamp, self._frames[1] or "base_link")


def _topics_of(robot: Robot) -> RobotTopics:
    """Raises `ScenarioError` where they have names that ROS 2 does not know."""
    drives = robot.driver == "ros2"
    scans = robot.scans == "ros2" or (drives and not robot.scans)
    names = names_of(robot)
    return RobotTopics(names.cmd_vel, names.odom, names.scan, robot.ros2.stamped, drives, scans)


def _drain(heard: Heard) -> list[tuple[Any, Any]]:
    return [heard.popleft() for _ in range(len(heard))]


def _topic(name: str, publishers: Sequence[Entity], source: Source) -> str:
    rate = source.rate_hz()
    said = f"{rate:.1f} Hz" if rate else "nothing heard"
    who = _who(publishers)
    return f"{name}: {said}" + (f", {who}" if who else "")


def _who(entities: Sequence[Entity]) -> str:
    """Types, and nodes where they are known."""
    types = _some({entity.type for entity in entities})
    nodes = _some({f"{entity.namespace.rstrip('/')}/{entity.node}" for entity in entities if entity.node})
    return f"{types} ({nodes})" if nodes else types


def _some(names: Sequence[str] | set[str]) -> str:
    """A list of names, not too long."""
    shown = sorted(names)
    more = f" and {len(shown) - _SHOWN} more" if len(shown) > _SHOWN else ""
    return ", ".join(shown[:_SHOWN]) + more
