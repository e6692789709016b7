"""What is said to a rover, in virtual time, against the simulator's rover."""

import math
import random
import struct
from typing import Any

import pytest

from maniple.control.limits import Velocity
from maniple.core import codec, topics
from maniple.core.errors import ManipleError
from maniple.core.messages import ExternalPose, Motion, Scan, pack_floats, unpack_floats
from maniple.core.time import MILLISECOND, SECOND, to_seconds
from maniple.transport.mavlink_framing import Framer
from robot_agent.drivers.interface import LIFE_CYCLE, Step
from robot_agent.drivers.mavlink.frames import METRES_PER_DEGREE, Origin
from robot_agent.drivers.mavlink.ranges import SECTORS
from robot_agent.drivers.mavlink.session import MISSED, SILENT, STALE, Session, Setup
from tests.robot_agent.drivers.mavlink.bench import GCS, MAV, PLACE, ROVER, SETUP, Bench, Pipe, drive

MANUAL, HOLD, GUIDED = 0, 4, 15
DO_SET_MODE, ARM_DISARM, SET_MESSAGE_INTERVAL = 176, 400, 511


def active(setup: Setup = SETUP, **fields: Any) -> Bench:
    bench = Bench(setup, **fields)
    bench.reach("active")
    return bench


def driving(u: float = 0.3, w: float = 0.0, setup: Setup = SETUP) -> Bench:
    bench = active(setup)
    bench.order = drive(u, w)
    bench.run(2.0)
    return bench


def refusing(command: int, result: int) -> Any:
    """Turns the acknowledgements of a command into refusals. Use with `Bench.between`."""

    def between(messages: list[Any]) -> list[Any]:
        for message in messages:
            if message.get_type() == "COMMAND_ACK" and message.command == command:
                message.result = result
        return messages

    return between


def commands(bench: Bench) -> list[int]:
    return [m.command for _, m in bench.log if m.get_type() == "COMMAND_LONG"]


# Up.


def test_from_nothing_to_active() -> None:
    bench = Bench()
    bench.reach("active")
    assert (bench.rover.mode, bench.rover.armed) == (GUIDED, True)
    assert bench.session.reason == ""
    bench.run(0.1)
    motion = bench.motions[-1]
    assert (motion.state, motion.controllable, motion.reason) == ("active", True, "")
    assert motion.pose == pytest.approx(bench.pose, abs=1e-4)
    assert set(bench.velocities()) <= {(0.0, 0.0)}
    assert bench.sent["HEARTBEAT"] == 0, "no controller has been heard"


def test_what_it_waits_for_is_told() -> None:
    bench, reasons = Bench(), []
    for step, before in (("connect", "closed"), ("configure", "connected"), ("activate", "configured")):
        bench.take(step)
        while bench.session.state == before:
            reasons.append(bench.session.reason)
            bench.turn()
    assert all(reasons[1:])
    told = list(dict.fromkeys(reasons))
    assert told[0] == "no heartbeat of system 1, component 1 yet"
    assert any("does not have: position; GNSS: no fix" in reason for reason in told)
    assert "waits for mode GUIDED" in told
    assert "waits for arming" in told


def test_it_moves_as_it_is_told() -> None:
    bench = driving(0.4, -0.3)
    assert bench.velocity == pytest.approx(Velocity(0.4, -0.3), abs=0.01)
    motion = bench.motions[-1]
    assert motion.twist == pytest.approx((0.4, -0.3, 0.0), abs=0.01)
    assert motion.applied == (0.4, -0.3)
    bench.order = drive(-0.2, 0.0)
    bench.run(2.0)
    assert bench.velocity.u == pytest.approx(-0.2, abs=0.01)


def test_orders_are_clipped_and_what_is_applied_is_told() -> None:
    bench = active()
    assert bench.session.write(drive(5.0, -9.0), bench.now) == Velocity(0.75, -1.7)
    assert bench.session.write(drive(0.2, 0.1, active=False), bench.now) == Velocity()


def test_nothing_is_written_before_it_is_active() -> None:
    bench = Bench()
    bench.reach("configured")
    assert bench.session.write(drive(0.5), bench.now) == Velocity()
    bench.run(0.5)
    assert bench.velocities() == []


