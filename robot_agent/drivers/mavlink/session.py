"""What is said to an ArduPilot Rover, and when. Pure: messages in, messages out, time as an argument.

A vehicle has one master. Whoever changes its mode or disarms it without having been asked for by this session
has taken it: nothing that moves it is said any more until it is armed and in GUIDED again, which whoever took
it sets. A vehicle that is found armed in another mode than GUIDED or HOLD is somebody's, too. So is one that
had another driver before, unless it is found as that left it: armed, in GUIDED.
"""

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, NamedTuple

from maniple.control.limits import Velocity
from maniple.core.errors import ManipleError
from maniple.core.messages import Drive, DriverState, ExternalPose, Motion, Scan
from maniple.core.time import MILLISECOND, SECOND, Duration, Time, period, to_seconds
from robot_agent.drivers.interface import LIFE_CYCLE, Step
from robot_agent.drivers.mavlink import parameters
from robot_agent.drivers.mavlink.commands import Answer, Commands
from robot_agent.drivers.mavlink.frames import (
    FARTHEST_M,
    Origin,
    east_north,
    north_east_yaw,
    pose,
    twist,
)
from robot_agent.drivers.mavlink.vehicle import GUIDED, HOLD, INITIALISING, Vehicle

STALE: Duration = 500 * MILLISECOND
"""A position that is older is none: the vehicle is told to stand."""
SILENT: Duration = 1500 * MILLISECOND
"""A vehicle that says nothing for so long is lost, and so is one that says no position for so long."""
BEAT: Duration = SECOND
"""Between heartbeats, as ground stations send them."""
MISSED: Duration = 4 * SECOND
"""The vehicle's own come once a second; without any for so long its mode is not known."""
ESTIMATED: Duration = 2 * SECOND
"""So long its word on its position estimate holds."""
REPEAT: Duration = 200 * MILLISECOND
"""The velocity is said again after so long, as long as it holds;"""
YOUNG: Duration = 300 * MILLISECOND
"""and it holds for so long."""
ZERO_EVERY: Duration = 100 * MILLISECOND
"""How often it is told to stand while it is deactivated,"""
STAND_WITHIN: Duration = 3 * SECOND
"""for at most so long."""
DISARM_WITHIN: Duration = 400 * MILLISECOND
"""So long the answer to the last word, to disarm, is waited for."""
REFUSED: Duration = 3 * SECOND
"""A refusal is told for so long; then it may be tried again."""
MOVES_WITHIN: Duration = 2 * SECOND
"""A vehicle that is told to drive has to move after so long."""
ASKED_EVERY: Duration = SECOND
"""How often things are asked for that bear no acknowledgement,"""
ASKED_TIMES = 5
"""and how often before it is clear that there is no answer."""
MOST_HZ = 40.0
"""ArduPilot's telemetry is not faster."""

_STILL_MPS, _STILL_RADPS = 0.05, 0.05
_TOLD_MPS, _TOLD_RADPS = 0.15, 0.2
_SEEN_MPS, _SEEN_RADPS = 0.02, 0.02
_ORIGIN_M = 0.05
_PREARM_EVERY: Duration = 5 * SECOND
_POSES_KEPT: Duration = 300 * MILLISECOND
_JUMP_M, _JUMP_MPS = 1.0, 5.0
_MOST_OTHERS = 10

_HEARTBEAT, _SYS_STATUS, _GPS_RAW, _ATTITUDE, _POSITION = 0, 1, 24, 30, 32
_ORIGIN, _DISTANCE, _VERSION, _ESTIMATES = 49, 132, 148, 193
_DO_SET_MODE, _ARM_DISARM, _RUN_PREARM_CHECKS = 176, 400, 401
_SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE = 511, 512
_BODY_NED, _VELOCITY_AND_YAW_RATE = 8, 0x05E7
_LOCAL_FRD, _BODY_FRD, _MOCAP, _GOOD = 20, 12, 6, 100
_GCS, _NO_AUTOPILOT, _STATE_ACTIVE, _CUSTOM_MODE = 6, 8, 4, 1
_RANGING = frozenset({"DISTANCE_SENSOR", "OBSTACLE_DISTANCE"})


