import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from maniple.core.scenario.types import Circle, Mavlink, Scenario
from maniple.transport.mavlink_framing import Framer
from simulator.vehicles.rover import (
    _HANDLERS,
    ACCEPTED,
    DENIED,
    FAILED,
    GUIDED,
    HOLD,
    MANUAL,
    UNSUPPORTED,
)
from simulator.vehicles.rover_estimate import (
    ATTITUDE,
    CONST_POS_MODE,
    POS_HORIZ_ABS,
    POS_HORIZ_REL,
    UNINITIALIZED,
    VELOCITY_HORIZ,
)
from tests.simulator.vehicles.bench import BODY_VELOCITY, BOOT, SECOND, SITE, Bench, dialect, scenario_of

MakeScenario = Callable[..., Scenario]
ARM, MODE = dialect.MAV_CMD_COMPONENT_ARM_DISARM, dialect.MAV_CMD_DO_SET_MODE
INTERVAL, REQUEST = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE
PRE_ARM = dialect.MAV_SYS_STATUS_PREARM_CHECK
START = (2.0, -1.0, math.pi / 6)
ALONE = [START, (0.0, 30.0, 0.0), (0.0, 40.0, 0.0)]


@pytest.fixture
def bench(make_scenario: MakeScenario) -> Bench:
    return Bench(scenario_of(make_scenario, ALONE))


@pytest.fixture
def started(bench: Bench) -> Bench:
    bench.start()
    return bench


def driven(bench: Bench, seconds: float, u: float, yaw_rate: float = 0.0) -> list[tuple[float, float]]:
    """The true (u, w) every 10 ms while it is told to drive so at 20 Hz."""
    course = []
    for tick in range(round(seconds * 100)):
        if tick % 5 == 0:
            bench.go(u, yaw_rate)
        bench.run(0.01)
        course.append(bench.truth()[1])
    return [(speed, turn) for speed, turn in course]


def is_armed(bench: Bench) -> bool:
    return bool(bench.heard("HEARTBEAT")[-1].base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)


