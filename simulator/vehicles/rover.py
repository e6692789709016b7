"""A simulated body as an ArduPilot Rover, as far as a ground station can tell. Pure: messages and time in,
messages and an order to the body out.

What it does is what ArduPilot Rover 4.7 does (its sources, and what was measured on it): modes, arming and
its checks, acknowledgements, the state of its EKF, parameters, message intervals, body velocities in GUIDED
with their 3 s timeout, the ground station failsafe, MANUAL_CONTROL. It drives nowhere by itself: it takes
velocities, no waypoints, and refuses the modes that need them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from maniple.control.limits import Velocity
from maniple.core.geometry import wrap
from maniple.core.messages import Drive, Motion, Scan
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import SECOND, Duration, Time, from_seconds
from simulator.vehicles.rover_drive import RoverDrive
from simulator.vehicles.rover_estimate import POS_HORIZ_ABS, Estimate, Geo
from simulator.vehicles.rover_parameters import Parameter, parameters_of
from simulator.vehicles.rover_telemetry import Telemetry, View

MANUAL, HOLD, LOITER, GUIDED = 0, 4, 5, 15
MODES: Mapping[int, str] = {
    MANUAL: "MANUAL",
    1: "ACRO",
    3: "STEERING",
    HOLD: "HOLD",
    LOITER: "LOITER",
    6: "FOLLOW",
    7: "SIMPLE",
    8: "DOCK",
    9: "CIRCLE",
    10: "AUTO",
    11: "RTL",
    12: "SMART_RTL",
    GUIDED: "GUIDED",
}
"""Of ArduPilot Rover, by `custom_mode`."""
DRIVES = (MANUAL, HOLD, LOITER, GUIDED)
"""Those that this one has: the others fail, as without a mission, a home or a beacon."""
NEED_POSITION = (LOITER, GUIDED)

COMMAND_TIMEOUT: Duration = 3 * SECOND
"""Without another target in GUIDED it stops."""
LOST: Duration = SECOND
"""Without a position in a mode that needs one it holds."""
FIRST_COMPLAINT: Duration = 2 * SECOND
PRE_ARM_AGAIN: Duration = 30 * SECOND
"""While it can't be armed it says why: first so long after it was switched on, then every so often."""
FORCE_ARM, FORCE_DISARM = 2989, 21196

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
"""MAV_RESULT."""
CRITICAL, WARNING, INFO = 2, 4, 6
"""MAV_SEVERITY."""

_POSITION, _VELOCITY, _ACCELERATION, _YAW, _YAW_RATE = 0x003, 0x018, 0x1C0, 0x400, 0x800
"""Bits of the type mask of SET_POSITION_TARGET_LOCAL_NED: what is to be ignored. Rovers do not look at
z."""
_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED = 1, 7, 8, 9
_FRAMES = (_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED)
_LOCAL_FRD, _BODY_FRD = 20, 12
_NO_AXIS = 32767
_UNLIMITED = 1e3
"""m/s^2."""


class Spec(NamedTuple):
    """What kind of vehicle it is."""

    system_id: int
    component_id: int
    gcs_system_id: int
    site: Geo
    """Where on earth the world's (0, 0) is."""
    external_pose: bool
    """Whether it has no position of its own."""
    u_max: float
    """m/s."""
    w_max: float
    """rad/s."""
    theta: tuple[float, ...]
    """Velocity dynamics of its body."""


SITE = (-35.363262, 149.165237, 584.0)
"""Where it stands without an origin in the scenario: ArduPilot's own test site (degrees, m)."""


def spec_of(scenario: Scenario, robot: Robot) -> Spec:
    """The vehicle that a robot of a resolved scenario is presented as."""
    link, model = robot.mavlink, scenario.model_of(robot)
    return Spec(
        system_id=link.system_id,
        component_id=link.component_id,
        gcs_system_id=link.gcs_system_id,
        site=Geo.of(*(link.origin or SITE)),
        external_pose=link.external_pose,
        u_max=model.u_max_mps,
        w_max=model.w_max_radps,
        theta=model.theta,
    )


