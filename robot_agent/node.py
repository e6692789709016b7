"""The agent of one robot as a node: commands, encoder counts and scans in; drive, odometry and ranges out."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from maniple.control import guard
from maniple.control.builtin import BUILTIN
from maniple.control.limits import Limits, Velocity, aged, limits_of
from maniple.control.parts import Parts
from maniple.control.pipeline import Pipeline, onboard_layers
from maniple.core import topics
from maniple.core.errors import ScenarioError
from maniple.core.messages import (
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
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Duration, Time, from_seconds, period, to_seconds
from robot_agent import dead_reckoning, modes
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

_STANDING = Velocity()


class RobotAgent:
    """Guides one robot of a resolved scenario: from the cut of the layers on, and with the last word.

    `incarnation` is the life of this agent: commands that answer an earlier one are not acted on. Until a
    later life than the first knows where its odometry frame lies it takes no commands. An operator's
    emergency stop is above all: until it is armed again the robot stands, and then it moves only on a command
    that was computed from what it said since.

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
    ) -> None:
        robot = _find(scenario, robot_id)
        model, layer = scenario.model_of(robot), scenario.placement.robot_from
        capabilities = capabilities_of(scenario, robot, drivers)
        self._id = robot_id
        self._odometry, self._ranges = topics.odometry(robot_id), topics.ranges(robot_id)
        self._drive, self._status = topics.drive(robot_id), topics.status(robot_id)
        self._guard = scenario.guard
        self._limits = within(limits_of(scenario, robot), capabilities, robot_id)
        self._drive_timeout_s = model.drive_timeout_s
        self._motion_stale = _stale_after(topics.motion(robot_id), capabilities.motion_hz)
        self._wheels = dead_reckoning.wheels_of(model)
        self._pipeline = Pipeline(onboard_layers(layer), scenario, robot, parts)
        self._scan_stale = _stale_after(topics.scan(robot_id), capabilities.scan_hz)
        self._sensing = RangeSensing(self._scan_stale)
        self._orders = Orders(layer, incarnation)
        self._emergency = Emergency()
        self._reckoning = dead_reckoning.Reckoning()
        self._frame = Localisation(capabilities.frame, incarnation, self._wheels)
        self._motion: Motion | None = None
        self._motion_at: Time = 0
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
        return frozenset(self._handlers) | {topics.HOST_REFUSED, topics.HOST_COUNTERS}

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
        return *self._resume(now), self._command_drive(now)

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        """Let the drive brake and deactivate."""
        self._mode = modes.TRANSITIONS[self._mode, "stop"]
        self._sent = _STANDING
        return Outgoing(self._drive, Drive(u_mps=0.0, w_radps=0.0, active=False)), self._report(now)

    def _on_motion(self, motion: Motion, now: Time) -> Sequence[Outgoing]:
        """Advance the dead reckoning. A driver that lives or was set up anew counts from a new origin."""
        if len(motion.ticks) != len(self._wheels.ahead):
            self._counted["refused_ticks"] += 1
            return ()
        state, before = self._reckoning, self._motion
        if before is not None and not (
            motion.incarnation == before.incarnation and COUNTS[before.state] and COUNTS[motion.state]
        ):
            state = state._replace(ticks=None)
        self._reckoning, jumped = dead_reckoning.step(self._wheels, state, motion.ticks, motion.stamp_ns)
        if jumped:
            self._counted["encoder_jumps"] += 1
        self._motion, self._motion_at = motion, now
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
            ticks=motion.ticks,
            motion_incarnation=motion.incarnation,
        )
        return (*resumed, Outgoing(self._odometry, odometry))

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
            self._orders.begin(now)
        return self._stand(), self._report(now)

    def _on_scan(self, scan: Scan, now: Time) -> Sequence[Outgoing]:
        """Pass it on as it is, mount included."""
        if self._limits.needs_ranges:
            self._sensing.take(scan, self._reckoning.pose, now)
        return (Outgoing(self._ranges, scan),)

    def _on_command(self, command: Command, now: Time) -> Sequence[Outgoing]:
        refusal = self._orders.take(command, now) if self._frame.known else "unlocalised"
        if refusal is not None:
            self._counted[f"refused_{refusal}"] += 1
        return ()

    def _on_host(self, message: Message) -> Sequence[Outgoing]:
        """Count what never got here, and what the host counts."""
        if isinstance(message, Refused):
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
        self._sent, self._verdict = guard.step(
            self._guard, limits, self._sent, wanted, age_s, seen, dt_s, measured
        )
        if self._verdict == "speed":
            self._counted["clipped"] += 1
        u, w, v = self._sent
        self._applied, self._applied_since = self._orders.stamp(), self._orders.arrived
        self._active = True
        return Outgoing(self._drive, Drive(u_mps=u, w_radps=w, v_mps=v, active=True))

    def _stand(self, verdict: guard.Reason = "none") -> Outgoing:
        self._sent, self._verdict = _STANDING, verdict
        wanted = modes.WANTS_DRIVER[self._mode]
        self._active = self._active if wanted is None else wanted
        return Outgoing(self._drive, Drive(u_mps=0.0, w_radps=0.0, active=self._active))

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
        if self._emergency.stopped:
            return modes.TRANSITIONS[self._mode, "emergency"]
        if self._pipeline.fault:
            return modes.TRANSITIONS[self._mode, "layer_failed"]
        event = self._driver_event(now)
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
        if motion is None or now - self._motion_at > self._motion_stale or not motion.controllable:
            return "driver_lost"
        return EVENTS[motion.state]

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
            sees=not self._blind(now),
            limits=(self._limits.u_max, self._limits.w_max, self._limits.v_max),
        )
        self._oldest_s = -1.0
        return Outgoing(self._status, status)

    def _reason(self, age_s: float, now: Time) -> str:
        """Why the robot is not tracking, for people."""
        if self._mode in ("tracking", "stopped"):
            return "" if self._mode == "tracking" else "told to stop"
        if self._mode == "emergency":
            return self._emergency.reason
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


def _find(scenario: Scenario, robot_id: str) -> Robot:
    for robot in scenario.robots:
        if robot.id == robot_id:
            return robot
    known = ", ".join(robot.id for robot in scenario.robots)
    raise ScenarioError(f"robots: there is no {robot_id!r}; there are {known}")


def _stale_after(topic: str, rate_hz: float) -> Duration:
    """When the last value of a hardware topic says nothing about now."""
    return from_seconds(max(topics.topic(topic).stale_after_s, _STALE_PERIODS / rate_hz))