def test_an_order_is_repeated_while_it_is_young_and_no_longer() -> None:
    bench = active()
    since = bench.now
    bench.session.write(drive(0.3), since)
    bench.flush()
    bench.run(2.0)
    said = [at - since for at, m in bench.log if m.get_type().startswith("SET_POSITION") and at >= since]
    assert said == [0, 200 * MILLISECOND]


def test_rates_that_are_asked_for_come() -> None:
    bench = active(SETUP._replace(motion_hz=100.0))
    begun, count = bench.now, len(bench.motions)
    bench.run(2.0)
    rate = (len(bench.motions) - count) / to_seconds(bench.now - begun)
    assert 30.0 <= rate <= 40.0, "ArduPilot gives no more"


def test_only_the_steps_of_the_table_are_open() -> None:
    for state in ("closed", "connected", "configured", "active"):
        for step in ("connect", "configure", "activate", "deactivate", "close"):
            bench = Bench()
            bench.reach(state)
            if (state, step) in LIFE_CYCLE:
                bench.take(step)
            else:
                with pytest.raises(ManipleError, match=f"a driver that is {state} can't {step}"):
                    bench.take(step)


# What is refused.


def test_a_vehicle_that_is_not_there_and_others_that_are() -> None:
    bench = Bench(SETUP._replace(system_id=7))
    bench.rover = Bench().rover
    bench.down = Pipe(ROVER)
    bench.take("connect")
    bench.run(3.0)
    assert bench.session.state == "closed"
    assert bench.session.reason == "no heartbeat of system 7, component 1 yet; heard: system 1"


@pytest.mark.parametrize(
    ("kind", "autopilot", "words"),
    [
        (10, 12, "it is a PX4 rover, which follows a velocity vector"),
        (2, 3, "it is a quadrotor; must be a ground rover or a boat"),
        (10, 99, "its autopilot is number 99; must be ArduPilot Rover"),
    ],
)
def test_other_vehicles_are_refused(kind: int, autopilot: int, words: str) -> None:
    bench = Bench()

    def between(messages: list[Any]) -> list[Any]:
        for message in messages:
            if message.get_type() == "HEARTBEAT":
                message.type, message.autopilot = kind, autopilot
        return messages

    bench.between = between
    bench.take("connect")
    bench.run(3.0)
    assert bench.session.state == "closed"
    assert words in bench.session.reason


def test_a_speed_limit_of_the_vehicle_below_the_models_is_refused_until_it_is_raised() -> None:
    bench = Bench()
    bench.set("WP_SPEED", 0.5)
    bench.reach("connected")
    bench.take("configure")
    bench.run(8.0)
    assert bench.session.state == "connected"
    assert "its WP_SPEED is 0.5 m/s" in bench.session.reason
    bench.set("WP_SPEED", 1.0)
    bench.until(lambda: bench.session.state == "configured")


def test_a_speed_limit_that_is_lowered_on_the_way_is_noticed() -> None:
    bench = driving()
    bench.set("WP_SPEED", 0.2)
    bench.run(1.0)
    assert not bench.motions[-1].controllable
    assert "WP_SPEED is 0.2" in bench.motions[-1].reason
    assert bench.velocities()[-1] == (0.0, 0.0)


def test_a_message_it_refuses_to_say_is_told() -> None:
    bench = Bench()
    bench.between = refusing(SET_MESSAGE_INTERVAL, 2)
    bench.reach("connected")
    bench.take("configure")
    bench.run(5.0)
    assert bench.session.state == "connected"
    assert bench.session.reason == "it refuses to say LOCAL_POSITION_NED at 20 Hz: DENIED"


def changed(command: int, **fields: float) -> Any:
    """Changes a command on its way to the vehicle. Use with `Bench.upward`."""

    def upward(messages: list[Any]) -> list[Any]:
        for message in messages:
            if message.get_type() == "COMMAND_LONG" and message.command == command:
                for name, value in fields.items():
                    setattr(message, name, value)
        return messages

    return upward


def unchanged(messages: list[Any]) -> list[Any]:
    return messages


def test_a_mode_that_is_refused_is_told_and_tried_again() -> None:
    bench = Bench()
    bench.reach("configured")
    bench.upward = changed(DO_SET_MODE, param2=99)
    bench.take("activate")
    bench.run(1.0)
    assert bench.session.reason == "it refuses mode GUIDED: FAILED (No such mode 99)"
    assert not bench.motions[-1].controllable
    bench.upward = unchanged
    bench.until(lambda: bench.session.state == "active")
    assert bench.session.reason == ""


