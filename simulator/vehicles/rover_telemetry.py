"""What a presented rover says of itself, and to whom how often."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from maniple.control.returns import returns_of
from maniple.core.messages import Scan, pack_floats
from maniple.core.time import MILLISECOND, SECOND, Duration, Time
from simulator.vehicles.rover_estimate import Geo, Local

DEFAULT: Duration = SECOND
"""Between two of the messages of a stream, for those who have not asked for more."""
FASTEST: Duration = 25 * MILLISECOND
"""No message comes more often than at 40 Hz."""
SCAN_STALE: Duration = 500 * MILLISECOND
_MOST_SYSTEMS = 16
_SECTOR = math.radians(45.0)
_PROXIMITY_ID = 10
_MICROSECOND = 1000


class View(NamedTuple):
    """All that is told, as it is now."""

    now: Time
    mode: int
    """`custom_mode`."""
    autonomous: bool
    """Whether it drives by what it is told, and knows where it is."""
    armed: bool
    failsafe: bool
    ready: bool
    """Whether it could be armed, or is."""
    flags: int
    """Of EKF_STATUS_REPORT."""
    attitude: Local | None
    position: Local | None
    origin: Geo | None
    fix: Geo | None
    has_gnss: bool
    home: Geo | None
    u: float
    """The speed it has in mind, m/s."""
    u_max: float


class Telemetry:
    """Makes the messages, and keeps for every system that was heard when which is due."""

    def __init__(self, dialect: Any, boot: Time) -> None:
        self._d = d = dialect
        self._boot = boot
        self._scan: tuple[Scan, Time] | None = None
        self._heartbeat_due = boot
        self._due: dict[int, dict[int, tuple[Duration, Time]]] = {}
        self._makers: Mapping[int, Callable[[View], list[Any]]] = {
            d.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            d.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            d.MAVLINK_MSG_ID_SYSTEM_TIME: self._system_time,
            d.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw,
            d.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            d.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._quaternion,
            d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            d.MAVLINK_MSG_ID_VFR_HUD: self._hud,
            d.MAVLINK_MSG_ID_DISTANCE_SENSOR: self._distances,
            d.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery,
            d.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._ekf,
            d.MAVLINK_MSG_ID_HOME_POSITION: self._home,
            d.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._origin,
            d.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version,
            d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended,
        }
        self._streams: Mapping[int, tuple[int, ...]] = {
            d.MAV_DATA_STREAM_EXTENDED_STATUS: (d.MAVLINK_MSG_ID_SYS_STATUS, d.MAVLINK_MSG_ID_GPS_RAW_INT),
            d.MAV_DATA_STREAM_POSITION: (
                d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
                d.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            ),
            d.MAV_DATA_STREAM_EXTRA1: (d.MAVLINK_MSG_ID_ATTITUDE,),
            d.MAV_DATA_STREAM_EXTRA2: (d.MAVLINK_MSG_ID_VFR_HUD,),
            d.MAV_DATA_STREAM_EXTRA3: (
                d.MAVLINK_MSG_ID_SYSTEM_TIME,
                d.MAVLINK_MSG_ID_DISTANCE_SENSOR,
                d.MAVLINK_MSG_ID_BATTERY_STATUS,
                d.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
            ),
        }

    def see(self, scan: Scan, now: Time) -> None:
        """A scan of the body's range finder."""
        self._scan = scan, now

    def met(self, system: int, now: Time) -> None:
        """A system was heard: it is told what streams by default. Those heard last are remembered."""
        rows = self._due.pop(system, None)
        if rows is None:
            rows = {message: (DEFAULT, now) for stream in self._streams.values() for message in stream}
        self._due[system] = rows
        if len(self._due) > _MOST_SYSTEMS:
            del self._due[next(iter(self._due))]

    def hurry(self) -> None:
        """The next heartbeat is due now."""
        self._heartbeat_due = self._boot

    def knows(self, message: int) -> bool:
        """Whether there is such a message here that can be asked for."""
        return message in self._makers and message != self._d.MAVLINK_MSG_ID_HEARTBEAT

    def set_interval_us(self, system: int, message: int, interval: int, now: Time) -> None:
        """How often a system that was met is told: microseconds, 0 for the default, below 0 never."""
        rows = self._due[system]
        streamed = any(message in stream for stream in self._streams.values())
        if interval > 0 or (interval == 0 and streamed):
            rows[message] = max(interval * _MICROSECOND, FASTEST) if interval else DEFAULT, now
        else:
            rows.pop(message, None)

    def interval_us(self, system: int, message: int) -> int:
        """As it is: -1 for never, 0 where there is no such message."""
        if not self.knows(message):
            return 0
        period, _ = self._due.get(system, {}).get(message, (-_MICROSECOND, 0))
        return period // _MICROSECOND

    def set_stream(self, system: int, stream: int, rate_hz: int, now: Time) -> None:
        """What REQUEST_DATA_STREAM asks for; stream 0 is all."""
        for number, messages in self._streams.items():
            if stream in (self._d.MAV_DATA_STREAM_ALL, number):
                for message in messages:
                    interval = round(1e6 / rate_hz) if rate_hz > 0 else -1
                    self.set_interval_us(system, message, interval, now)

    def due(self, view: View) -> list[tuple[Any, int]]:
        """The messages that are due, and the system each is for; 0 for all."""
        now = view.now
        told: list[tuple[Any, int]] = []
        if now >= self._heartbeat_due:
            self._heartbeat_due = now - (now - self._boot) % SECOND + SECOND
            told += [(message, 0) for message in self._heartbeat(view)]
        made: dict[int, list[Any]] = {}
        for system, rows in self._due.items():
            for message, (period, due) in rows.items():
                if now >= due:
                    rows[message] = period, due + ((now - due) // period + 1) * period
                    if message not in made:
                        made[message] = self.made(message, view)
                    told += [(one, system) for one in made[message]]
        return told

    def made(self, message: int, view: View) -> list[Any]:
        """A message by its number; several of DISTANCE_SENSOR, none of what is not known."""
        maker = self._makers.get(message)
        return maker(view) if maker else []

    def _ms(self, now: Time) -> int:
        return (now - self._boot) // MILLISECOND % 2**32

    def _heartbeat(self, view: View) -> list[Any]:
        d = self._d
        base = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | d.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        if view.autonomous:
            base |= d.MAV_MODE_FLAG_STABILIZE_ENABLED | d.MAV_MODE_FLAG_GUIDED_ENABLED
        if view.armed:
            base |= d.MAV_MODE_FLAG_SAFETY_ARMED
        status = d.MAV_STATE_ACTIVE if view.armed else d.MAV_STATE_STANDBY
        if view.failsafe:
            status = d.MAV_STATE_CRITICAL
        elif view.attitude is None:
            status = d.MAV_STATE_CALIBRATING
        return [
            d.MAVLink_heartbeat_message(
                d.MAV_TYPE_GROUND_ROVER, d.MAV_AUTOPILOT_ARDUPILOTMEGA, base, view.mode, status, 3
            )
        ]

    def _sys_status(self, view: View) -> list[Any]:
        d = self._d
        present = (
            d.MAV_SYS_STATUS_SENSOR_3D_GYRO
            | d.MAV_SYS_STATUS_SENSOR_3D_ACCEL
            | d.MAV_SYS_STATUS_SENSOR_3D_MAG
            | d.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
            | d.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
            | d.MAV_SYS_STATUS_AHRS
            | d.MAV_SYS_STATUS_SENSOR_BATTERY
            | d.MAV_SYS_STATUS_PREARM_CHECK
        )
        source = d.MAV_SYS_STATUS_SENSOR_GPS if view.has_gnss else d.MAV_SYS_STATUS_SENSOR_VISION_POSITION
        present |= source
        enabled = present if view.armed else present & ~d.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
        health = present
        if view.attitude is None:
            health &= ~(d.MAV_SYS_STATUS_AHRS | d.MAV_SYS_STATUS_SENSOR_3D_GYRO)
        if (view.fix if view.has_gnss else view.position) is None:
            health &= ~source
        if not view.ready:
            health &= ~d.MAV_SYS_STATUS_PREARM_CHECK
        return [
            d.MAVLink_sys_status_message(present, enabled, health, 100, 12600, 100, 100, 0, 0, 0, 0, 0, 0)
        ]

    def _system_time(self, view: View) -> list[Any]:
        return [self._d.MAVLink_system_time_message(view.now // _MICROSECOND, self._ms(view.now))]

    def _gps_raw(self, view: View) -> list[Any]:
        d, unknown = self._d, 65535
        if view.fix is None:
            kind = d.GPS_FIX_TYPE_NO_FIX if view.has_gnss else d.GPS_FIX_TYPE_NO_GPS
            return [
                d.MAVLink_gps_raw_int_message(
                    view.now // _MICROSECOND, kind, 0, 0, 0, unknown, unknown, 0, 0, 0
                )
            ]
        speed = math.hypot(view.attitude.v_north, view.attitude.v_east) if view.attitude else 0.0
        course = _course(view.attitude) if view.attitude else 0
        return [
            d.MAVLink_gps_raw_int_message(
                view.now // _MICROSECOND,
                d.GPS_FIX_TYPE_RTK_FIXED,
                *view.fix,
                80,
                120,
                min(round(100 * speed), unknown - 1),
                course,
                14,
                view.fix.altitude,
                20,
                40,
                50,
                0,
                0,
            )
        ]

    def _attitude(self, view: View) -> list[Any]:
        if view.attitude is None:
            return []
        yaw, rate = view.attitude.yaw, view.attitude.yaw_rate
        return [self._d.MAVLink_attitude_message(self._ms(view.now), 0.0, 0.0, yaw, 0.0, 0.0, rate)]

    def _quaternion(self, view: View) -> list[Any]:
        if view.attitude is None:
            return []
        half, rate = 0.5 * view.attitude.yaw, view.attitude.yaw_rate
        return [
            self._d.MAVLink_attitude_quaternion_message(
                self._ms(view.now), math.cos(half), 0.0, 0.0, math.sin(half), 0.0, 0.0, rate
            )
        ]

    def _local_position(self, view: View) -> list[Any]:
        here = view.position
        if here is None:
            return []
        return [
            self._d.MAVLink_local_position_ned_message(
                self._ms(view.now), here.north, here.east, 0.0, here.v_north, here.v_east, 0.0
            )
        ]

    def _global_position(self, view: View) -> list[Any]:
        here, origin = view.position, view.origin
        if here is None or origin is None:
            return [
                self._d.MAVLink_global_position_int_message(self._ms(view.now), 0, 0, 0, 0, 0, 0, 0, 65535)
            ]
        where = origin.moved(here.north, here.east)
        above = where.altitude - view.home.altitude if view.home else 0
        return [
            self._d.MAVLink_global_position_int_message(
                self._ms(view.now),
                *where,
                above,
                _centimetres(here.v_north),
                _centimetres(here.v_east),
                0,
                _hundredths(here.yaw),
            )
        ]

    def _hud(self, view: View) -> list[Any]:
        here = view.attitude
        speed = math.hypot(here.v_north, here.v_east) if here else 0.0
        heading = _hundredths(here.yaw) // 100 if here else 0
        throttle = min(round(100.0 * abs(view.u) / view.u_max), 100)
        altitude = 1e-3 * view.origin.altitude if view.origin else 0.0
        return [self._d.MAVLink_vfr_hud_message(speed, speed, heading, throttle, altitude, 0.0)]

    def _distances(self, view: View) -> list[Any]:
        """The nearest in each sector of 45 degrees that the range finder looks into."""
        if self._scan is None or view.now - self._scan[1] > SCAN_STALE:
            return []
        scan = self._scan[0]
        most = min(round(100.0 * scan.range_max_m), 65535)
        least = min(round(100.0 * scan.range_min_m), most)
        nearest = dict.fromkeys(_sectors_of(scan), float(most))
        returns = returns_of(scan)
        for distance, bearing in zip(returns.distance.tolist(), returns.bearing.tolist(), strict=True):
            sector = _sector(bearing)
            nearest[sector] = min(nearest.get(sector, math.inf), 100.0 * distance)
        d = self._d
        return [
            d.MAVLink_distance_sensor_message(
                self._ms(view.now),
                least,
                most,
                min(int(nearest[sector]), most),
                d.MAV_DISTANCE_SENSOR_LASER,
                _PROXIMITY_ID + sector,
                sector,
                255,
                _SECTOR,
                0.0,
            )
            for sector in sorted(nearest)
        ]

    def _battery(self, _: View) -> list[Any]:
        d = self._d
        cells = [12600, *[65535] * 9]
        kind = d.MAV_BATTERY_FUNCTION_ALL, d.MAV_BATTERY_TYPE_LIPO
        return [d.MAVLink_battery_status_message(0, *kind, 32767, cells, 100, 0, -1, 100)]

    def _ekf(self, view: View) -> list[Any]:
        return [self._d.MAVLink_ekf_status_report_message(view.flags, 0.05, 0.05, 0.05, 0.05, 0.0, 0.0)]

    def _home(self, view: View) -> list[Any]:
        if view.home is None:
            return []
        rest = [0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0]
        return [self._d.MAVLink_home_position_message(*view.home, *rest, view.now // _MICROSECOND)]

    def _origin(self, view: View) -> list[Any]:
        if view.origin is None:
            return []
        return [self._d.MAVLink_gps_global_origin_message(*view.origin, view.now // _MICROSECOND)]

    def _version(self, _: View) -> list[Any]:
        d = self._d
        able = (
            d.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
            | d.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | d.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
            | d.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        )
        release = 4 << 24 | 7 << 16  # 4.7.0-dev
        name = list(b"presents")
        return [d.MAVLink_autopilot_version_message(able, release, 0, 0, 0, name, name, name, 0, 0, 0)]

    def _extended(self, _: View) -> list[Any]:
        d = self._d
        return [
            d.MAVLink_extended_sys_state_message(d.MAV_VTOL_STATE_UNDEFINED, d.MAV_LANDED_STATE_ON_GROUND)
        ]


def _sector(bearing: float) -> int:
    """The sector of a bearing (rad, counter-clockwise): 0 ahead, 1 ahead on the right, ... clockwise."""
    return round(-bearing / _SECTOR) % 8


def _sectors_of(scan: Scan) -> set[int]:
    """The sectors that some beam looks into: those of returns on all beams."""
    far = np.full(len(scan.ranges) // 4, 0.9 * scan.range_max_m)
    return {_sector(b) for b in returns_of(replace(scan, ranges=pack_floats(far))).bearing.tolist()}


def _course(here: Local) -> int:
    """Direction of motion, 1/100 degrees in [0, 36000)."""
    return _hundredths(math.atan2(here.v_east, here.v_north))


def _hundredths(angle: float) -> int:
    return round(math.degrees(angle) * 100.0) % 36000


def _centimetres(speed: float) -> int:
    return min(max(round(100.0 * speed), -32767), 32767)
