"""What is known of a vehicle, from what it says."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from maniple.core.geometry import wrap
from maniple.core.time import SECOND, Duration, Time, to_seconds
from robot_agent.drivers.mavlink.frames import Origin
from robot_agent.drivers.mavlink.ranges import Ranges

MODES = {
    0: "MANUAL", 1: "ACRO", 3: "STEERING", 4: "HOLD", 5: "LOITER", 6: "FOLLOW", 7: "SIMPLE", 8: "DOCK",
    9: "CIRCLE", 10: "AUTO", 11: "RTL", 12: "SMART_RTL", 15: "GUIDED", 16: "INITIALISING",
}  # fmt: skip
"""ArduPilot Rover's, by `custom_mode`."""
HOLD, GUIDED, INITIALISING = 4, 15, 16

MATCHED_MS = 100
"""An attitude and a position that are further apart, by the vehicle's clock, are no pair."""

TEXTS_KEPT: Duration = 35 * SECOND
"""ArduPilot says again every 30 s what keeps it from being armed."""

_ARDUPILOT, _PX4, _NO_AUTOPILOT = 3, 12, 8
_ROVER, _BOAT = 10, 11
_ARMED = 128
_PREARM = 0x10000000
_ATTITUDE, _VELOCITY, _POSITION_REL, _POSITION_ABS = 1, 2, 8, 16
_CONSTANT, _UNINITIALISED = 128, 1024
_MOST_M, _MOST_MPS, _MOST_RADPS = 1e6, 100.0, 100.0
_MOST_PARAMETERS = 100
_BACK_MS, _ON_MS, _STRANGE = 2000, 10_000, 2


class Reckoned(NamedTuple):
    """Where it is and how it moves, by its own reckoning, in its own frame."""

    at: Time
    north: float
    east: float
    v_north: float
    v_east: float
    yaw: float
    yaw_rate: float


class Clock(NamedTuple):
    """The vehicle's clock, as its attitudes tell it. A time that does not fit may be damaged; several that
    fit each other are not."""

    last_ms: int
    strange_ms: int
    strange: int


def _went_on(clock: Clock | None, time_ms: int) -> Clock:
    """The clock after the next time it told."""
    if clock is None:
        return Clock(time_ms, time_ms, 0)
    fits, again = (-_BACK_MS <= time_ms - ms <= _ON_MS for ms in (clock.last_ms, clock.strange_ms))
    if fits and not (clock.strange and abs(time_ms - clock.strange_ms) < abs(time_ms - clock.last_ms)):
        return Clock(time_ms, time_ms, 0)
    if again and clock.strange >= _STRANGE:
        return Clock(time_ms, time_ms, 0)
    return clock._replace(strange_ms=time_ms, strange=clock.strange + 1 if again else 1)