def test_a_command_that_is_not_answered_is_told() -> None:
    bench = Bench()
    bench.reach("configured")
    bench.upward = lambda _: []
    bench.take("activate")
    bench.run(2.5)
    assert bench.session.reason == "it refuses mode GUIDED: no answer, asked 4 times"


def test_acknowledgements_that_are_lost_do_no_harm() -> None:
    """Every fourth frame of either side is lost."""
    bench = Bench()
    noise = random.Random(5)
    bench.between = bench.upward = lambda messages: [m for m in messages if noise.random() < 0.75]
    bench.reach("active")
    assert bench.rover.armed
    bench.order = drive(0.4)
    bench.run(3.0)
    assert bench.velocity.u > 0.3


def test_what_keeps_it_from_being_armed_is_told_in_its_own_words() -> None:
    bench = Bench()
    bench.reach("configured")
    bench.between = unhealthy
    bench.take("activate")
    bench.run(2.0)
    assert bench.session.state == "configured"
    assert bench.session.reason == "its pre-arm checks do not pass: Compass not calibrated"
    assert not bench.motions[-1].controllable
    assert ARM_DISARM not in commands(bench)
    bench.between = unchanged
    bench.until(lambda: bench.session.state == "active")


def unhealthy(messages: list[Any]) -> list[Any]:
    """Its compass is not calibrated."""
    for message in list(messages):
        if message.get_type() == "SYS_STATUS":
            message.onboard_control_sensors_health &= ~0x10000000
            messages.append(MAV.MAVLink_statustext_message(2, b"PreArm: Compass not calibrated"))
            messages[-1]._header = message._header
    return messages


def test_arming_that_is_refused_is_told() -> None:
    bench = Bench()
    bench.reach("configured")
    bench.upward = changed(ARM_DISARM, param1=2)
    bench.take("activate")
    bench.run(1.0)
    assert bench.session.reason == "it refuses arming: UNSUPPORTED"


def test_without_leave_it_never_arms_and_waits_for_the_pilot() -> None:
    bench = Bench(SETUP._replace(arm=False))
    bench.reach("configured")
    bench.take("activate")
    bench.run(5.0)
    assert bench.session.state == "configured"
    assert bench.session.reason == "a pilot has to arm it (mavlink.arm is false)"
    assert ARM_DISARM not in commands(bench)
    bench.pilot_arms(True)
    bench.until(lambda: bench.session.state == "active", 2.0)


def test_connected_and_configured_and_closed_it_has_never_been_touched() -> None:
    """What `driver check` does."""
    bench = Bench()
    bench.reach("configured")
    bench.run(1.0)
    bench.take("close")
    assert bench.session.state == "closed"
    assert (bench.rover.mode, bench.rover.armed) == (MANUAL, False)
    assert not {DO_SET_MODE, ARM_DISARM} & set(commands(bench))
    assert bench.velocities() == []


# Whose it is.


def test_a_pilot_takes_it_is_not_fought_and_gives_it_back() -> None:
    bench = driving()
    bench.pilot_sets(MANUAL)
    bench.until(lambda: not bench.motions[-1].controllable, 1.0)
    since = bench.now
    reason = bench.motions[-1].reason
    assert reason.startswith(
        "a pilot has taken it: mode MANUAL, armed; it has to be given back in GUIDED, armed"
    )
    bench.run(2.0)
    bench.session.stop(bench.now)
    bench.take("deactivate")
    assert bench.session.state == "configured"
    bench.run(1.0)
    for step in ("activate", "deactivate", "activate"):
        bench.take(step)
        bench.run(1.0)
    said = [m.get_type() for at, m in bench.log if at > since]
    assert set(said) <= {"HEARTBEAT"}, "that the controller lives is no command"
    assert bench.rover.mode == MANUAL
    assert bench.session.write(drive(0.5), bench.now) == Velocity()
    bench.pilot_sets(GUIDED)
    bench.until(lambda: bench.session.state == "active", 2.0)
    bench.run(2.0)
    assert bench.motions[-1].controllable
    assert bench.velocity.u == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("how", [HOLD, MANUAL, "disarmed"])