class Said(NamedTuple):
    """A message to send."""

    message: Any
    """Of pymavlink."""
    to: int = 0
    """The system it is for; 0 for all."""


class _Target(NamedTuple):
    """What GUIDED was told last."""

    speed: float
    """m/s."""
    yaw: float | None
    """rad, the heading that is wanted, or"""
    yaw_rate: float
    """rad/s."""
    since: Time


class Rover:
    """One life of the vehicle, switched on at `boot`; `dialect` is pymavlink's module of messages."""

    def __init__(self, spec: Spec, dialect: Any, boot: Time) -> None:
        self._spec = spec
        self._d = dialect
        self._boot = boot
        self._table: Mapping[str, Parameter] = parameters_of(spec.gcs_system_id, spec.external_pose)
        self._parameters = {name: parameter.default for name, parameter in self._table.items()}
        self._asked_for: dict[int, list[int]] = {}
        self._estimate = Estimate(spec.site, not spec.external_pose, boot)
        self._drive = RoverDrive(spec.theta)
        self._telemetry = Telemetry(dialect, boot)
        self._said: list[Said] = []
        self.mode = MANUAL
        """`custom_mode`; as the real one it wakes up in MANUAL."""
        self.armed = False
        self._target: _Target | None = None
        self._stick: tuple[float, float, Time] | None = None
        self._gcs_seen: Time | None = None
        self._gcs_missed: Time | None = None
        self._failsafe = False
        self._lost_since: Time | None = None
        self._complained = boot + FIRST_COMPLAINT - PRE_ARM_AGAIN
        self._home: Geo | None = None
        self._velocity = Velocity()

    def see(self, report: Motion | Scan, now: Time) -> None:
        """What the body's sensors say."""
        if isinstance(report, Motion):
            self._estimate.see(report, now)
        else:
            self._telemetry.see(report, now)

    def step(self, now: Time, received: Sequence[Any]) -> tuple[list[Said], Drive]:
        """Take in what came since the last step; what there is to say, and what the body is to do."""
        self._said = []
        for message in received:
            self._receive(message, now)
        if self._estimate.update(now):
            self._tell_origin()
        self._watch(now)
        order = self._move(now)
        for to, names in self._asked_for.items():  # a few at a time, as on a narrow line
            for index in names[:4]:
                self._said.append(Said(self._parameter(index), to))
            del names[:4]
        self._said += [Said(message, to) for message, to in self._telemetry.due(self._view(now))]
        return self._said, order

    def _view(self, now: Time) -> View:
        return View(
            now=now,
            mode=self.mode,
            autonomous=self.mode in NEED_POSITION,
            armed=self.armed,
            failsafe=self._failsafe,
            ready=not self._problems(now),
            flags=self._estimate.flags(now),
            attitude=self._estimate.attitude(now),
            position=self._estimate.position(now),
            origin=self._estimate.origin,
            fix=self._estimate.fix(now),
            has_gnss=not self._spec.external_pose,
            home=self._home,
            u=self._velocity.u,
            u_max=self._spec.u_max,
        )

    def _receive(self, message: Any, now: Time) -> None:
        """Deal with one message; what is not for this vehicle, or makes no sense, has no effect."""
        sender, kind = message.get_srcSystem(), message.get_type()
        if sender in (0, self._spec.system_id):
            return
        if self._bit("MAV_OPTIONS") and sender != self._value("MAV_GCS_SYSID"):
            return
        self._telemetry.met(sender, now)
        target = getattr(message, "target_system", getattr(message, "target", 0))
        component = getattr(message, "target_component", 0)
        if target not in (0, self._spec.system_id) or component not in (0, self._spec.component_id):
            return
        handle = _HANDLERS.get(kind)
        if handle is not None:
            handle(self, message, now)

    def _heartbeat(self, message: Any, now: Time) -> None:
        if message.get_srcSystem() == self._value("MAV_GCS_SYSID"):
            self._gcs_seen = now

    def _command_long(self, message: Any, now: Time) -> None:
        given = [getattr(message, f"param{k}") for k in range(1, 8)]
        self._command(message, given, now)

    def _command_int(self, message: Any, now: Time) -> None:
        given = [getattr(message, f"param{k}") for k in range(1, 5)]
        self._command(message, [*given, message.x, message.y, message.z], now)

    def _command(self, message: Any, given: Sequence[float], now: Time) -> None:
        """Obey or refuse, and say which."""
        d, sender = self._d, message.get_srcSystem()
        result = UNSUPPORTED
        first, second = _whole(given[0]), _whole(given[1])
        if message.command == d.MAV_CMD_DO_SET_MODE:
            result = self._asked_mode(first, second, now)
        elif message.command == d.MAV_CMD_COMPONENT_ARM_DISARM:
            result = self._asked_arm(first, second, now)
        elif message.command == d.MAV_CMD_RUN_PREARM_CHECKS:
            self._complain(now)
            result = ACCEPTED
        elif message.command == d.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._asked_interval(sender, first, given[1], now)
        elif message.command == d.MAV_CMD_GET_MESSAGE_INTERVAL:
            interval = self._telemetry.interval_us(sender, first)
            self._said.append(Said(d.MAVLink_message_interval_message(first % 65536, interval), sender))
            result = ACCEPTED if interval else FAILED
        elif message.command in (
            d.MAV_CMD_REQUEST_MESSAGE,
            d.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
            d.MAV_CMD_GET_HOME_POSITION,
        ):
            wanted = {
                d.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: d.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
                d.MAV_CMD_GET_HOME_POSITION: d.MAVLINK_MSG_ID_HOME_POSITION,
            }.get(message.command, first)
            answers = self._telemetry.made(wanted, self._view(now))
            result = ACCEPTED if answers else FAILED
            self._said += [Said(answer, sender) for answer in answers]
        elif message.command in (d.MAV_CMD_NAV_RETURN_TO_LAUNCH, d.MAV_CMD_MISSION_START):
            self._text(WARNING, "Flight mode change failed")
            result = FAILED
        elif message.command == d.MAV_CMD_DO_CHANGE_SPEED:
            result = FAILED
        self._said.append(
            Said(
                d.MAVLink_command_ack_message(
                    message.command, result, 0, 0, sender, message.get_srcComponent()
                ),
                sender,
            )
        )

    def _asked_mode(self, base: int, custom: int, now: Time) -> int:
        """What comes of DO_SET_MODE."""
        if not base & self._d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return DENIED
        return ACCEPTED if self._enter(custom, now) else FAILED

    def _set_mode(self, message: Any, now: Time) -> None:
        result = self._asked_mode(message.base_mode, message.custom_mode, now)
        ack = self._d.MAVLink_command_ack_message(self._d.MAVLINK_MSG_ID_SET_MODE, result)
        self._said.append(Said(ack, message.get_srcSystem()))

    def _enter(self, mode: int, now: Time) -> bool:
        """Change the mode, if that is open."""
        if mode not in MODES:
            self._text(WARNING, f"No such mode {mode}")
            return False
        if mode not in DRIVES or (
            self.armed and mode in NEED_POSITION and self._estimate.position(now) is None
        ):
            self._text(WARNING, "Flight mode change failed")
            return False
        if mode != self.mode:
            self.mode = mode
            self._target = self._stick = self._lost_since = None
            self._heartbeat_now()
        return True

    def _asked_arm(self, first: int, second: int, now: Time) -> int:
        """What comes of COMPONENT_ARM_DISARM."""
        if first == 1:
            problems = [] if second == FORCE_ARM else self._problems(now)
            if self.armed:
                return ACCEPTED
            for problem in problems:
                self._text(CRITICAL, f"Arm: {problem}")
            if problems:
                return FAILED
            self.armed = True
            self._target = self._stick = None
            self._drive.rest()
            self._text(INFO, "Throttle armed")
        elif first == 0:
            if not self.armed:
                return ACCEPTED
            self._disarm()
        else:
            return UNSUPPORTED
        self._heartbeat_now()
        return ACCEPTED

    def _disarm(self) -> None:
        self.armed = False
        self._target = self._stick = None
        self._text(INFO, "Throttle disarmed")

    def _problems(self, now: Time) -> list[str]:
        """Why it can't be armed now, in its own words."""
        if self.armed:
            return []
        problems = []
        if self._estimate.attitude(now) is None:
            problems.append(
                "Gyros not healthy" if now - self._boot > FIRST_COMPLAINT else "System not initialised"
            )
        if self._value("WP_SPEED") <= 0.0:
            problems.append("WP_SPEED too low")
        if self.mode in NEED_POSITION and not self._estimate.flags(now) & POS_HORIZ_ABS:
            if self._estimate.origin is None and self._spec.external_pose:
                problems.append("AHRS: waiting for home")
            problems.append("Need Position Estimate")
        return problems

    def _complain(self, now: Time) -> None:
        """Say why it can't be armed."""
        self._complained = now
        for problem in self._problems(now):
            self._text(CRITICAL, f"PreArm: {problem}")

    def _asked_interval(self, sender: int, message: int, interval_us: float, now: Time) -> int:
        """What comes of SET_MESSAGE_INTERVAL."""
        if not self._telemetry.knows(message):
            self._text(INFO, f"No ap_message for mavlink id ({message})")
            return DENIED
        if not math.isfinite(interval_us):
            return DENIED
        self._telemetry.set_interval_us(sender, message, round(interval_us), now)
        return ACCEPTED

    def _data_stream(self, message: Any, now: Time) -> None:
        rate_hz = message.req_message_rate if message.start_stop else 0
        self._telemetry.set_stream(message.get_srcSystem(), message.req_stream_id, rate_hz, now)

    def _origin(self, message: Any, now: Time) -> None:
        origin = Geo(message.latitude, message.longitude, message.altitude)
        if self._estimate.set_origin(origin, now):
            self._tell_origin()

    def _tell_origin(self) -> None:
        origin = self._estimate.origin
        assert origin is not None
        self._text(INFO, "EKF3 IMU0 origin set")
        self._say([self._d.MAVLink_gps_global_origin_message(*origin, 0)])

    def _odometry(self, message: Any, now: Time) -> None:
        frames = message.frame_id, message.child_frame_id
        if not self._value("VISO_TYPE") or frames != (_LOCAL_FRD, _BODY_FRD):
            return
        if _sane(message.x, message.y):
            self._estimate.feed(message.x, message.y, now)

    def _go(self, message: Any, now: Time) -> None:
        """SET_POSITION_TARGET_LOCAL_NED: in silence without effect where it is not to be obeyed."""
        here = self._estimate.attitude(now)
        if self.mode != GUIDED or self._estimate.origin is None or here is None:
            return
        if message.coordinate_frame not in _FRAMES:
            return
        mask, vx, vy = message.type_mask, message.vx, message.vy
        ignores = [bool(mask & bits) for bits in (_POSITION, _VELOCITY, _ACCELERATION, _YAW, _YAW_RATE)]
        no_position, no_velocity, no_acceleration, no_yaw, no_rate = ignores
        if not (no_position and no_acceleration) or not (no_yaw or no_rate):
            return
        used = [(vx, vy)] if not no_velocity else []
        used += [(message.yaw, 0.0)] if not no_yaw else []
        used += [(message.yaw_rate, 0.0)] if not no_rate else []
        if not used or not all(_sane(*pair) for pair in used):
            return
        turn = here.yaw if message.coordinate_frame in (_BODY_NED, _BODY_OFFSET_NED) else 0.0
        speed, yaw = 0.0, None
        if not no_velocity:
            speed = min(math.hypot(vx, vy), self._value("WP_SPEED"))
            if not (no_yaw and no_rate):
                speed = math.copysign(speed, vx)
            elif speed > 0.0:
                yaw = wrap(math.atan2(vy, vx) + turn)
        if not no_yaw:
            yaw = wrap(message.yaw + turn)
        self._target = _Target(speed, yaw, 0.0 if no_rate else message.yaw_rate, now)

    def _manual(self, message: Any, now: Time) -> None:
        if message.get_srcSystem() != self._value("MAV_GCS_SYSID"):
            return
        self._gcs_seen = now
        if _NO_AXIS not in (message.y, message.z):
            throttle, steering = (min(max(axis / 1000.0, -1.0), 1.0) for axis in (message.z, message.y))
            self._stick = throttle, steering, now

    def _parameter(self, index: int) -> Any:
        """PARAM_VALUE of one."""
        name = list(self._table)[index]
        return self._d.MAVLink_param_value_message(
            name.encode(), self._parameters[name], self._table[name].type, len(self._table), index
        )

    def _param_list(self, message: Any, _: Time) -> None:
        self._asked_for[message.get_srcSystem()] = list(range(len(self._table)))

    def _param_read(self, message: Any, _: Time) -> None:
        names = list(self._table)
        index = message.param_index
        if index < 0:
            name = message.param_id
            index = names.index(name) if name in names else -1
        if 0 <= index < len(names):
            self._said.append(Said(self._parameter(index), message.get_srcSystem()))

    def _param_set(self, message: Any, _: Time) -> None:
        parameter = self._table.get(message.param_id)
        if parameter is None:
            return
        value = message.param_value
        if math.isfinite(value) and parameter.least <= value <= parameter.most:
            whole = parameter.type != self._d.MAV_PARAM_TYPE_REAL32
            self._parameters[message.param_id] = float(round(value)) if whole else value
        self._say([self._parameter(list(self._table).index(message.param_id))])

    def _timesync(self, message: Any, now: Time) -> None:
        if message.tc1 == 0:
            answer = self._d.MAVLink_timesync_message(now - self._boot, message.ts1)
            self._said.append(Said(answer, message.get_srcSystem()))

    def _mission_list(self, message: Any, _: Time) -> None:
        sender, component = message.get_srcSystem(), message.get_srcComponent()
        answer = self._d.MAVLink_mission_count_message(sender, component, 0, message.mission_type)
        self._said.append(Said(answer, sender))

    def _mission_refused(self, message: Any, _: Time) -> None:
        sender, component = message.get_srcSystem(), message.get_srcComponent()
        answer = self._d.MAVLink_mission_ack_message(
            sender, component, self._d.MAV_MISSION_UNSUPPORTED, message.mission_type
        )
        self._said.append(Said(answer, sender))

    def _watch(self, now: Time) -> None:
        """What it looks after by itself: the ground station, its position, the checks before arming."""
        self._watch_gcs(now)
        here = self._estimate.position(now)
        if self._home is None and here is not None and self._estimate.origin is not None:
            self._home = self._estimate.origin.moved(here.north, here.east)
            self._say(self._telemetry.made(self._d.MAVLINK_MSG_ID_HOME_POSITION, self._view(now)))
        if self.armed and self.mode in NEED_POSITION and here is None:
            if self._lost_since is None:
                self._lost_since = now
            elif now - self._lost_since >= LOST:
                self._text(CRITICAL, "EKF failsafe")
                self._enter(HOLD, now)
        else:
            self._lost_since = None
        if not self.armed and now - self._complained >= PRE_ARM_AGAIN:
            self._complain(now)

    def _watch_gcs(self, now: Time) -> None:
        """The ground station failsafe: of a station that was there once."""
        if not self._value("FS_GCS_ENABLE") or self._gcs_seen is None:
            self._gcs_missed = None
            return
        if now - self._gcs_seen < from_seconds(self._value("FS_GCS_TIMEOUT")):
            if self._failsafe:
                self._text(INFO, "GCS Failsafe Cleared")
            self._failsafe, self._gcs_missed = False, None
            return
        if self._gcs_missed is None:
            self._gcs_missed = now
        waited = now - self._gcs_missed
        if not self._failsafe and self.mode != HOLD and waited > from_seconds(self._value("FS_TIMEOUT")):
            self._failsafe = True
            self._text(WARNING, "GCS Failsafe")
            self._stick = None
            if self._value("FS_ACTION"):  # all it has leads to HOLD: it can't drive home
                self._enter(HOLD, now)

    def _move(self, now: Time) -> Drive:
        """What the body is to do now."""
        if not self.armed:
            self._drive.rest()
            self._velocity = Velocity()
            return Drive(u_mps=0.0, w_radps=0.0, active=False)
        wanted = self._wanted(now)
        spec, accel = self._spec, self._value("ATC_ACCEL_MAX")
        if abs(wanted.u) < abs(self._velocity.u) and self._value("ATC_DECEL_MAX") > 0.0:
            accel = self._value("ATC_DECEL_MAX")
        u = min(max(wanted.u, -spec.u_max), spec.u_max)
        turn = min(spec.w_max, math.radians(self._value("ATC_STR_RAT_MAX")) or spec.w_max)
        w = min(max(wanted.w, -turn), turn)
        answer = self._drive.step(u, w, accel or _UNLIMITED, now)
        self._velocity = answer.velocity
        return Drive(u_mps=answer.order.u, w_radps=answer.order.w, active=True)

    def _wanted(self, now: Time) -> Velocity:
        """What the mode wants, in the robot's own sense of turning."""
        if self.mode == MANUAL and self._stick is not None:
            throttle, steering, since = self._stick
            patience = self._value("RC_OVERRIDE_TIME")
            if patience < 0.0 or now - since < from_seconds(patience):
                return Velocity(throttle * self._spec.u_max, -steering * self._spec.w_max)
            self._stick = None
        if self.mode != GUIDED or self._target is None:
            return Velocity()
        speed, yaw, yaw_rate, since = self._target
        here = self._estimate.attitude(now)
        if now - since > COMMAND_TIMEOUT:
            self._text(WARNING, "target not received last 3.0 secs, stopping")
            self._target = None
        if self._target is None or here is None:
            return Velocity()
        if yaw is not None:
            yaw_rate = self._value("ATC_STR_ANG_P") * wrap(yaw - here.yaw)
        return Velocity(speed, -yaw_rate)

    def _heartbeat_now(self) -> None:
        """A change is told at once."""
        self._telemetry.hurry()

    def _value(self, name: str) -> float:
        return self._parameters[name]

    def _bit(self, name: str) -> bool:
        return bool(int(self._parameters[name]) & 1)

    def _say(self, messages: Sequence[Any]) -> None:
        """To all."""
        self._said += [Said(message) for message in messages]

    def _text(self, severity: int, text: str) -> None:
        self._say([self._d.MAVLink_statustext_message(severity, text.encode()[:50])])