def test_it_says_once_a_second_what_it_is(bench: Bench) -> None:
    bench.run(5.0)
    beats = bench.heard("HEARTBEAT")
    assert len(beats) == 5
    assert {(b.type, b.autopilot, b.custom_mode) for b in beats} == {
        (dialect.MAV_TYPE_GROUND_ROVER, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, MANUAL)
    }
    assert not is_armed(bench)
    assert beats[-1].base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def test_its_filter_comes_up_step_by_step(bench: Bench) -> None:
    bench.tell(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.run(1.1)
    assert bench.command(INTERVAL, dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT, 100_000) == ACCEPTED
    bench.run(1.0)
    assert bench.heard("EKF_STATUS_REPORT")[0].flags == UNINITIALIZED
    flags = bench.heard("EKF_STATUS_REPORT")[-1].flags
    assert flags & ATTITUDE
    assert flags & CONST_POS_MODE
    assert not flags & (POS_HORIZ_REL | POS_HORIZ_ABS)
    bench.run(3.0)
    flags = bench.heard("EKF_STATUS_REPORT")[-1].flags
    assert flags & VELOCITY_HORIZ
    assert not flags & (POS_HORIZ_REL | POS_HORIZ_ABS)  # without an origin
    assert not bench.heard("LOCAL_POSITION_NED")
    bench.origin()
    bench.run(1.5)
    flags = bench.heard("EKF_STATUS_REPORT")[-1].flags
    wanted = ATTITUDE | VELOCITY_HORIZ | POS_HORIZ_REL | POS_HORIZ_ABS
    assert flags & wanted == wanted
    [told] = bench.heard("GPS_GLOBAL_ORIGIN")
    assert (told.latitude, told.longitude, told.altitude) == (473977000, 85456000, 488000)
    assert bench.heard("LOCAL_POSITION_NED")


def test_an_origin_is_taken_once_and_not_before_the_filter_is_there(bench: Bench) -> None:
    bench.origin()
    bench.run(2.0)
    assert not bench.heard("GPS_GLOBAL_ORIGIN")
    bench.origin()
    bench.run(0.1)
    assert len(bench.heard("GPS_GLOBAL_ORIGIN")) == 1
    bench.tell(dialect.MAVLink_set_gps_global_origin_message(1, 10_000_000, 10_000_000, 0))
    bench.run(0.1)
    assert len(bench.heard("GPS_GLOBAL_ORIGIN")) == 1


@pytest.mark.parametrize("place", [(0, 0), (910_000_000, 0), (1, 1_810_000_000)])
def test_no_place_on_earth_is_no_origin(bench: Bench, place: tuple[int, int]) -> None:
    bench.run(2.0)
    bench.tell(dialect.MAVLink_set_gps_global_origin_message(1, *place, 0))
    bench.run(0.1)
    assert not bench.heard("GPS_GLOBAL_ORIGIN")


def test_left_alone_it_takes_where_it_stands_as_its_origin(bench: Bench) -> None:
    bench.tell(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.run(17.0)
    [told] = bench.heard("GPS_GLOBAL_ORIGIN")
    here = bench.heard("LOCAL_POSITION_NED")[-1]
    assert (here.x, here.y) == pytest.approx((0.0, 0.0), abs=0.02)
    metres = math.radians(1e-7) * 6_378_100
    assert told.latitude - SITE[0] * 1e7 == pytest.approx(START[1] / metres, abs=1)
    assert told.longitude - SITE[1] * 1e7 == pytest.approx(
        START[0] / metres / math.cos(math.radians(SITE[0])), abs=1
    )
    where = bench.heard("GLOBAL_POSITION_INT")[-1]
    assert (where.lat, where.lon) == pytest.approx((told.latitude, told.longitude), abs=1)


def test_poses_are_north_and_east_of_the_origin_and_yaw_is_clockwise_from_north(started: Bench) -> None:
    for message in (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, dialect.MAVLINK_MSG_ID_ATTITUDE):
        assert started.command(INTERVAL, message, 20_000) == ACCEPTED
    driven(started, 4.0, 0.4, -0.3)  # to the left
    (x, y, psi), (u, w) = started.truth()
    there, looks = started.heard("LOCAL_POSITION_NED")[-1], started.heard("ATTITUDE")[-1]
    assert (there.y, there.x) == pytest.approx((x, y), abs=0.03)
    assert math.remainder(math.pi / 2 - looks.yaw - psi, 2 * math.pi) == pytest.approx(0.0, abs=0.02)
    assert (w, -looks.yawspeed) == pytest.approx((0.3, 0.3), abs=0.003)
    along = there.vx * math.cos(looks.yaw) + there.vy * math.sin(looks.yaw)
    assert (u, along) == pytest.approx((0.4, 0.4), abs=0.004)
    assert there.vx**2 + there.vy**2 == pytest.approx(0.16, abs=0.005)


def test_no_message_comes_more_often_than_at_40_hz(started: Bench) -> None:
    before = len(started.heard("ATTITUDE"))
    assert started.command(INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE, 1_000) == ACCEPTED
    started.run(2.0)
    assert len(started.heard("ATTITUDE")) - before == pytest.approx(80, abs=2)
    assert started.command(INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE, -1) == ACCEPTED
    before = len(started.heard("ATTITUDE"))
    started.run(2.0)
    assert len(started.heard("ATTITUDE")) == before


def test_each_station_has_its_own_intervals(started: Bench) -> None:
    started.tell(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), system=7)
    assert started.command(INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE, 50_000) == ACCEPTED
    mine, others = len(started.heard("ATTITUDE")), len(started.heard("ATTITUDE", 7))
    started.run(3.0)
    assert len(started.heard("ATTITUDE")) - mine == pytest.approx(60, abs=1)
    assert len(started.heard("ATTITUDE", 7)) - others == pytest.approx(3, abs=1)
    get = dialect.MAV_CMD_GET_MESSAGE_INTERVAL
    assert started.command(get, dialect.MAVLINK_MSG_ID_ATTITUDE, system=7) == ACCEPTED
    assert started.heard("MESSAGE_INTERVAL", 7)[-1].interval_us == 1_000_000


def test_a_crowd_of_strangers_does_not_silence_it_for_those_it_works_with(started: Bench) -> None:
    assert started.command(INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE, 50_000) == ACCEPTED
    for system in range(2, 200):
        beat(started, system)
        if system % 5 == 0:
            started.go(0.0, 0.0)
            started.run(0.02)
    before = len(started.heard("ATTITUDE"))
    started.run(2.0)
    assert len(started.heard("ATTITUDE")) - before == pytest.approx(40, abs=1)


def test_what_it_does_not_have_is_refused(started: Bench) -> None:
    assert started.command(INTERVAL, dialect.MAVLINK_MSG_ID_RAW_IMU, 100_000) == DENIED
    assert f"No ap_message for mavlink id ({dialect.MAVLINK_MSG_ID_RAW_IMU})" in started.texts()
    assert started.command(REQUEST, 65000) == FAILED
    assert started.command(dialect.MAV_CMD_NAV_TAKEOFF) == UNSUPPORTED
    assert started.command(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH) == FAILED
    assert started.command(dialect.MAV_CMD_MISSION_START) == FAILED
    assert started.rover.mode == GUIDED


def test_modes_are_changed_or_refused_with_the_reason(bench: Bench) -> None:
    bench.run(1.5)
    assert bench.command(MODE, 1, HOLD) == ACCEPTED
    assert bench.heard("HEARTBEAT")[-1].custom_mode == HOLD  # told at once
    assert bench.command(MODE, 0, MANUAL) == DENIED
    assert bench.command(MODE, 1, 99) == FAILED
    assert "No such mode 99" in bench.texts()
    assert bench.command(MODE, 1, 10) == FAILED
    assert "Flight mode change failed" in bench.texts()
    assert bench.command(MODE, float("nan"), float("nan")) == FAILED  # all bits of -1 are set
    assert bench.rover.mode == HOLD
    bench.tell(dialect.MAVLink_set_mode_message(1, 1, MANUAL))
    bench.run(0.1)
    assert bench.rover.mode == MANUAL
    assert bench.heard("COMMAND_ACK")[-1].command == dialect.MAVLINK_MSG_ID_SET_MODE


def test_armed_it_enters_guided_only_with_a_position(bench: Bench) -> None:
    bench.run(1.5)
    assert bench.command(ARM, 1) == ACCEPTED  # in MANUAL nobody needs a position
    assert bench.command(MODE, 1, GUIDED) == FAILED
    bench.origin()
    bench.run(3.0)
    assert bench.command(MODE, 1, GUIDED) == ACCEPTED


def test_it_is_armed_when_its_checks_pass_and_says_which_do_not(bench: Bench) -> None:
    assert bench.command(ARM, 1) == FAILED
    assert "Arm: System not initialised" in bench.texts()
    bench.run(1.5)
    assert bench.command(MODE, 1, GUIDED) == ACCEPTED
    assert bench.command(ARM, 1) == FAILED
    assert "Arm: Need Position Estimate" in bench.texts()
    bench.run(2.0)
    assert "PreArm: Need Position Estimate" in bench.texts()
    assert not bench.heard("SYS_STATUS")[-1].onboard_control_sensors_health & PRE_ARM
    bench.origin()
    bench.run(3.0)
    assert bench.heard("SYS_STATUS")[-1].onboard_control_sensors_health & PRE_ARM
    assert len(bench.heard("HOME_POSITION")) == 1
    assert bench.command(ARM, 1) == ACCEPTED
    assert is_armed(bench)
    assert bench.command(ARM, 1) == ACCEPTED  # again
    assert bench.command(ARM, 2) == UNSUPPORTED
    assert bench.command(ARM, 0) == ACCEPTED
    assert not is_armed(bench)


def test_a_speed_is_reached_as_measured(started: Bench) -> None:
    course = driven(started, 3.0, 0.5)
    speeds = [u for u, _ in course]
    t90 = next(k for k, u in enumerate(speeds) if u >= 0.45) / 100
    assert t90 == pytest.approx(0.70, abs=0.04)
    assert max(speeds[:10]) < 0.005  # the dead time
    rise = (speeds[45] - speeds[30]) / 0.15
    assert rise == pytest.approx(1.0, abs=0.1)
    assert speeds[-1] == pytest.approx(0.5, rel=0.002)
    assert max(speeds) < 0.51


@pytest.mark.parametrize("rate", [0.2, -0.2])
def test_a_turning_rate_is_reached_as_measured(started: Bench, rate: float) -> None:
    turns = [-w / rate for _, w in driven(started, 2.0, 0.5, rate)]
    t90 = next(k for k, w in enumerate(turns) if w >= 0.9) / 100
    assert t90 == pytest.approx(0.15, abs=0.04)
    assert turns[-1] == pytest.approx(1.0, rel=0.002)


def test_backwards_and_on_the_spot(started: Bench) -> None:
    assert driven(started, 3.0, -0.3)[-1] == pytest.approx((-0.3, 0.0), abs=1e-3)
    assert driven(started, 3.0, 0.0, 0.5)[-1] == pytest.approx((0.0, -0.5), abs=2e-3)


def test_speed_is_clipped_to_wp_speed(started: Bench) -> None:
    started.tell(dialect.MAVLink_param_set_message(1, 1, b"WP_SPEED", 0.25, 9))
    assert driven(started, 3.0, 0.5)[-1][0] == pytest.approx(0.25, rel=0.01)
    assert driven(started, 3.0, -0.5)[-1][0] == pytest.approx(-0.25, rel=0.01)


def test_without_a_command_it_goes_on_for_three_seconds_then_brakes(started: Bench) -> None:
    driven(started, 2.0, 0.5)
    course = []
    for _ in range(500):
        started.run(0.01)
        course.append(started.truth()[1][0])
    assert min(course[:300]) == pytest.approx(0.5, rel=0.01)
    begins = next(k for k, u in enumerate(course) if u < 0.49) / 100
    assert begins == pytest.approx(3.17, abs=0.08)
    assert course[-1] == pytest.approx(0.0, abs=1e-3)
    assert "target not received last 3.0 secs, stopping" in started.texts()


@pytest.mark.parametrize("frame", [1, 7])
def test_a_velocity_in_the_world_turns_it_there(started: Bench, frame: int) -> None:
    for _ in range(60):
        started.go(0.3, 0.0, frame=frame, mask=0xDC7)  # velocity alone, to the north
        started.run(0.1)
    (_, _, psi), (u, _) = started.truth()
    assert psi == pytest.approx(math.pi / 2, abs=0.02)
    assert u == pytest.approx(0.3, abs=0.01)


def test_a_velocity_of_the_body_without_a_rate_turns_it_too(started: Bench) -> None:
    for _ in range(10):
        started.go(0.2, 0.0, mask=0xDC7, vy=0.2)
        started.run(0.1)
    assert started.truth()[1][1] < -0.3  # to the right


@pytest.mark.parametrize(
    "spoil",
    [
        lambda bench: bench.go(0.5, 0.0, frame=0),
        lambda bench: bench.go(0.5, 0.0, mask=0x1F8),  # a position
        lambda bench: bench.go(0.5, 0.0, mask=0x007),  # an acceleration
        lambda bench: bench.go(0.5, 0.0, mask=0x1C7),  # heading and rate at once
        lambda bench: bench.go(0.5, 0.0, mask=0xFFF),  # nothing
        lambda bench: bench.go(float("nan"), 0.0),
        lambda bench: bench.go(0.5, float("inf")),
        lambda bench: bench.go(1e30, 0.0),
    ],
)
def test_what_is_no_velocity_is_dropped_in_silence(started: Bench, spoil: Callable[[Bench], None]) -> None:
    texts = started.texts()
    for _ in range(10):
        spoil(started)
        started.run(0.1)
    assert started.truth()[1] == (0.0, 0.0)
    assert started.texts() == texts


def test_velocities_count_in_guided_only_armed_only_and_with_an_origin_only(bench: Bench) -> None:
    bench.run(4.5)
    assert bench.command(MODE, 1, GUIDED) == ACCEPTED
    driven(bench, 0.5, 0.3)
    assert bench.command(ARM, 1, 2989) == ACCEPTED  # by force, without an origin
    driven(bench, 0.5, 0.3)
    assert bench.truth()[1] == (0.0, 0.0)
    bench.run(2.0)
    assert bench.rover.mode == HOLD  # no position for a second
    bench.origin()
    bench.run(0.5)
    driven(bench, 0.5, 0.3)
    assert bench.truth()[1] == (0.0, 0.0)
    assert bench.command(MODE, 1, GUIDED) == ACCEPTED
    assert driven(bench, 2.0, 0.3)[-1][0] == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("stop", [lambda b: b.command(MODE, 1, HOLD), lambda b: b.command(ARM, 0)])
def test_hold_and_disarming_stop_it(started: Bench, stop: Callable[[Bench], int]) -> None:
    driven(started, 2.0, 0.4)
    assert stop(started) == ACCEPTED
    driven(started, 2.0, 0.4)
    assert started.truth()[1] == pytest.approx((0.0, 0.0), abs=1e-3)


def test_a_pilot_takes_over_by_manual_control_and_gives_back(started: Bench) -> None:
    driven(started, 1.0, 0.3)
    assert started.command(MODE, 1, MANUAL, system=9) == ACCEPTED
    started.run(2.0)
    driven(started, 1.0, 0.3)
    assert started.truth()[1] == pytest.approx((0.0, 0.0), abs=1e-3)
    for _ in range(20):
        started.tell(dialect.MAVLink_manual_control_message(1, 0, 500, 400, 0, 0))
        started.run(0.1)
    u, w = started.truth()[1]
    assert u == pytest.approx(0.4 * 0.75, abs=0.02)
    assert w == pytest.approx(-0.5 * 1.745, abs=0.02)
    started.run(5.0)  # the sticks are let go: RC_OVERRIDE_TIME is 3 s
    assert started.truth()[1] == pytest.approx((0.0, 0.0), abs=1e-3)
    assert started.command(MODE, 1, GUIDED, system=9) == ACCEPTED
    started.run(1.0)
    assert started.truth()[1] == pytest.approx((0.0, 0.0), abs=1e-3)  # nothing left from before
    assert driven(started, 2.0, 0.3)[-1][0] == pytest.approx(0.3, abs=0.01)


def test_manual_control_of_others_is_not_obeyed(started: Bench) -> None:
    assert started.command(MODE, 1, MANUAL) == ACCEPTED
    for _ in range(10):
        started.tell(dialect.MAVLink_manual_control_message(1, 0, 0, 900, 0, 0), system=9)
        started.tell(dialect.MAVLink_manual_control_message(2, 0, 0, 900, 0, 0))
        started.tell(dialect.MAVLink_manual_control_message(1, 0, 32767, 32767, 0, 0))
        started.run(0.1)
    assert started.truth()[1] == (0.0, 0.0)


def beat(bench: Bench, system: int = 255) -> None:
    bench.tell(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), system)