def test_what_became_of_it_while_it_had_no_driver_is_not_undone_by_the_next(how: int | str) -> None:
    bench = driving()
    if isinstance(how, int):
        bench.pilot_sets(how)
    else:
        bench.pilot_arms(False)
    bench.session = Session(MAV, SETUP, succeeds=True)
    bench.reach("configured")
    found = bench.rover.mode, bench.rover.armed
    bench.take("activate")
    bench.run(5.0)
    assert bench.session.state == "configured"
    assert not bench.motions[-1].controllable
    assert "it has to be given back in GUIDED, armed" in bench.session.reason
    assert (bench.rover.mode, bench.rover.armed) == found != (GUIDED, True)
    bench.pilot_sets(GUIDED)
    bench.pilot_arms(True)
    bench.until(lambda: bench.session.state == "active", 2.0)


def test_as_its_last_driver_left_it_the_next_one_goes_on() -> None:
    bench = driving()
    bench.session = Session(MAV, SETUP, succeeds=True)
    bench.reach("active")
    assert commands(bench).count(ARM_DISARM) == 1, "by the first one"


def test_a_pilot_disarms_it() -> None:
    bench = driving()
    bench.pilot_arms(False)
    bench.until(lambda: not bench.motions[-1].controllable, 1.0)
    assert "has disarmed it: mode GUIDED, not armed" in bench.motions[-1].reason
    bench.take("deactivate")
    bench.take("activate")
    bench.run(3.0)
    assert not bench.rover.armed, "it is not armed again against a pilot"
    bench.pilot_arms(True)
    bench.until(lambda: bench.session.state == "active", 2.0)


def test_taken_while_it_is_paused() -> None:
    bench = driving()
    bench.order = None
    bench.take("deactivate")
    bench.until(lambda: bench.session.state == "configured", 5.0)
    assert bench.rover.mode == HOLD
    bench.pilot_sets(MANUAL)
    bench.run(1.0)
    bench.take("activate")
    bench.run(2.0)
    assert bench.rover.mode == MANUAL
    assert bench.session.reason.startswith("a pilot has taken it: mode MANUAL")


def test_found_armed_in_manual_it_is_somebodys() -> None:
    bench = Bench()
    bench.run(6.0)
    bench.pilot_arms(True)
    bench.run(0.1)
    assert (bench.rover.mode, bench.rover.armed) == (MANUAL, True)
    bench.reach("configured")
    bench.take("activate")
    bench.run(2.0)
    assert bench.rover.mode == MANUAL
    assert bench.session.reason.startswith("a pilot has taken it: mode MANUAL, armed")
    bench.take("close")
    bench.run(0.5)
    assert bench.rover.armed, "nor is it disarmed on the way out"