class Vehicle:
    """Everything one vehicle has said since it was connected. Absurd values are counted in `odd` and left
    out."""

    def __init__(self, dialect: Any, period: Duration, clock: Clock | None = None) -> None:
        """`period` of its scans; `clock` as it was on the connection before."""
        self._dialect = dialect
        self.ranges = Ranges(period)
        self.type: int | None = None
        self.autopilot: int | None = None
        self.mode: int | None = None
        self.armed = False
        self.beat: Time | None = None
        """When its last heartbeat arrived;"""
        self.heard: Time | None = None
        """when anything did."""
        self.reckoned: Reckoned | None = None
        """What is new since it was taken, or None."""
        self.last: Reckoned | None = None
        self.estimates = 0
        self.estimated: Time | None = None
        """EKF_STATUS_REPORT: its flags, and when it arrived."""
        self.prearm: bool | None = None
        """Whether it could be armed; None where it does not say."""
        self.origin: Origin | None = None
        self.parameters: dict[str, float] = {}
        self.version = ""
        self.fix: int | None = None
        self.satellites = 0
        self.battery = ""
        self.odd = 0
        self.restarted = False
        """Whether its clock began anew."""
        self._attitude: Any = None
        self.clock = clock
        self._texts: deque[tuple[Time, str]] = deque(maxlen=20)
        self._chunks: tuple[int, str] = (0, "")
        self._arrivals: dict[str, deque[Time]] = {}

    def take(self, message: Any, now: Time) -> None:
        """It has said something."""
        kind = message.get_type()
        self.heard = now
        self._arrivals.setdefault(kind, deque(maxlen=50)).append(now)
        if (handler := _HANDLERS.get(kind)) is not None:
            handler(self, message, now)

    @property
    def mode_name(self) -> str:
        """Its mode, for people."""
        return "unknown" if self.mode is None else MODES.get(self.mode, f"number {self.mode}")

    def foreign(self) -> str:
        """Why it is no vehicle for this driver; empty where it is."""
        if self.autopilot == _PX4:
            return (
                "it is a PX4 rover, which follows a velocity vector over MAVLink, ignores a turning rate and "
                "does not reverse; must be ArduPilot Rover"
            )
        if self.autopilot != _ARDUPILOT:
            return f"its autopilot is {self._name('MAV_AUTOPILOT', self.autopilot)}; must be ArduPilot Rover"
        if self.type not in (_ROVER, _BOAT):
            return f"it is a {self._name('MAV_TYPE', self.type)}; must be a ground rover or a boat"
        return ""

    def unlocalised(self, absolute: bool, now: Time, within: Duration) -> str:
        """Why it does not know where it is; empty where it does. `absolute`: on Earth, not only from where it
        began."""
        if self.estimated is None:
            return "it has not said how its position estimate is (EKF_STATUS_REPORT)"
        if now - self.estimated > within:
            return "it no longer says how its position estimate is (EKF_STATUS_REPORT)"
        flags = self.estimates
        missing = [
            name
            for name, wanted in (
                ("attitude", _ATTITUDE),
                ("velocity", _VELOCITY),
                ("position", _POSITION_ABS if absolute else _POSITION_REL | _POSITION_ABS),
            )
            if not flags & wanted
        ]
        if flags & _UNINITIALISED:
            missing = ["anything yet"]
        elif flags & _CONSTANT:
            missing = ["position"]
        if not missing:
            return ""
        return f"its position estimate (EKF) does not have: {', '.join(missing)}{self._satellites()}"

    def texts(self, now: Time, *words: str, within: Duration = TEXTS_KEPT) -> list[str]:
        """What it said lately with one of these words (small letters) in it, each once, the newest last."""
        kept = [text for at, text in self._texts if now - at <= within]
        return list(dict.fromkeys(text for text in kept if any(word in text.lower() for word in words)))

    def silence(self, kind: str, now: Time) -> Duration:
        """For how long it has not said one kind of message; since ever is for long."""
        arrivals = self._arrivals.get(kind)
        return now - arrivals[-1] if arrivals else now

    def rate(self, kind: str, now: Time) -> float:
        """How often a message comes, Hz, over the last 5 s."""
        recent = [at for at in self._arrivals.get(kind, ()) if now - at <= 5 * SECOND]
        if len(recent) < 2 or recent[-1] == recent[0]:
            return 0.0
        return (len(recent) - 1) / to_seconds(recent[-1] - recent[0])

    def says_no_position(self) -> str:
        """Why no position comes, as far as that can be told."""
        return f"it says no position (LOCAL_POSITION_NED){self._satellites()}"

    def _satellites(self) -> str:
        if self.fix is None:
            return ""
        return f"; GNSS: {self._name('GPS_FIX_TYPE', self.fix)}, {self.satellites} satellites"

    def _name(self, enum: str, value: int | None) -> str:
        entry = self._dialect.enums[enum].get(value)
        if entry is None:
            return f"number {value}"
        return str(entry.name).removeprefix(f"{enum}_").replace("_", " ").lower()

    def firmware(self) -> str:
        """Its type and version, for people."""
        return f"{self._name('MAV_AUTOPILOT', self.autopilot)} {self.version}".strip()

    def type_name(self) -> str:
        """What it is, for people."""
        return self._name("MAV_TYPE", self.type)

    def fix_name(self) -> str:
        """How well it sees satellites, for people."""
        if self.fix is None:
            return "not said"
        return f"{self._name('GPS_FIX_TYPE', self.fix)}, {self.satellites} satellites"

    def _heard_heartbeat(self, message: Any, now: Time) -> None:
        if message.autopilot == _NO_AUTOPILOT:
            return  # of a gimbal or the like
        self.type, self.autopilot = message.type, message.autopilot
        self.mode, self.armed = message.custom_mode, bool(message.base_mode & _ARMED)
        self.beat = now

    def _heard_attitude(self, message: Any, _now: Time) -> None:
        if not (math.isfinite(message.yaw) and abs(message.yawspeed) <= _MOST_RADPS):
            self.odd += 1
            return
        self._attitude = message
        before, self.clock = self.clock, _went_on(self.clock, message.time_boot_ms)
        self.restarted |= before is not None and self.clock.last_ms < before.last_ms - _BACK_MS

    def _heard_position(self, message: Any, now: Time) -> None:
        position = message.x, message.y
        velocity = message.vx, message.vy
        if not all(abs(value) <= _MOST_M for value in position) or not all(
            abs(value) <= _MOST_MPS for value in velocity
        ):
            self.odd += 1
            return
        attitude = self._attitude
        if attitude is None or abs(message.time_boot_ms - attitude.time_boot_ms) > MATCHED_MS:
            return
        between_s = 1e-3 * (message.time_boot_ms - attitude.time_boot_ms)
        yaw = wrap(attitude.yaw + attitude.yawspeed * between_s)
        self.last = self.reckoned = Reckoned(now, *position, *velocity, yaw, attitude.yawspeed)

    def _heard_estimates(self, message: Any, now: Time) -> None:
        self.estimates, self.estimated = message.flags, now

    def _heard_status(self, message: Any, _now: Time) -> None:
        if message.onboard_control_sensors_present & message.onboard_control_sensors_enabled & _PREARM:
            self.prearm = bool(message.onboard_control_sensors_health & _PREARM)
        else:
            self.prearm = None
        if message.voltage_battery not in (0, 65535):
            left = f", {message.battery_remaining} %" if 0 <= message.battery_remaining <= 100 else ""
            self.battery = f"{1e-3 * message.voltage_battery:.1f} V{left}"

    def _heard_origin(self, message: Any, _now: Time) -> None:
        self.origin = Origin(message.latitude, message.longitude, message.altitude)

    def _heard_parameter(self, message: Any, _now: Time) -> None:
        if not math.isfinite(message.param_value):
            self.odd += 1
        elif message.param_id in self.parameters or len(self.parameters) < _MOST_PARAMETERS:
            self.parameters[message.param_id] = message.param_value

    def _heard_version(self, message: Any, _now: Time) -> None:
        number = message.flight_sw_version
        major, minor, patch = (number >> shift & 255 for shift in (24, 16, 8))
        kind = self._dialect.enums["FIRMWARE_VERSION_TYPE"].get(number & 255)
        kind = "" if kind is None else str(kind.name).removeprefix("FIRMWARE_VERSION_TYPE_").lower()
        self.version = f"{major}.{minor}.{patch}" + (f"-{kind}" if kind not in ("", "official") else "")

    def _heard_satellites(self, message: Any, _now: Time) -> None:
        self.fix = message.fix_type
        self.satellites = message.satellites_visible if message.satellites_visible != 255 else 0

    def _heard_text(self, message: Any, now: Time) -> None:
        text = "".join(letter if letter.isprintable() else "?" for letter in message.text)
        if message.id and message.chunk_seq:
            number, before = self._chunks
            text = before + text if number == message.id else text
            if number == message.id and self._texts:
                self._texts.pop()
        self._chunks = message.id, text
        self._texts.append((now, text[:200]))

    def _heard_sector(self, message: Any, now: Time) -> None:
        self.ranges.sector(message, now)

    def _heard_fan(self, message: Any, now: Time) -> None:
        self.ranges.fan(message, self.last.yaw if self.last is not None else None, now)


_HANDLERS: Mapping[str, Callable[[Vehicle, Any, Time], None]] = {
    "HEARTBEAT": Vehicle._heard_heartbeat,
    "ATTITUDE": Vehicle._heard_attitude,
    "LOCAL_POSITION_NED": Vehicle._heard_position,
    "EKF_STATUS_REPORT": Vehicle._heard_estimates,
    "SYS_STATUS": Vehicle._heard_status,
    "GPS_GLOBAL_ORIGIN": Vehicle._heard_origin,
    "PARAM_VALUE": Vehicle._heard_parameter,
    "AUTOPILOT_VERSION": Vehicle._heard_version,
    "GPS_RAW_INT": Vehicle._heard_satellites,
    "STATUSTEXT": Vehicle._heard_text,
    "DISTANCE_SENSOR": Vehicle._heard_sector,
    "OBSTACLE_DISTANCE": Vehicle._heard_fan,
}