def test_the_ground_station_failsafe_holds(started: Bench) -> None:
    started.tell(dialect.MAVLink_param_set_message(1, 1, b"FS_GCS_ENABLE", 1, 2))
    driven(started, 8.0, 0.2)
    assert started.rover.mode == GUIDED  # never, if none was ever seen
    for _ in range(10):
        beat(started)
        driven(started, 1.0, 0.2)
    assert started.rover.mode == GUIDED
    for _ in range(5):
        beat(started, system=8)  # another's heartbeats do not count
        driven(started, 1.0, 0.2)
    assert started.rover.mode == GUIDED  # FS_GCS_TIMEOUT 5 s and FS_TIMEOUT 1.5 s
    driven(started, 1.0, 0.2)
    assert started.rover.mode == HOLD
    assert "GCS Failsafe" in started.texts()
    assert started.heard("HEARTBEAT")[-1].system_status == dialect.MAV_STATE_CRITICAL
    started.run(2.0)
    assert started.truth()[1] == pytest.approx((0.0, 0.0), abs=1e-3)
    beat(started)
    started.run(1.0)
    assert "GCS Failsafe Cleared" in started.texts()
    assert started.rover.mode == HOLD  # it is for a ground station to change that


def test_the_failsafe_is_off_as_it_comes(started: Bench) -> None:
    beat(started)
    driven(started, 10.0, 0.1)
    assert started.rover.mode == GUIDED