def test_a_failsafe_is_not_fought_and_told_in_its_own_words() -> None:
    bench = driving()
    bench.pilot(MAV.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.set("FS_GCS_ENABLE", 1)
    bench.run(0.5)
    bench.upward = lambda messages: [m for m in messages if m.get_type() != "HEARTBEAT"]
    bench.until(lambda: not bench.motions[-1].controllable, 10.0)
    reason = bench.motions[-1].reason
    assert reason.startswith("a pilot or a failsafe of its own has taken it: mode HOLD, armed")
    assert "ailsafe" in reason.split("armed", 1)[1]


def test_as_a_ground_station_it_lives_while_the_controller_does() -> None:
    bench = active()
    bench.order = drive(0.2, alive=True)
    bench.run(5.0)
    beats = bench.sent["HEARTBEAT"]
    assert beats == 5
    bench.order = drive(0.2, alive=False)
    bench.run(3.0)
    assert bench.sent["HEARTBEAT"] == beats
    bench.order = None
    bench.run(3.0)
    assert bench.sent["HEARTBEAT"] == beats


# What goes wrong.


def test_silence_is_noticed_told_and_mended() -> None:
    bench = driving()
    bench.cut = True
    since = bench.now
    bench.run(to_seconds(STALE) + 0.1)
    assert bench.session.reason == "nothing is heard from it"
    count = len(bench.motions)
    assert bench.velocities(since + STALE + 50 * MILLISECOND)[-1] == (0.0, 0.0)
    bench.until(lambda: bench.session.state == "fault", to_seconds(SILENT))
    assert bench.session.reason == "nothing was heard from it for 1.5 s"
    assert len(bench.motions) == count, "what is old is not told again"
    bench.run(2.5)
    bench.take("close")
    bench.cut = False
    assert bench.session.state == "closed"
    bench.reach("active")
    bench.run(2.0)
    assert bench.motions[-1].controllable
    assert bench.velocity.u == pytest.approx(0.3, abs=0.01)


def test_taken_while_the_link_was_cut() -> None:
    bench = driving()
    bench.cut = True
    bench.until(lambda: bench.session.state == "fault")
    bench.pilot_sets(HOLD)
    bench.run(1.0)
    bench.cut = False
    bench.reach("configured")
    bench.take("activate")
    bench.run(3.0)
    assert bench.rover.mode == HOLD
    assert bench.session.reason.startswith("a pilot or a failsafe of its own has taken it: mode HOLD")


def test_started_anew_it_is_configured_anew_and_nobody_arms_it() -> None:
    bench = driving()
    bench.switch_on()
    bench.until(lambda: bench.session.state == "fault", 10.0)
    assert bench.session.reason == "it was started anew"
    bench.run(6.0)
    bench.reach("configured")
    bench.run(1.0)
    assert bench.motions[-1].pose == pytest.approx(bench.pose, abs=1e-4)
    assert bench.session.reason.startswith(
        "a pilot or a failsafe of its own has disarmed it: mode MANUAL"
    ) or (bench.session.reason.startswith("a pilot has taken it: mode MANUAL, not armed"))


def test_heartbeats_that_stay_away() -> None:
    bench = driving()
    bench.between = lambda messages: [m for m in messages if m.get_type() != "HEARTBEAT"]
    bench.until(lambda: bench.session.state == "fault", to_seconds(MISSED) + 1.0)
    assert bench.session.reason == "no heartbeat of it for 4 s"


def test_positions_that_stay_away() -> None:
    bench = driving()
    bench.between = lambda messages: [m for m in messages if m.get_type() != "LOCAL_POSITION_NED"]
    since = bench.now
    bench.run(0.7)
    assert bench.session.reason.startswith("it says no position")
    assert bench.velocities(since + STALE + 50 * MILLISECOND)[-1] == (0.0, 0.0)
    bench.until(lambda: bench.session.state == "fault", 2.0)
    assert bench.session.reason.startswith("it no longer says its LOCAL_POSITION_NED")


def test_attitudes_that_stay_away_make_no_pair() -> None:
    bench = driving()
    bench.between = lambda messages: [m for m in messages if m.get_type() != "ATTITUDE"]
    bench.run(0.2)
    count = len(bench.motions)
    bench.run(0.5)
    assert len(bench.motions) == count


def test_a_position_estimate_that_is_lost() -> None:
    bench = driving()

    def between(messages: list[Any]) -> list[Any]:
        for message in messages:
            if message.get_type() == "EKF_STATUS_REPORT":
                message.flags = 1
        return messages

    bench.between = between
    bench.run(0.5)
    assert "its position estimate (EKF) does not have: velocity, position" in bench.motions[-1].reason
    assert bench.velocities()[-1] == (0.0, 0.0)
    bench.between = unchanged
    bench.run(2.0)
    assert bench.motions[-1].controllable
    assert bench.velocity.u == pytest.approx(0.3, abs=0.01)


def test_what_does_not_move_though_it_is_told_to() -> None:
    bench = driving()
    bench.blocked, bench.velocity = True, Velocity()
    bench.until(lambda: not bench.motions[-1].controllable, 3.0)
    assert "was told to drive for 2 s and does not move" in bench.motions[-1].reason
    bench.run(0.1)
    assert bench.velocities()[-1] == (0.0, 0.0)
    bench.blocked = False
    bench.order = None
    bench.take("deactivate")
    bench.until(lambda: bench.session.state == "configured", 5.0)
    bench.take("activate")
    bench.run(3.0)
    assert bench.rover.mode == HOLD
    bench.pilot_sets(GUIDED)
    bench.until(lambda: bench.session.state == "active", 2.0)


# Down.


def test_stop_is_zero_at_once() -> None:
    bench = driving()
    bench.session.stop(bench.now)
    bench.flush()
    assert bench.velocities(bench.now) == [(0.0, 0.0)]


def test_deactivated_it_stands_before_it_holds() -> None:
    bench = driving(0.7)
    bench.order = None
    bench.take("deactivate")
    while bench.session.state == "active":
        if bench.rover.mode == HOLD:
            assert abs(bench.velocity.u) < 0.1
        bench.turn()
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, True)
    assert set(bench.velocities(bench.now - SECOND)) <= {(0.7, 0.0), (0.0, 0.0)}
    bench.take("close")
    bench.until(lambda: bench.session.state == "closed", 0.5)
    bench.run(0.1)
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, False)