class Setup(NamedTuple):
    """What a scenario asks of a vehicle."""

    system_id: int
    component_id: int
    gcs_system_id: int
    u_max_mps: float
    w_max_radps: float
    brake_mps2: float
    arm: bool
    disarm: bool
    origin: Origin | None
    external_pose: bool
    motion_hz: float
    scan_hz: float
    ranges: bool
    """Whether its range finders are wanted."""

    @property
    def intervals(self) -> Mapping[int, float]:
        """What it is to say, Hz, by message number."""
        motion = min(self.motion_hz, MOST_HZ)
        wanted = {_POSITION: motion, _ATTITUDE: motion, _ESTIMATES: 5.0, _SYS_STATUS: 2.0, _GPS_RAW: 1.0}
        return wanted | ({_DISTANCE: min(self.scan_hz, MOST_HZ)} if self.ranges else {})


REQUIRED = {_POSITION: "LOCAL_POSITION_NED", _ATTITUDE: "ATTITUDE", _ESTIMATES: "EKF_STATUS_REPORT"}
"""Without these there is no driving."""


class Session:
    """One vehicle through all of a driver's life.

    Call `receive` with what has arrived, then `advance`; `outbox` is what has to be sent after any call.
    """

    def __init__(self, dialect: Any, setup: Setup, succeeds: bool = False) -> None:
        """`dialect`: pymavlink's module of the messages; `succeeds`: whether the vehicle had another driver
        that was lost."""
        self.state: DriverState = "closed"
        self.reason = ""
        """Why it is not where it was asked to be, or not controllable; empty where all is well."""
        self.outbox: list[Any] = []
        self._dialect, self._setup = dialect, setup
        self._needs = parameters.Needs(
            setup.u_max_mps, setup.w_max_radps, setup.brake_mps2, setup.gcs_system_id, setup.external_pose
        )
        self._step: Step | None = None
        self._step_at: Time = 0
        self._failure = ""
        self._taken = ""
        self._stuck = ""
        self._away = False
        self._succeeds = succeeds
        self._owns = False
        self._mode_asked: int | None = None
        self._confirmed = False
        self._was_armed = False
        self._refusal: tuple[Time, str] | None = None
        self._drive: tuple[Time, Drive] | None = None
        self._applied = Velocity()
        self._told_at: Time | None = None
        self._beat_at: Time | None = None
        self._still_since: Time | None = None
        self._seen: deque[tuple[Time, ExternalPose]] = deque(maxlen=100)
        self._resets = 0
        self._frames = 0
        self._reference = setup.origin
        self.vehicle = Vehicle(dialect, period(setup.scan_hz))
        self._begin(0)

    def _begin(self, now: Time) -> None:
        """A new connection: of the vehicle nothing is known but who has it."""
        self.vehicle = Vehicle(self._dialect, period(self._setup.scan_hz), self.vehicle.clock)
        self._others: set[int] = set()
        self._commands = Commands(self._dialect, (self._setup.system_id, self._setup.component_id))
        self._asked: dict[str, tuple[Time, int]] = {}
        self._begun = now
        self._at: tuple[float, float] | None = None if self._setup.origin else (0.0, 0.0)

    def take(self, step: Step, now: Time) -> None:
        """Begin a step of the life cycle; it goes on in `advance`.

        Raises:
            ManipleError: the step is not open in this state.
        """
        if step == "fail" or (self.state, step) not in LIFE_CYCLE:
            raise ManipleError(f"a driver that is {self.state} can't {step}")
        again, self._step = step == self._step, step
        if not again:
            self._step_at = now
        if step == "connect" and not again:
            self._begin(now)
        elif step == "activate" and self.state == "active":
            self._step = None if self._mode_asked != HOLD else "deactivate"
        elif step == "deactivate" and self.state == "configured":
            self._step = None
            if self._owns and not self._taken:
                self._ask_mode(HOLD)
        if step in ("deactivate", "close"):
            self._drive = self._refusal = None
        self.advance(now)

    def receive(self, messages: Iterable[Any], now: Time) -> None:
        """Take in what has arrived; what others say is not heard."""
        for message in messages:
            kind = message.get_type()
            if message.get_srcSystem() != self._setup.system_id:
                if len(self._others) < _MOST_OTHERS:
                    self._others.add(message.get_srcSystem())
            elif message.get_srcComponent() != self._setup.component_id and kind not in _RANGING:
                continue
            elif kind == "COMMAND_ACK":
                if message.target_system in (0, self._setup.gcs_system_id):
                    self._commands.answered(message, now)
            else:
                self.vehicle.take(message, now)
                if kind == "HEARTBEAT":
                    self._look_who_has_it()

    def advance(self, now: Time) -> None:
        """Say what is due, and go on with the step that is under way."""
        self._look_after(now)
        waits = ""
        if self._step is not None:
            waits = _STEPS[self._step](self, now)
        if self.state != "closed":
            self.outbox += self._commands.due(now)
        self._repeat(now)
        self._heartbeat(now)
        self.reason = self._hindrance(now) or waits

    def lost(self, why: str, now: Time) -> None:
        """The connection is gone."""
        if self.state not in ("closed", "fault"):
            self._fail(why, now)

    def write(self, drive: Drive, now: Time) -> Velocity:
        """Pass an order on; what is applied of it."""
        self._drive = now, drive
        self._tell(now)
        return self._applied

    def stop(self, now: Time) -> None:
        """Tell the vehicle to stand, unless somebody else has it."""
        self._drive = None
        self._applied = Velocity()
        if self._owns and not self._taken and self.state != "closed":
            self._say_velocity(self._applied, now)

    def see(self, seen: ExternalPose, now: Time) -> None:
        """Pass on where others see the vehicle."""
        setup = self._setup
        if not setup.external_pose or self.state == "closed":
            return
        while self._seen and now - self._seen[0][0] > _POSES_KEPT:
            self._seen.popleft()
        v_x = v_y = 0.0
        if self._seen:
            at, first = self._seen[0]
            over_s = max(to_seconds(now - at), 1e-3)
            v_x, v_y = ((seen.pose[axis] - first.pose[axis]) / over_s for axis in (0, 1))
            if math.hypot(v_x, v_y) > _JUMP_MPS and math.dist(seen.pose[:2], first.pose[:2]) > _JUMP_M:
                self._seen.clear()
                self._resets = (self._resets + 1) % 256
                v_x = v_y = 0.0
        self._seen.append((now, seen))
        north, east, yaw = north_east_yaw(*seen.pose, at=self._at or (0.0, 0.0))
        cos, sin = math.cos(yaw), math.sin(yaw)
        covariance = [0.0] * 21
        s_east, s_north, s_yaw = seen.sigma
        covariance[0], covariance[6], covariance[20] = s_north**2, s_east**2, s_yaw**2
        self.outbox.append(
            self._dialect.MAVLink_odometry_message(
                now // 1000,
                _LOCAL_FRD,
                _BODY_FRD,
                north,
                east,
                0.0,
                [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)],
                v_y * cos + v_x * sin,
                v_x * cos - v_y * sin,
                0.0,
                *[math.nan] * 3,
                covariance,
                [math.nan] + [0.0] * 20,
                self._resets,
                _MOCAP,
                _GOOD,
            )
        )

    def motion(self, now: Time) -> Motion | None:
        """Where the vehicle is, if that is new."""
        reckoned, self.vehicle.reckoned = self.vehicle.reckoned, None
        if reckoned is None or self._at is None or self.state not in ("configured", "active"):
            return None
        turning = twist(reckoned.v_north, reckoned.v_east, reckoned.yaw, reckoned.yaw_rate)
        self._look_whether_it_moves(turning, now)
        hindrance = self._hindrance(now)
        return Motion(
            ticks=(),
            applied=(self._applied.u, self._applied.w),
            state=self.state,
            controllable=not hindrance,
            reason=hindrance,
            pose=pose(reckoned.north, reckoned.east, reckoned.yaw, self._at),
            twist=turning,
            origin=self._frames,
        )

    def scan(self, now: Time) -> Scan | None:
        """What the vehicle's range finders see, if that is due."""
        wanted = self._setup.ranges and self.state in ("connected", "configured", "active")
        return self.vehicle.ranges.due(now) if wanted else None

    def answers(self, now: Time) -> dict[str, str]:
        """What the vehicle says of itself, for people."""
        vehicle = self.vehicle
        if vehicle.beat is None:
            return {}
        kinds = (*REQUIRED.values(), *sorted(_RANGING))
        rates = {kind: rate for kind in kinds if (rate := vehicle.rate(kind, now))}
        read = {name: vehicle.parameters[name] for name in self._needs.names if name in vehicle.parameters}
        prearm = "passed" if vehicle.prearm else "not said" if vehicle.prearm is None else self._prearm(now)
        found = {
            "firmware": vehicle.firmware(),
            "vehicle": vehicle.type_name(),
            "mode": vehicle.mode_name,
            "armed": "yes" if vehicle.armed else "no",
            "pre-arm checks": prearm,
            "ekf": vehicle.unlocalised(self._absolute, now, ESTIMATED)
            or f"good (flags 0x{vehicle.estimates:04x})",
            "gps": vehicle.fix_name(),
            "battery": vehicle.battery or "not said",
            "ranges": vehicle.ranges.heard(now),
            "rates": ", ".join(f"{kind} {rate:.0f} Hz" for kind, rate in rates.items()) or "none",
            "parameters": ", ".join(f"{name} = {value:g}" for name, value in read.items()) or "none read",
        }
        if vehicle.origin is not None:
            latitude, longitude, _ = vehicle.origin
            found["origin"] = f"{1e-7 * latitude:.7f}, {1e-7 * longitude:.7f}"
        for number, line in enumerate(parameters.advice(vehicle.parameters, self._needs), 1):
            found[f"advice {number}"] = line
        return found

    @property
    def _absolute(self) -> bool:
        """Whether its position has to be one on Earth."""
        return self._setup.origin is not None and not self._setup.external_pose

    # Who has the vehicle.

    def _look_who_has_it(self) -> None:
        """A heartbeat has arrived."""
        vehicle = self.vehicle
        mode, armed = vehicle.mode, vehicle.armed
        ready = mode == GUIDED and armed
        self._confirmed |= mode == GUIDED and self._mode_asked == GUIDED
        if self._taken or self._stuck:
            if not ready:
                self._away = True
            elif self._away:
                self._taken = self._stuck = ""
                self._away = False
        if not (self._taken or vehicle.foreign()):
            if (armed and mode not in (GUIDED, HOLD, INITIALISING)) or (self._confirmed and mode != GUIDED):
                self._taken = "a pilot has taken it"
                if mode == HOLD:
                    self._taken = "a pilot or a failsafe of its own has taken it"
            elif self._owns and self._was_armed and not armed:
                self._taken = "a pilot or a failsafe of its own has disarmed it"
            elif self._succeeds and not ready:
                self._taken = "its driver was lost, and a pilot or a failsafe of its own may have taken it"
            self._succeeds = False
            if self._taken:
                self._away, self._owns, self._confirmed = True, False, False
                self._mode_asked, self._applied = None, Velocity()
        self._was_armed = armed

    def _ask_mode(self, mode: int) -> Answer | None:
        """Have the vehicle change its mode."""
        if mode != self._mode_asked:
            for other in (GUIDED, HOLD):
                self._commands.forget(("mode", other), _DO_SET_MODE)
            self._mode_asked, self._confirmed = mode, False
        return self._commands.ask(("mode", mode), _DO_SET_MODE, _CUSTOM_MODE, mode)

    def _look_whether_it_moves(self, turning: tuple[float, float, float], now: Time) -> None:
        """What is told to drive has to."""
        u, w, v = turning
        told = abs(self._applied.u) > _TOLD_MPS or abs(self._applied.w) > _TOLD_RADPS
        if not told or math.hypot(u, v) > _SEEN_MPS or abs(w) > _SEEN_RADPS:
            self._still_since = None
            return
        if self._still_since is None:
            self._still_since = now
        elif now - self._still_since > MOVES_WITHIN and not self._stuck:
            self._stuck = (
                f"it was told to drive for {to_seconds(MOVES_WITHIN):g} s and does not move (a safety "
                "switch, its motors); it has to be put into HOLD and back into GUIDED, armed"
            )
            self._away, self._still_since = False, None

    # What hinders.

    def _hindrance(self, now: Time) -> str:
        """Why the vehicle is not controllable; empty where it is. Before it is configured that is what is
        waited for."""
        if self.state == "fault":
            return self._failure
        if self.state == "closed":
            return "" if self._step is None else self._unheard()
        vehicle = self.vehicle
        assert vehicle.heard is not None, "connected"
        if self._taken:
            armed = "armed" if vehicle.armed else "not armed"
            said = vehicle.texts(now, "failsafe", "crash")
            why = f" ({'; '.join(said)})" if said else ""
            now_in = f"mode {vehicle.mode_name}, {armed}{why}"
            return f"{self._taken}: {now_in}; it has to be given back in GUIDED, armed"
        if self._stuck:
            return self._stuck
        if now - vehicle.heard > STALE:
            return "nothing is heard from it"
        if refused := parameters.refused(vehicle.parameters, self._needs):
            return refused
        if self.state == "connected":
            return ""
        if far := self._misplaced():
            return far
        if unlocalised := vehicle.unlocalised(self._absolute, now, ESTIMATED):
            return unlocalised
        if vehicle.last is None or now - vehicle.last.at > STALE:
            return vehicle.says_no_position()
        if self._refusal is not None and now - self._refusal[0] < REFUSED:
            return self._refusal[1]
        if not vehicle.armed:
            if not self._setup.arm:
                return "a pilot has to arm it (mavlink.arm is false)"
            if vehicle.prearm is False:
                return self._prearm(now)
        return ""

    def _unheard(self) -> str:
        """Why it is not connected."""
        vehicle = self.vehicle
        if vehicle.beat is not None:
            return vehicle.foreign()
        who = f"system {self._setup.system_id}, component {self._setup.component_id}"
        others = ", ".join(map(str, sorted(self._others)))
        return f"no heartbeat of {who} yet" + (f"; heard: system {others}" if others else "")

    def _prearm(self, now: Time) -> str:
        texts = [text.split(":", 1)[1].strip() for text in self.vehicle.texts(now, "arm:")]
        return f"its pre-arm checks do not pass: {'; '.join(texts) or 'it has not said which'}"

    def _misplaced(self) -> str:
        """Where its own origin is of no use for the world's."""
        if self._at is None:
            return "it has no origin yet (SET_GPS_GLOBAL_ORIGIN is not taken)"
        if (away := math.hypot(*self._at)) > FARTHEST_M:
            return (
                f"its own origin is {away / 1000.0:.0f} km from mavlink.origin; must be within "
                f"{FARTHEST_M / 1000.0:g} km"
            )
        return ""

    # The connection.

    def _look_after(self, now: Time) -> None:
        """Whether the vehicle is still there, and where its origin lies."""
        vehicle, setup = self.vehicle, self._setup
        if vehicle.origin is not None:
            self._reference = self._reference or vehicle.origin
            self._at = east_north(self._reference, vehicle.origin)
        if self.state in ("closed", "fault"):
            return
        assert vehicle.heard is not None, "connected"
        assert vehicle.beat is not None, "connected"
        if now - vehicle.heard > SILENT:
            self._fail(f"nothing was heard from it for {to_seconds(SILENT):g} s", now)
        elif now - vehicle.beat > MISSED:
            self._fail(f"no heartbeat of it for {to_seconds(MISSED):g} s", now)
        elif vehicle.restarted:
            self._fail("it was started anew", now)
            self._frames += setup.origin is None
            self._reference = setup.origin
        elif self.state != "connected" and now - vehicle.heard < STALE and (gone := self._gone(now)):
            self._fail(f"it no longer says {gone}", now)

    def _gone(self, now: Time) -> str:
        """What it was told to say, can say, and does not."""
        vehicle = self.vehicle
        if vehicle.silence("ATTITUDE", now) > SILENT:
            return "its ATTITUDE"
        if vehicle.silence("EKF_STATUS_REPORT", now) > ESTIMATED:
            return "its EKF_STATUS_REPORT"
        knows = not vehicle.unlocalised(self._absolute, now, ESTIMATED)
        silent = vehicle.last is None or now - vehicle.last.at > SILENT
        return "its LOCAL_POSITION_NED, with an ATTITUDE of the same time" if knows and silent else ""

    def _fail(self, why: str, now: Time) -> None:
        self.stop(now)
        self.state, self._failure, self._step = "fault", why, None

    def _due(self, what: str, every: Duration, now: Time) -> bool:
        """Whether it is time to ask for something, again."""
        at, times = self._asked.get(what, (None, 0))
        if at is not None and now - at < every:
            return False
        self._asked[what] = now, times + 1
        return True

    def _times(self, what: str) -> int:
        """How often something was asked for."""
        return self._asked.get(what, (0, 0))[1]

    # The steps. Each says what it waits for.

    def _connect(self, now: Time) -> str:
        if self._due("knock", ASKED_EVERY, now):  # the first word is ours where the vehicle can't know us
            self.outbox.append(self._request(_VERSION))
        if self.vehicle.beat is None or self.vehicle.foreign():
            return ""
        self.state, self._step = "connected", None
        return ""

    def _configure(self, now: Time) -> str:
        waits = (
            self._set_rates(now)
            or self._read_parameters(now)
            or parameters.refused(self.vehicle.parameters, self._needs)
            or self._place(now)
            or self.vehicle.unlocalised(self._absolute, now, ESTIMATED)
        )
        if not waits and (self.vehicle.last is None or now - self.vehicle.last.at > STALE):
            waits = self.vehicle.says_no_position()
        if not waits and self.vehicle.clock is not None and self.vehicle.clock.strange:
            waits = "finds out whether it was started anew"
        if not waits:
            self.state, self._step = "configured", None
        return waits

    def _set_rates(self, now: Time) -> str:
        """What it says how often, and its version."""
        if not self.vehicle.version:
            self._commands.ask("version", _REQUEST_MESSAGE, _VERSION)
        if self.vehicle.origin is None:
            self._commands.ask("origin", _REQUEST_MESSAGE, _ORIGIN)
        waits = ""
        for number, rate in self._setup.intervals.items():
            answer = self._commands.ask(("interval", number), _SET_MESSAGE_INTERVAL, number, 1e6 / rate)
            if answer is None:
                waits = waits or "sets how often it says what"
            elif number in REQUIRED and not answer.accepted:
                if now - answer.at > REFUSED:
                    self._commands.forget(("interval", number), _SET_MESSAGE_INTERVAL)
                return f"it refuses to say {REQUIRED[number]} at {rate:g} Hz: {answer.words}"
        return waits

    def _read_parameters(self, now: Time) -> str:
        """Those that matter; what is not answered it does not have."""
        vehicle = self.vehicle
        known = vehicle.parameters.keys()
        missing = [
            name for name in self._needs.names if name not in known and parameters.SAME.get(name) not in known
        ]
        missing = [name for name in missing if self._times(name) <= ASKED_TIMES]
        for name in missing:
            if self._due(name, ASKED_EVERY // 2, now) and self._times(name) <= ASKED_TIMES:
                self.outbox.append(
                    self._dialect.MAVLink_param_request_read_message(
                        self._setup.system_id, self._setup.component_id, name.encode(), -1
                    )
                )
        return "reads its parameters" if missing else ""

    def _place(self, now: Time) -> str:
        """Give it the world's origin. A vehicle that has chosen one by its GNSS keeps that; then the distance
        is known."""
        setup = self._setup
        if setup.origin is None:
            return ""
        if self._at is not None and math.hypot(*self._at) <= _ORIGIN_M:
            return ""
        if self._at is None or self._times("origin") < ASKED_TIMES:
            if self._due("origin", ASKED_EVERY, now):
                self.outbox += [
                    self._dialect.MAVLink_set_gps_global_origin_message(
                        setup.system_id, *setup.origin, now // 1000
                    ),
                    self._request(_ORIGIN),
                ]
            return self._misplaced() or "waits for its origin"
        return self._misplaced()

    def _activate(self, now: Time) -> str:
        vehicle = self.vehicle
        if self._taken or self._stuck or now - (vehicle.heard or 0) > STALE or self._misplaced():
            return ""
        if vehicle.unlocalised(self._absolute, now, ESTIMATED):
            return ""
        if vehicle.mode == GUIDED and vehicle.armed:
            self.state, self._step, self._refusal = "active", None, None
            self._owns, self._confirmed, self._mode_asked = True, True, GUIDED
            self._still_since = None
            return ""
        if vehicle.mode != GUIDED:
            self._owns = True
            return self._waits_for("mode GUIDED", ("mode", GUIDED), _DO_SET_MODE, self._ask_mode(GUIDED), now)
        if not self._setup.arm:
            return ""
        if vehicle.prearm is False:
            if self._due("prearm", _PREARM_EVERY, now):
                self._commands.forget("prearm", _RUN_PREARM_CHECKS)
                self._commands.ask("prearm", _RUN_PREARM_CHECKS)
            return ""
        self._owns = True
        answer = self._commands.ask("arm", _ARM_DISARM, 1)
        return self._waits_for("arming", "arm", _ARM_DISARM, answer, now)

    def _waits_for(self, what: str, key: Hashable, command: int, answer: Answer | None, now: Time) -> str:
        """An answer, and then the heartbeat that shows it. A refusal is told, and it is asked again only when
        that is over."""
        if answer is None:
            return f"waits for {what}"
        if answer.accepted:
            if now - answer.at > 2 * BEAT:
                self._commands.forget(key, command)
            return f"waits for its heartbeat to show {what}"
        if now - answer.at > REFUSED:
            self._commands.forget(key, command)
        texts = self.vehicle.texts(now, "arm:", "mode", within=REFUSED)
        said = f" ({'; '.join(texts)})" if texts else ""
        self._refusal = answer.at, f"it refuses {what}: {answer.words}{said}"
        return self._refusal[1]

    def _deactivate(self, now: Time) -> str:
        vehicle = self.vehicle
        if self._taken:
            self.state, self._step = "configured", None
            return ""
        if self._mode_asked != HOLD and not self._stands(now) and now - self._step_at < STAND_WITHIN:
            self._applied = Velocity()
            if self._told_at is None or now - self._told_at >= ZERO_EVERY:
                self._say_velocity(self._applied, now)
            return "lets it come to a stand"
        answer = self._ask_mode(HOLD)
        if vehicle.mode == HOLD or (answer is not None and answer.accepted):
            self.state, self._step, self._applied = "configured", None, Velocity()
            return ""
        return self._waits_for("mode HOLD", ("mode", HOLD), _DO_SET_MODE, answer, now)

    def _close(self, now: Time) -> str:
        if self.state in ("configured", "active") and self._owns and not self._taken:
            if self.state == "active":
                self.stop(now)
            if self.vehicle.mode != HOLD:
                self._ask_mode(HOLD)
            if self._setup.disarm and self.vehicle.armed and self._stands(now):
                answer = self._commands.ask("disarm", _ARM_DISARM, 0)
                self._was_armed = False  # by us
                if answer is None and now - self._step_at < DISARM_WITHIN:
                    return "waits for disarming"
            self.outbox += self._commands.due(now)
            self._owns = self._confirmed = False
            self._mode_asked = None
        self.state, self._step = "closed", None
        return ""

    def _stands(self, now: Time) -> bool:
        """Whether it is seen to."""
        last = self.vehicle.last
        if last is None or now - last.at > STALE:
            return False
        return math.hypot(last.v_north, last.v_east) < _STILL_MPS and abs(last.yaw_rate) < _STILL_RADPS

    # What it is told.

    def _tell(self, now: Time) -> None:
        """The newest order, as far as it may be followed."""
        self._applied = Velocity()
        if self.state != "active" or self._step is not None or self._taken or self._drive is None:
            return
        drive = self._drive[1]
        if drive.active and not self._hindrance(now):
            u_max, w_max = self._setup.u_max_mps, self._setup.w_max_radps
            u, w = min(max(drive.u_mps, -u_max), u_max), min(max(drive.w_radps, -w_max), w_max)
            if math.isfinite(u) and math.isfinite(w):
                self._applied = Velocity(u, w)
        self._say_velocity(self._applied, now)

    def _repeat(self, now: Time) -> None:
        """Say the velocity again, as long as it holds."""
        if self._drive is None:
            return
        if now - self._drive[0] > YOUNG:
            self._applied = Velocity()
        elif self._told_at is None or now - self._told_at >= REPEAT:
            self._tell(now)

    def _say_velocity(self, velocity: Velocity, now: Time) -> None:
        self._told_at = now
        self.outbox.append(
            self._dialect.MAVLink_set_position_target_local_ned_message(
                (now - self._begun) // MILLISECOND % 2**32,
                self._setup.system_id,
                self._setup.component_id,
                _BODY_NED,
                _VELOCITY_AND_YAW_RATE,
                *[0.0] * 3,
                velocity.u,
                *[0.0] * 5,
                0.0,
                -velocity.w,
            )
        )

    def _heartbeat(self, now: Time) -> None:
        """As a ground station, as long as the controller lives: the vehicle's own failsafe hangs on it."""
        if self._drive is None or now - self._drive[0] > YOUNG or not self._drive[1].controller_alive:
            return
        if self.state != "active" or (self._beat_at is not None and now - self._beat_at < BEAT):
            return
        self._beat_at = now
        self.outbox.append(
            self._dialect.MAVLink_heartbeat_message(_GCS, _NO_AUTOPILOT, 0, 0, _STATE_ACTIVE, 3)
        )

    def _request(self, number: int) -> Any:
        """Ask for one message, without waiting for an acknowledgement."""
        return self._dialect.MAVLink_command_long_message(
            self._setup.system_id, self._setup.component_id, _REQUEST_MESSAGE, 0, number, *[0.0] * 6
        )


_STEPS: Mapping[Step, Callable[[Session, Time], str]] = {
    "connect": Session._connect,
    "configure": Session._configure,
    "activate": Session._activate,
    "deactivate": Session._deactivate,
    "close": Session._close,
}