def test_parameters_are_listed_read_and_set(bench: Bench) -> None:
    bench.tell(dialect.MAVLink_param_request_list_message(1, 1))
    bench.run(0.5)
    values = bench.heard("PARAM_VALUE")
    assert [v.param_index for v in values] == list(range(values[0].param_count))
    by_name = {v.param_id: v.param_value for v in values}
    assert by_name["WP_SPEED"] == 2.0
    assert by_name["MAV_GCS_SYSID"] == 255
    assert by_name["EK3_SRC1_POSXY"] == 3
    bench.tell(dialect.MAVLink_param_request_read_message(1, 1, b"FS_ACTION", -1))
    bench.tell(dialect.MAVLink_param_request_read_message(1, 1, b"NOT_THERE", -1))
    bench.tell(dialect.MAVLink_param_request_read_message(1, 1, b"", 10_000))
    bench.run(0.1)
    assert [v.param_id for v in bench.heard("PARAM_VALUE")[len(values) :]] == ["FS_ACTION"]
    for value, kept in ((0.8, 0.8), (float("nan"), 0.8), (-1.0, 0.8), (0.5, 0.5)):
        bench.tell(dialect.MAVLink_param_set_message(1, 1, b"WP_SPEED", value, 9))
        bench.run(0.1)
        assert bench.heard("PARAM_VALUE")[-1].param_value == pytest.approx(kept)