def test_closed_at_full_speed_it_holds_and_is_not_disarmed() -> None:
    bench = driving(0.7)
    bench.order = None
    bench.take("close")
    bench.until(lambda: bench.session.state == "closed", 0.5)
    bench.run(0.1)
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, True)
    bench.run(3.0)
    assert bench.velocity.u == pytest.approx(0.0, abs=0.01)


def test_not_disarmed_where_that_is_not_wanted() -> None:
    bench = active(SETUP._replace(disarm=False))
    bench.run(1.0)
    bench.take("deactivate")
    bench.until(lambda: bench.session.state == "configured")
    bench.take("close")
    bench.run(0.5)
    assert bench.session.state == "closed"
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, True)


def test_an_activation_that_is_called_off_leaves_it_in_hold() -> None:
    bench = Bench(SETUP._replace(arm=False))
    bench.reach("configured")
    bench.take("activate")
    bench.run(1.0)
    assert bench.rover.mode == GUIDED
    bench.take("deactivate")
    bench.run(1.0)
    assert bench.rover.mode == HOLD
    assert bench.session.state == "configured"


def test_a_deactivation_that_is_called_off_in_time_goes_on() -> None:
    bench = driving(0.7)
    bench.take("deactivate")
    bench.turn()
    assert bench.session.state == "active"
    bench.take("activate")
    bench.run(1.0)
    assert bench.session.state == "active"
    assert bench.rover.mode == GUIDED
    assert bench.velocity.u == pytest.approx(0.7, abs=0.1)


def test_deactivated_and_activated_again_and_again() -> None:
    bench = active()
    for _ in range(5):
        bench.take("deactivate")
        bench.until(lambda: bench.session.state == "configured", 5.0)
        bench.take("activate")
        bench.until(lambda: bench.session.state == "active", 5.0)
        assert bench.session.reason == ""


# Where it is.


def test_its_own_origin_is_asked_for_and_allowed_for() -> None:
    """A vehicle that has chosen its origin by its GNSS before it was told the world's."""
    bench = Bench()
    bench.upward = lambda messages: [m for m in messages if m.get_type() != "SET_GPS_GLOBAL_ORIGIN"]
    bench.reach("configured")
    bench.run(0.5)
    assert bench.motions[-1].pose == pytest.approx(bench.pose, abs=0.02)
    last = bench.session.vehicle.last
    assert last is not None
    assert abs(last.north - bench.pose[1]) > 0.5, "in its own frame it is elsewhere"


def test_an_origin_in_another_town_is_refused() -> None:
    far = Origin.of(PLACE[0] + 1.0, PLACE[1], 0.0)
    bench = Bench(SETUP._replace(origin=far))
    bench.upward = lambda messages: [m for m in messages if m.get_type() != "SET_GPS_GLOBAL_ORIGIN"]
    bench.reach("connected")
    bench.take("configure")
    bench.run(20.0)
    assert bench.session.state == "connected"
    assert bench.session.reason == "its own origin is 111 km from mavlink.origin; must be within 5 km"


def test_without_an_origin_the_pose_is_the_vehicles_own() -> None:
    bench = Bench(SETUP._replace(origin=None))
    bench.reach("active")
    bench.run(0.5)
    assert bench.sent["SET_GPS_GLOBAL_ORIGIN"] == 0
    pose = bench.motions[-1].pose
    assert pose is not None
    assert pose[2] == pytest.approx(bench.pose[2], abs=1e-3)