_HANDLERS: Mapping[str, Callable[[Rover, Any, Time], None]] = {
    "HEARTBEAT": Rover._heartbeat,
    "COMMAND_LONG": Rover._command_long,
    "COMMAND_INT": Rover._command_int,
    "SET_MODE": Rover._set_mode,
    "REQUEST_DATA_STREAM": Rover._data_stream,
    "SET_GPS_GLOBAL_ORIGIN": Rover._origin,
    "ODOMETRY": Rover._odometry,
    "SET_POSITION_TARGET_LOCAL_NED": Rover._go,
    "MANUAL_CONTROL": Rover._manual,
    "PARAM_REQUEST_LIST": Rover._param_list,
    "PARAM_REQUEST_READ": Rover._param_read,
    "PARAM_SET": Rover._param_set,
    "TIMESYNC": Rover._timesync,
    "MISSION_REQUEST_LIST": Rover._mission_list,
    "MISSION_COUNT": Rover._mission_refused,
    "MISSION_CLEAR_ALL": Rover._mission_refused,
}
"""What it understands."""


def _whole(number: float) -> int:
    """A number of a command as an integer; -1 for what is none."""
    return round(number) if math.isfinite(number) else -1


def _sane(*numbers: float) -> bool:
    """Whether numbers are finite and not absurd."""
    return all(math.isfinite(number) and abs(number) < 1e6 for number in numbers)
