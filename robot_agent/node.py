"""The agent of one robot as a node: commands, encoder counts or poses, and scans in; drive, odometry and
ranges out."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from maniple.control import geofence, guard
from maniple.control.builtin import BUILTIN
from maniple.control.limits import Limits, Velocity, aged, limits_of
from maniple.control.parts import Parts
from maniple.control.pipeline import Pipeline, onboard_layers
from maniple.core import topics
from maniple.core.edges import WORLD, motion_source, preflight_asked, scan_source
from maniple.core.errors import ScenarioError
from maniple.core.geometry import Pose
from maniple.core.messages import (
    Alive,
    Command,
    Counters,
    Drive,
    EmergencyStop,
    Message,
    Mode,
    Motion,
    Odometry,
    Refused,
    Scan,
    Stamp,
    Status,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Duration, Time, from_seconds, period, to_seconds
from robot_agent import dead_reckoning, modes
from robot_agent.contrary import STUCK_AFTER, Contrary
from robot_agent.drivers import BUILTIN as DRIVERS
from robot_agent.drivers import capabilities_of
from robot_agent.drivers.interface import COUNTS, EVENTS, DriverFactory, within
from robot_agent.emergency import Emergency
from robot_agent.localisation import Localisation
from robot_agent.orders import Orders
from robot_agent.range_sensing import RangeSensing

DRIVE, STATUS = "drive", "status"

_STALE_PERIODS = 2.5
"""A source that has missed two reports says nothing about now."""

_CONTROLLER, _ROUTER = "controller", "router"

_STANDING = Velocity()

_STILL = Velocity(0.02, 0.05, 0.02)
"""What is measured to be slower than this stands."""

_DISPLACED_M = 1.0
"""A robot that turns out to be farther than this from where it was believed to be stands until it is
commanded from there."""

_FARTHEST_M, _FASTEST = 1e6, 1e3
"""No drive is farther from where its frame begins, or moves or turns faster (m/s, rad/s)."""


class RobotAgent:
    """Guides one robot of a resolved scenario: from the cut of the layers on, and with the last word.

    `incarnation` is the life of this agent: commands that answer an earlier one are not acted on. Until a
    later life than the first knows where its odometry frame lies it takes no commands. An operator's
    emergency stop is above all: until it is armed again the robot stands, and then it moves only on a command
    that was computed from what it said since. A robot that has moved against what it was told stands too,
    until an operator has stopped and armed it. It says that it runs the scenario with this `digest`, by
    default that of `scenario`.

    Raises:
        ScenarioError: the scenario has no such robot, or its driver can't be commanded.
    """

    def __init__(
        self,
        scenario: Scenario,
        robot_id: str,
        incarnation: int = 1,
        parts: Parts = BUILTIN,
        drivers: Mapping[str, DriverFactory] = DRIVERS,
        digest: str = "",
    ) -> None:
        robot = _find(scenario, robot_id)
        model, layer = scenario.model_of(robot), scenario.placement.robot_from
        capabilities = capabilities_of(scenario, robot, drivers)
        self._id = robot_id
        self._digest = (digest or short_digest(scenario)) if preflight_asked(scenario) else ""
        self._motion_source, self._scan_source = motion_source(robot), scan_source(robot)
        self._odometry, self._ranges = topics.odometry(robot_id), topics.ranges(robot_id)
        self._drive, self._status = topics.drive(robot_id), topics.status(robot_id)
        self._guard = scenario.guard
        self._limits = within(limits_of(scenario, robot), capabilities, robot_id)
        self._drive_timeout_s = model.drive_timeout_s
        self._motion_stale = _stale_after(topics.motion(robot_id), capabilities.motion_hz)
        self._gauge = dead_reckoning.gauge_of(model, in_world=capabilities.frame == WORLD)
        self._pipeline = Pipeline(onboard_layers(layer), scenario, robot, parts)
        scan_hz = capabilities.scan_hz if self._scan_source == self._motion_source else 0.0
        self._scan_stale = _stale_after(topics.scan(robot_id), scan_hz or scenario.rates.scan_hz)
        self._sensing = RangeSensing(self._scan_stale)
        self._orders = Orders(layer, incarnation)
        self._emergency = Emergency()
        self._contrary, self._disobeys = Contrary(model), ""
        self._reckoning = dead_reckoning.Reckoning()
        self._frame = Localisation(capabilities.frame, incarnation, self._gauge)
        self._fence = geofence.fence_of(scenario.guard.fence)
        assert robot.pose is not None, "the scenario is resolved"
        self._origin = Pose(0.0, 0.0, 0.0) if self._gauge.in_world else Pose(*robot.pose)
        self._motion: Motion | None = None
        self._motion_at: Time = 0
        self._located_at: Time = 0
        self._lost = False
        self._lives: dict[str, set[int]] = {_CONTROLLER: set()}
        self._estop_tested = False
        self._mode: Mode = "waiting"
        self._active = True
        self._sent = _STANDING
        self._wanted = _STANDING
        self._begun = False
        self._verdict: guard.Reason = "none"
        self._applied: Stamp | None = None
        self._applied_since: Time = 0
        self._oldest_s = -1.0
        self._driven: Time | None = None
        self._counted: Counter[str] = Counter()
        self._host_counters: Mapping[str, int] = {}
        self._timers = {DRIVE: period(scenario.rates.drive_hz), STATUS: period(scenario.rates.status_hz)}
        self._handlers: Mapping[str, Callable[..., Sequence[Outgoing]]] = {
            topics.motion(robot_id): self._on_motion,
            topics.scan(robot_id): self._on_scan,
            topics.command(robot_id): self._on_command,
            self._odometry: self._on_own_odometry,
            topics.STOP: self._on_operator,
        }

    @property
    def name(self) -> str:
        """The robot's id."""
        return self._id

    @property
    def subscriptions(self) -> frozenset[str]:
        """Topics the node receives."""
        return frozenset(self._handlers) | {topics.HOST_ALIVE, topics.HOST_REFUSED, topics.HOST_COUNTERS}

    @property
    def timers(self) -> Mapping[str, Duration]:
        """Commands to the drive, and status."""
        return self._timers

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        """Say that the robot is there, and waiting."""
        self._orders.begin(now)
        return (self._report(now),)

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        """Take in what the hardware, the controller or the host says."""
        handler = self._handlers.get(message.topic)
        return self._on_host(message.message) if handler is None else handler(message.message, now)

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        """Command the drive, or report."""
        if timer != DRIVE:
            return (self._report(now),)
        resumed, drive = self._resume(now), self._command_drive(now)
        self._contrary.tell(self._sent, now)
        return *resumed, drive

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        """Let the drive brake and deactivate."""
        self._mode = modes.TRANSITIONS[self._mode, "stop"]
        self._sent = _STANDING
        return self._told(_STANDING, False), self._report(now)

    def _on_motion(self, motion: Motion, now: Time) -> Sequence[Outgoing]:
        """Advance the dead reckoning. A driver that lives or was set up anew counts from a new origin, unless
        it says itself when it does; one that knows neither counts nor a pose yet only tells how it is."""
        if (refusal := self._refusal(motion)) is not None:
            self._counted[f"refused_{refusal}"] += 1
            return ()
        before, old = self._reckoning, self._motion
        if old is not None and not (
            motion.incarnation == old.incarnation and COUNTS[old.state] and COUNTS[motion.state]
        ):
            before = dead_reckoning.begun_anew(self._gauge, before)
        self._motion, self._motion_at, self._reckoning = motion, now, before
        self._lost = self._lost or self._driver_event(now) == "driver_lost"
        if not motion.ticks and motion.pose is None:
            return ()
        self._reckoning, jumped = dead_reckoning.advance(self._gauge, before, motion, motion.stamp_ns)
        if jumped:
            self._counted["encoder_jumps" if motion.pose is None else "pose_jumps"] += 1
            self._displace(before.pose, now)
        self._look_whether_it_obeys(now)
        self._located_at = now
        self._frame.counted(motion, now)
        resumed = self._resume(now)
        pose, (u, w, v) = self._reckoning.pose, self._reckoning.velocity
        odometry = Odometry(
            frame_id=self._frame.frame_id,
            x_m=pose.x,
            y_m=pose.y,
            psi_rad=pose.psi,
            u_mps=u,
            w_radps=w,
            v_mps=v,
            applied=self._applied,
            held_ns=0 if self._applied is None else now - self._applied_since,
            ticks=motion.ticks if motion.pose is None else (),
            motion_pose=motion.pose,
            motion_incarnation=motion.incarnation,
            motion_origin=motion.origin,
        )
        return (*resumed, Outgoing(self._odometry, odometry))

    def _look_whether_it_obeys(self, now: Time) -> None:
        """By what is measured now."""
        found = self._contrary.hear(self._reckoning.velocity, now)
        if found and not self._disobeys:
            self._disobeys = found
            self._counted["contrary"] += 1

    def _refusal(self, motion: Motion) -> str | None:
        """Why a report of a drive is not believed: it comes from another process than the scenario names, has
        not a count for each wheel, or none where the drive is to know where in the world it is, or says what
        no drive can mean."""
        if motion.source != self._motion_source:
            return "foreign"
        if motion.pose is None:
            wheels = 0 if self._gauge.in_world else len(self._gauge.wheels.ahead)
            return "ticks" if len(motion.ticks) not in (0, wheels) else None
        far, fast = max(map(abs, motion.pose)), max(map(abs, motion.twist))
        return None if far <= _FARTHEST_M and fast <= _FASTEST else "absurd"

    def _displace(self, before: Pose, now: Time) -> None:
        """The robot is elsewhere than was believed. If it is far, the command that it holds was computed for
        another place."""
        after = self._reckoning.pose
        if after == before:
            return
        self._sensing.displaced(before, after)
        if math.hypot(after.x - before.x, after.y - before.y) > _DISPLACED_M:
            self._mode = modes.TRANSITIONS[self._mode, "displaced"]
            self._orders.begin(now)

    def _on_own_odometry(self, odometry: Odometry, now: Time) -> Sequence[Outgoing]:
        """The last word of an earlier life."""
        self._frame.heard(odometry)
        return self._resume(now)

    def _resume(self, now: Time) -> Sequence[Outgoing]:
        """Go on in the frame of the life before, as soon as it is known where that lies."""
        origin = self._frame.resume(now)
        if origin is None:
            return ()
        self._reckoning = self._reckoning._replace(pose=origin.compose(self._reckoning.pose))
        self._sensing = RangeSensing(self._scan_stale)
        self._orders.begin(now)
        return (self._report(now),)

    def _on_operator(self, said: EmergencyStop, now: Time) -> Sequence[Outgoing]:
        """Stand at once, or be ready to move again."""
        change = self._emergency.take(said)
        if change is None:
            return ()
        self._mode = modes.TRANSITIONS[self._mode, change]
        if change == "armed":
            self._disobeys = ""
            self._orders.begin(now)
            self._estop_tested = self._estop_tested or self._stands(now)
        drive = self._stand()
        self._contrary.tell(self._sent, now)
        return drive, self._report(now)

    def _stands(self, now: Time) -> bool:
        """Whether its drive, heard and controllable, says that it does not move."""
        motion = self._motion
        if motion is None or not self._controllable(now) or not (motion.ticks or motion.pose is not None):
            return False
        return all(abs(is_) < still for is_, still in zip(self._reckoning.velocity, _STILL, strict=True))

    def _on_scan(self, scan: Scan, now: Time) -> Sequence[Outgoing]:
        """Pass it on as it is, mount included."""
        if scan.source != self._scan_source:
            self._counted["refused_foreign"] += 1
            return ()
        if self._limits.needs_ranges:
            self._sensing.take(scan, self._reckoning.pose, now)
        return (Outgoing(self._ranges, scan),)

    def _on_command(self, command: Command, now: Time) -> Sequence[Outgoing]:
        refusal = self._orders.take(command, now) if self._frame.known else "unlocalised"
        if refusal is not None:
            self._counted[f"refused_{refusal}"] += 1
        return ()

    def _on_host(self, message: Message) -> Sequence[Outgoing]:
        """Count what never got here, and what the host counts; know whether a controller is there."""
        if isinstance(message, Alive):
            if message.node in (_CONTROLLER, _ROUTER):
                lives = self._lives.setdefault(message.node, set())
                (lives.add if message.alive else lives.discard)(message.node_incarnation)
        elif isinstance(message, Refused):
            self._counted[f"refused_{message.reason}"] += message.count
        elif isinstance(message, Counters):
            self._host_counters = message.counters
        return ()

    def _command_drive(self, now: Time) -> Outgoing:
        """One tick: mode, layers, guard."""
        dt_s = self._elapsed_s(now)
        age_s = self._orders.age_s(now)
        self._oldest_s = max(self._oldest_s, age_s)
        limits = self._limits_now()
        self._mode = self._next_mode(age_s, limits, now)
        command, pose = self._orders.command, self._reckoning.pose
        if command is None:
            return self._stand()
        seen = self._sensing.latest(now)
        measured = self._reckoning.velocity
        values, free = (*command.values, command.third), self._wanted == self._sent
        wanted = self._pipeline.step(values, pose.psi, seen, measured, dt_s if self._begun else 0.0, free)
        self._wanted, self._begun = wanted, True
        if not modes.MOVES[self._mode]:
            return self._stand("blind" if self._blind(now) else "none")
        if self._guard.clearance:
            seen = self._sensing.around(pose, now)
        fence = None
        if self._fence is not None:
            if now - self._located_at > self._motion_stale:
                return self._stand("fence")
            middle = self._origin.compose(pose).compose(Pose(limits.centre, 0.0, 0.0))
            fence = geofence.seen_from(middle, self._fence)
        self._sent, self._verdict = guard.step(
            self._guard, limits, self._sent, wanted, age_s, seen, dt_s, measured, fence
        )
        if self._verdict == "speed":
            self._counted["clipped"] += 1
        self._applied, self._applied_since = self._orders.stamp(), self._orders.arrived
        self._active = True
        return self._told(self._sent, True)

    def _stand(self, verdict: guard.Reason = "none") -> Outgoing:
        self._sent, self._verdict = _STANDING, verdict
        wanted = modes.WANTS_DRIVER[self._mode]
        if wanted is None:
            wanted = self._active and self._motion is not None and self._motion.state == "active"
        self._active = wanted
        return self._told(_STANDING, self._active)

    def _told(self, velocity: Velocity, active: bool) -> Outgoing:
        """What the drive is told."""
        u, w, v = velocity
        drive = Drive(u_mps=u, w_radps=w, v_mps=v, active=active, controller_alive=self._knows_a_controller())
        return Outgoing(self._drive, drive)

    def _knows_a_controller(self) -> bool:
        """Whether one is there. Without a router, where there was one, nothing is known of who is."""
        return bool(self._lives[_CONTROLLER]) and self._lives.get(_ROUTER) != set()

    def _limits_now(self) -> Limits:
        """With the age that the command bears."""
        command = self._orders.command
        return self._limits if command is None else aged(self._limits, command.stop_after_s)

    def _elapsed_s(self, now: Time) -> float:
        """Since the tick before. 0 at the first, and after a silence in which the drive has braked by itself:
        then everything begins from a stand."""
        dt_s = 0.0 if self._driven is None else to_seconds(now - self._driven)
        self._driven = now
        if dt_s < self._drive_timeout_s:
            return dt_s
        self._sent = _STANDING
        return 0.0

    def _next_mode(self, age_s: float, limits: Limits, now: Time) -> Mode:
        event = self._driver_event(now)
        if self._lost and event != "driver_lost":
            self._mode = modes.TRANSITIONS[self._mode, "driver_lost"]
            self._orders.begin(now)  # what it was told before was not for a robot that stands here
        self._lost = event == "driver_lost" and self._motion is not None
        if self._emergency.stopped:
            return modes.TRANSITIONS[self._mode, "emergency"]
        if self._disobeys:
            return modes.TRANSITIONS[self._mode, "contrary"]
        if self._pipeline.fault:
            return modes.TRANSITIONS[self._mode, "layer_failed"]
        mode = modes.TRANSITIONS[self._mode, event]
        if event != "driver_active" or self._orders.command is None:
            return mode
        if age_s >= limits.stop_s:
            return modes.TRANSITIONS[mode, "old"]
        if self._blind(now):
            return modes.TRANSITIONS[mode, "blind"]
        return modes.TRANSITIONS[mode, "aging" if age_s > limits.hold_s else "fresh"]

    def _blind(self, now: Time) -> bool:
        """Whether it would have to drive by ranges that it does not have."""
        return self._limits.needs_ranges and self._sensing.latest(now) is None

    def _driver_event(self, now: Time) -> modes.Event:
        motion = self._motion
        return "driver_lost" if motion is None or not self._controllable(now) else EVENTS[motion.state]

    def _controllable(self, now: Time) -> bool:
        """Whether its drive is heard, and lets itself be controlled."""
        motion = self._motion
        return motion is not None and now - self._motion_at <= self._motion_stale and motion.controllable

    def _report(self, now: Time) -> Outgoing:
        """The status, counting the ages anew from here."""
        motion, age_s = self._motion, self._orders.age_s(now)
        status = Status(
            mode=self._mode,
            guard=self._verdict,
            command_age_s=age_s,
            command_age_max_s=max(self._oldest_s, age_s),
            driver="closed" if motion is None else motion.state,
            reason=self._reason(age_s, now),
            counters={**self._host_counters, **self._counted},
            compensation=self._pipeline.compensation,
            localised=self._frame.known,
            controllable=self._controllable(now),
            estop_tested=self._estop_tested,
            scenario=self._digest,
            drive_scenario="" if motion is None else motion.scenario,
            sees=not self._blind(now),
            limits=(self._limits.u_max, self._limits.w_max, self._limits.v_max),
        )
        self._oldest_s = -1.0
        return Outgoing(self._status, status)

    def _reason(self, age_s: float, now: Time) -> str:
        """Why the robot is not tracking, for people."""
        if self._mode in ("tracking", "stopped"):
            return self._stuck() if self._mode == "tracking" else "told to stop"
        if self._mode == "emergency":
            return self._emergency.reason
        if self._disobeys:
            return f"{self._disobeys}; it stands until an operator has stopped and armed it"
        if self._pipeline.fault:
            return self._pipeline.fault
        event, motion = self._driver_event(now), self._motion
        if motion is None:
            return "no word from the drive yet"
        if event == "driver_lost":
            silent_s = to_seconds(now - self._motion_at)
            if now - self._motion_at > self._motion_stale:
                return f"no word from the drive for {silent_s:.1f} s"
            state = f"in state {motion.state}" if motion.controllable else "not controllable"
            return motion.reason or f"the drive is {state}"
        if event == "driver_ready":
            return "the drive is not active yet"
        if not self._frame.known:
            return "restarted, and has not heard where its odometry frame lies"
        if self._orders.command is None:
            return "no command yet"
        if age_s < self._limits_now().stop_s and self._blind(now):
            return self._sensing.silence(now)
        return f"the command is {age_s:.1f} s old"

    def _stuck(self) -> str:
        """What a robot that is tracking can't do, for people."""
        told = f"told to drive for {to_seconds(STUCK_AFTER):g} s and does not move (blocked, its motors)"
        return told if self._contrary.stuck else ""


def _find(scenario: Scenario, robot_id: str) -> Robot:
    for robot in scenario.robots:
        if robot.id == robot_id:
            return robot
    known = ", ".join(robot.id for robot in scenario.robots)
    raise ScenarioError(f"robots: there is no {robot_id!r}; there are {known}")


def _stale_after(topic: str, rate_hz: float) -> Duration:
    """When the last value of a hardware topic says nothing about now."""
    return from_seconds(max(topics.topic(topic).stale_after_s, _STALE_PERIODS / rate_hz))