def test_a_frame_of_its_own_goes_on_while_the_vehicle_does() -> None:
    """Over a link that is cut, and an origin that moves; with a vehicle started anew it begins anew."""
    bench = active(SETUP._replace(origin=None))
    bench.run(0.5)
    first = bench.motions[-1]
    bench.cut = True
    bench.until(lambda: bench.session.state == "fault")
    bench.take("close")
    bench.cut = False
    bench.reach("active")
    bench.run(0.5)
    again = bench.motions[-1]
    assert again.origin == first.origin == 0
    assert again.pose == pytest.approx(first.pose, abs=1e-3)
    assert bench.session.vehicle.origin is not None
    moved = bench.session.vehicle.origin._replace(
        latitude_e7=bench.session.vehicle.origin.latitude_e7 + 1000
    )  # 11.13 m further north
    north = 1000e-7 * METRES_PER_DEGREE

    def between(messages: list[Any]) -> list[Any]:
        for message in messages:
            if message.get_type() == "LOCAL_POSITION_NED":
                message.x -= north
        return messages

    bench.between = between
    bench.session.vehicle.origin = moved
    bench.run(0.5)
    assert bench.motions[-1].pose == pytest.approx(first.pose, abs=1e-3)
    bench.between = unchanged
    bench.switch_on()
    bench.until(lambda: bench.session.state == "fault")
    bench.run(6.0)
    bench.reach("configured")
    bench.run(0.5)
    assert bench.motions[-1].origin == 1


def test_fed_with_where_it_is() -> None:
    bench = Bench(SETUP._replace(external_pose=True))
    bench.reach("connected")
    bench.take("configure")
    bench.run(5.0)
    assert "does not have: position" in bench.session.reason
    bench.sees = True
    bench.until(lambda: bench.session.state == "configured")
    bench.reach("active")
    bench.order = drive(0.3, 0.2)
    bench.run(5.0)
    motion = bench.motions[-1]
    assert motion.controllable
    assert motion.pose == pytest.approx(bench.pose, abs=0.1)
    bench.sees = False
    bench.run(3.0)
    assert not bench.session.motion(bench.now)
    assert bench.velocities()[-1] == (0.0, 0.0) or bench.session.state == "fault"


def test_odometry_that_is_fed_says_pose_velocity_and_how_sure() -> None:
    bench = Bench(SETUP._replace(external_pose=True))
    bench.reach("connected")
    for turn in range(4):  # drives east at 1 m/s, looking north
        seen = ExternalPose(pose=(0.1 * turn, 2.0, math.pi / 2), sigma=(0.1, 0.2, 0.3))
        bench.session.see(seen, bench.now + turn * 100 * MILLISECOND)
    (message,) = Pipe(GCS).through(bench.session.outbox[-1:])
    assert (message.frame_id, message.child_frame_id) == (20, 12)
    assert (message.x, message.y) == pytest.approx((2.0, 0.3))
    assert message.q == pytest.approx([1.0, 0.0, 0.0, 0.0])
    assert (message.vx, message.vy) == pytest.approx((0.0, 1.0), abs=1e-6)
    covariance = message.pose_covariance
    assert [covariance[k] for k in (0, 6, 20)] == pytest.approx([0.04, 0.01, 0.09])
    resets = message.reset_counter
    bench.session.see(ExternalPose(pose=(9.0, 2.0, 0.0)), bench.now + 400 * MILLISECOND)
    (message,) = Pipe(GCS).through(bench.session.outbox[-1:])
    assert message.reset_counter == resets + 1
    assert (message.vx, message.vy) == (0.0, 0.0)


def test_what_its_range_finders_see() -> None:
    bench = Bench()
    directions = [math.radians(angle) for angle in range(-180, 180, 5)]
    beams = [[0.0, 0.0, direction] for direction in directions]
    around = [2.0 if abs(direction) < 0.3 else 8.0 for direction in directions]
    bench.surroundings = Scan(
        first_angle_rad=0.0, increment_rad=0.0, range_min_m=0.1, range_max_m=8.0, mount=(0.0, 0.0, 0.0),
        beams=pack_floats(beams), ranges=pack_floats(around),
    )  # fmt: skip
    bench.reach("configured")
    bench.run(2.0)
    assert bench.scans
    ranges = list(unpack_floats(bench.scans[-1].ranges))
    assert len(ranges) == SECTORS
    assert min(ranges) == pytest.approx(2.0, abs=0.02)