def test_enforced_it_hears_its_own_ground_station_only(started: Bench) -> None:
    assert started.command(MODE, 1, HOLD, system=77) == ACCEPTED
    started.tell(dialect.MAVLink_param_set_message(1, 1, b"MAV_OPTIONS", 1, 4))
    started.run(0.1)
    started.tell(dialect.MAVLink_command_long_message(1, 1, MODE, 0, 1, MANUAL, 0, 0, 0, 0, 0), system=77)
    started.run(0.1)
    assert started.rover.mode == HOLD
    assert started.command(MODE, 1, MANUAL) == ACCEPTED


def test_commands_for_others_are_not_its_own(bench: Bench) -> None:
    bench.run(1.5)
    for target, component in ((2, 1), (1, 154)):
        bench.tell(dialect.MAVLink_command_long_message(target, component, MODE, 0, 1, HOLD, 0, 0, 0, 0, 0))
    bench.run(0.1)
    assert bench.rover.mode == MANUAL
    assert not bench.heard("COMMAND_ACK")
    bench.tell(dialect.MAVLink_command_int_message(0, 0, 0, MODE, 0, 0, 1, HOLD, 0, 0, 0, 0, 0))
    bench.run(0.1)
    assert bench.rover.mode == HOLD


def test_small_talk(started: Bench) -> None:
    started.tell(dialect.MAVLink_timesync_message(0, 12345))
    started.tell(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    started.tell(dialect.MAVLink_request_data_stream_message(1, 1, 0, 4, 1))
    assert started.command(REQUEST, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == ACCEPTED
    assert started.command(dialect.MAV_CMD_GET_HOME_POSITION) == ACCEPTED
    started.run(3.0)
    assert started.heard("TIMESYNC")[0].ts1 == 12345
    assert started.heard("TIMESYNC")[0].tc1 == pytest.approx(started.now - BOOT, abs=5 * SECOND)
    assert started.heard("MISSION_COUNT")[0].count == 0
    assert started.heard("AUTOPILOT_VERSION")[0].flight_sw_version >> 24 == 4
    assert started.heard("HOME_POSITION")
    said = {m.get_type() for m, to in started.said if to == 255}
    assert said >= {
        *("SYS_STATUS", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "ATTITUDE", "VFR_HUD"),
        *("SYSTEM_TIME", "DISTANCE_SENSOR", "BATTERY_STATUS", "EKF_STATUS_REPORT"),
    }


def test_sectors_say_what_is_near(make_scenario: MakeScenario) -> None:
    things = [Circle(centre=(2.0, 0.0), radius_m=0.5), Circle(centre=(0.0, -3.0), radius_m=0.5)]
    poses = [(0.0, 0.0, 0.0), *ALONE[1:]]
    bench = Bench(scenario_of(make_scenario, poses, things))
    beat(bench)
    bench.run(2.0)
    newest = {m.orientation: m for m in bench.heard("DISTANCE_SENSOR")}
    assert sorted(newest) == [0, 1, 2, 6, 7]  # the laser looks ahead
    assert newest[0].current_distance == pytest.approx(150, abs=3)
    assert newest[2].current_distance == pytest.approx(250, abs=4)  # to the right
    for clear in (1, 6, 7):
        assert newest[clear].current_distance == newest[clear].max_distance == 800


def test_without_gnss_it_lives_on_external_positions(make_scenario: MakeScenario) -> None:
    link = Mavlink(connection="tcp:127.0.0.1:5799", origin=SITE, external_pose=True)
    bench = Bench(scenario_of(make_scenario, ALONE, link=link))

    def feed(bench: Bench) -> None:
        x, y, psi = bench.truth()[0]
        half = 0.5 * (math.pi / 2 - psi)
        q = [math.cos(half), 0.0, 0.0, math.sin(half)]
        nothing = [float("nan")] * 21
        bench.tell(
            dialect.MAVLink_odometry_message(
                0, 20, 12, y + 0.05, x, 0.0, q, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, nothing, nothing
            )
        )

    beat(bench)
    bench.run(3.0)
    bench.origin()
    bench.run(2.0)
    assert not bench.heard("EKF_STATUS_REPORT")[-1].flags & POS_HORIZ_REL
    assert bench.heard("GPS_RAW_INT")[-1].fix_type == 0
    assert bench.command(MODE, 1, GUIDED) == ACCEPTED
    assert bench.command(ARM, 1) == FAILED
    bench.keep = feed
    bench.run(2.0)
    assert bench.heard("EKF_STATUS_REPORT")[-1].flags & POS_HORIZ_ABS
    here = bench.heard("LOCAL_POSITION_NED")[-1]
    assert (here.x, here.y) == pytest.approx((START[1] + 0.05, START[0]), abs=1e-3)
    assert bench.command(ARM, 1) == ACCEPTED
    assert driven(bench, 2.0, 0.3)[-1][0] == pytest.approx(0.3, abs=0.01)
    bench.keep = lambda _: None
    driven(bench, 3.0, 0.3)
    assert bench.rover.mode == HOLD
    assert "EKF failsafe" in bench.texts()
    assert not bench.heard("EKF_STATUS_REPORT")[-1].flags & POS_HORIZ_REL


def test_a_body_that_is_silent_has_no_pose(started: Bench) -> None:
    said, _ = started.rover.step(started.now + 2 * SECOND, [])
    kinds = {m.get_type() for m, _ in said}
    assert not kinds & {"LOCAL_POSITION_NED", "ATTITUDE"}


def frame(kind: Any, payload: bytes, system: int) -> bytearray:
    """A MAVLink 2 frame with any payload and the right checksum."""
    head = bytes([len(payload), 0, 0, 0, system, 1]) + kind.id.to_bytes(3, "little")
    crc = dialect.x25crc(head + payload)
    crc.accumulate(bytes([kind.crc_extra]))
    return bytearray(b"\xfd" + head + payload + crc.crc.to_bytes(2, "little"))


def test_frames_with_any_content_crash_nothing_and_move_nothing(started: Bench) -> None:
    """No velocity among them: those are to move it."""
    chance = random.Random(1)
    kinds = [
        kind
        for kind in dialect.mavlink_map.values()
        if "POSITION_TARGET" not in kind.msgname and kind.unpacker.size <= 255
    ]
    understood = [kind for kind in kinds if kind.msgname in _HANDLERS]
    assert len(understood) == len(_HANDLERS) - 1
    for number in range(2000):
        kind = chance.choice(understood if number % 4 else kinds)
        sender = chance.choice([9, 0])  # not its ground station: what that says by MANUAL_CONTROL is obeyed
        payload = chance.randbytes(kind.unpacker.size).rstrip(b"\0") or b"\0"
        message = dialect.MAVLink(None).decode(frame(kind, payload, sender))
        if chance.random() < 0.8:
            message.target_system = message.target_component = message.target = 1
        started.inbox.append(message)
        if len(started.inbox) == 10:
            started.run(0.02)
            assert math.isfinite(started.order.u_mps)
            assert math.isfinite(started.order.w_radps)
    started.run(1.0)
    assert started.truth()[1] == (0.0, 0.0)
    beats = started.heard("HEARTBEAT")
    started.run(2.0)
    assert len(started.heard("HEARTBEAT")) >= len(beats) + 2


def test_ten_thousand_broken_frames_are_counted_and_move_nothing(started: Bench) -> None:
    chance = random.Random(2)
    sender = dialect.MAVLink(None, 255, 1)
    zeros = [0.0] * 8
    good = [
        bytes(message.pack(sender))
        for message in (
            dialect.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, 8, BODY_VELOCITY, 0, 0, 0, 0.5, 0.0, 0.0, 0, 0, 0, 0, 0.5
            ),
            dialect.MAVLink_command_long_message(1, 1, MODE, 0, 1, MANUAL, *zeros[:5]),
            dialect.MAVLink_command_long_message(1, 1, ARM, 0, 0, *zeros[:6]),
            dialect.MAVLink_manual_control_message(1, 0, 0, 900, 0, 0),
        )
    ]
    framer = Framer(dialect)
    for _ in range(10_000):
        data = bytearray(chance.choice(good))
        if chance.random() < 0.3:
            del data[chance.randrange(1, len(data)) :]
        else:
            for _ in range(chance.randint(1, 4)):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        if bytes(data) not in good:
            started.inbox += framer.feed(bytes(data))
    beat(started)
    started.run(0.5)
    assert framer.bad > 500  # runs of bytes
    assert started.rover.mode == GUIDED
    assert is_armed(started)
    assert started.truth()[1] == (0.0, 0.0)
    whole = good[0] * 3  # behind all of it a whole one is heard
    assert [m.get_type() for m in framer.feed(whole)][-1] == "SET_POSITION_TARGET_LOCAL_NED"