def test_it_says_what_it_knows() -> None:
    bench = active()
    bench.run(3.0)
    answers = bench.session.answers(bench.now)
    assert answers["firmware"].startswith("ardupilotmega 4.")
    assert (answers["vehicle"], answers["mode"], answers["armed"]) == ("ground rover", "GUIDED", "yes")
    assert answers["ekf"].startswith("good")
    assert "satellites" in answers["gps"]
    assert "V" in answers["battery"]
    assert "LOCAL_POSITION_NED 20 Hz" in answers["rates"]
    assert "WP_SPEED = " in answers["parameters"]
    assert Bench().session.answers(0) == {}


def test_every_state_has_a_reason_or_none_is_needed() -> None:
    """A motion that is not controllable says why, one that is says nothing."""
    bench = driving()
    steps: tuple[Step, ...] = ("deactivate", "activate", "deactivate")
    for step in steps:
        bench.take(step)
        bench.run(3.0)
    assert all(motion.controllable == (not motion.reason) for motion in bench.motions)


# Absurd messages.

WORDS = [
    struct.pack("<f", value) for value in (math.nan, math.inf, -math.inf, 1e30, -1e30, 1e-40, 3.0, -2.0)
] + [b"\xff" * 4, b"\x00" * 4, b"\x80\x00\x00\x80"]


def absurd(noise: random.Random, kinds: tuple[int, ...]) -> bytes:
    """A frame with a right checksum, of a kind that the session reads, that says anything."""
    number = noise.choice(kinds)
    kind = MAV.mavlink_map[number]
    size = kind.unpacker.size
    payload = b"".join(noise.choice([*WORDS, noise.randbytes(4)]) for _ in range(size // 4 + 1))[:size]
    sender = noise.choice([(ROVER, 1)] * 8 + [(ROVER, 99), (noise.randrange(256), noise.randrange(256))])
    header = struct.pack("<BBBBBBHB", len(payload), 0, 0, noise.randrange(256), *sender, number & 0xFFFF, 0)
    checksum = MAV.x25crc(header + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + header + payload + struct.pack("<H", checksum)


READ = (0, 1, 22, 24, 30, 32, 49, 77, 132, 148, 193, 253, 330)


@pytest.mark.parametrize("kinds", [READ, tuple(number for number in READ if number not in (0, 49, 193))])
def test_ten_thousand_absurd_messages_move_nothing(kinds: tuple[int, ...]) -> None:
    """Also with the vehicle's true words in between, while it drives. Without absurd heartbeats, origins and
    estimates it even goes on."""
    bench = driving(0.3, 0.1)
    noise, framer = random.Random(8), Framer(MAV)
    bench.between = lambda messages: [
        *framer.feed(b"".join(absurd(noise, kinds) for _ in range(10))),
        *messages,
    ]
    since = len(bench.motions)
    bench.run(10.0)
    assert framer.bad == 0
    assert set(bench.velocities()) <= {(0.3, 0.1), (0.0, 0.0)}
    for motion in bench.motions[since:]:
        assert motion.pose is not None
        assert all(map(math.isfinite, (*motion.pose, *motion.twist, *motion.applied)))
    for report in [*bench.motions[since:], *bench.scans]:
        name = topics.motion("r1") if isinstance(report, Motion) else topics.scan("r1")
        codec.decode(name, codec.encode(report))
    assert bench.session.answers(bench.now)["mode"]
    if kinds != READ:
        bench.between = unchanged
        bench.run(1.0)
        assert bench.session.state == "active"


def test_ten_thousand_damaged_frames_move_nothing() -> None:
    bench = driving(0.3, 0.1)
    noise, framer = random.Random(9), Framer(MAV)
    damaged = 0

    def between(messages: list[Any]) -> list[Any]:
        nonlocal damaged
        stream = bytearray()
        for message in messages:
            whole = bytes(message.get_msgbuf())
            for _ in range(30):
                frame = bytearray(whole)
                if noise.random() < 0.3:
                    del frame[noise.randrange(len(frame)) :]
                else:
                    frame[noise.randrange(1, len(frame))] ^= noise.randrange(1, 256)
                stream += frame
                damaged += 1
            stream += whole
        return framer.feed(bytes(stream))

    bench.between = between
    since = len(bench.motions)
    bench.until(lambda: damaged >= 10_000, 60.0)
    assert framer.bad > 200
    assert set(bench.velocities()) <= {(0.3, 0.1), (0.0, 0.0)}
    assert len(bench.motions) > since + 50, "what was whole still counts"
    assert bench.motions[-1].pose == pytest.approx(bench.pose, abs=0.05)
