import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace

from maniple.cli.loading import robot_models
from maniple.control.builtin import BUILTIN
from maniple.control.geofence import fence_of, seen_from
from maniple.control.limits import Velocity, limits_of
from maniple.control.returns import returns_of
from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.errors import ScenarioError
from maniple.core.geometry import Pose
from maniple.core.layers import Layer
from maniple.core.messages import (
    Command,
    Counters,
    Drive,
    DriverState,
    Motion,
    Odometry,
    Refused,
    Scan,
    Stamp,
    Status,
    Truth,
    pack_floats,
    unpack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.parse import short_digest
from maniple.core.scenario.types import (
    Avoidance,
    Circle,
    Compensation,
    Guard,
    Placement,
    Preflight,
    Rates,
    Robot,
    Scenario,
    World,
)
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.host.virtual import VirtualHost
from robot_agent.node import DRIVE, STATUS, RobotAgent
from simulator.node import Simulator

T0 = 1000 * SECOND
TICK = 50 * MILLISECOND
PER_METRE = 78414 / (2 * math.pi * 0.0975)
T = TypeVar("T")
Make = Callable[..., Scenario]
CommandFrom = Callable[..., Received]


def motion(
    stamp: int,
    ticks: tuple[int, int] = (0, 0),
    state: DriverState = "active",
    incarnation: int = 1,
    controllable: bool = True,
) -> Received:
    message = Motion(
        source="simulator",
        incarnation=incarnation,
        stamp_ns=stamp,
        ticks=ticks,
        applied=(0.0, 0.0),
        state=state,
        controllable=controllable,
    )
    return Received(topics.motion("r1"), message)


def scan(distance: float) -> Received:
    message = Scan(
        source="simulator",
        first_angle_rad=-math.pi / 2,
        increment_rad=math.pi / 180,
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.018, 0.0, 0.0),
        ranges=pack_floats([8.0] * 90 + [distance] + [8.0] * 90),
    )
    return Received(topics.scan("r1"), message)


def drive_of(agent: RobotAgent, now: int) -> Drive:
    ((topic, drive),) = agent.on_timer(DRIVE, now)
    assert topic == "hw/r1/drive"
    assert isinstance(drive, Drive)
    return drive


def status_of(agent: RobotAgent, now: int) -> Status:
    return only(Status, agent.on_timer(STATUS, now))


def only(kind: type[T], outgoing: Sequence[Outgoing]) -> T:
    ((_, message),) = outgoing
    assert isinstance(message, kind)
    return message


def run(
    agent: RobotAgent, command_from: CommandFrom, values: tuple[float, float], start: int, n: int
) -> Drive:
    """n ticks with a driver that reports and a command that answers the newest odometry; the last drive."""
    for k in range(n):
        now = start + k * TICK
        agent.on_message(motion(now), now)
        agent.on_message(command_from(now, values), now)
        drive = drive_of(agent, now)
    return drive


def test_what_it_listens_to_and_when_it_acts(make_scenario: Make) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    assert agent.name == "r1"
    assert agent.subscriptions == {
        "hw/r1/motion",
        "hw/r1/scan",
        "robot/r1/command",
        "robot/r1/odometry",
        "platoon/stop",
        "host/alive",
        "host/refused",
        "host/counters",
    }
    assert agent.timers == {DRIVE: 50 * MILLISECOND, STATUS: 500 * MILLISECOND}
    with pytest.raises(ScenarioError, match="no 'r9'; there are r1"):
        RobotAgent(make_scenario(), "r9")


def test_begins_and_ends_standing(make_scenario: Make) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    begun = only(Status, agent.on_start(T0))
    assert (begun.mode, begun.driver, begun.command_age_s) == ("waiting", "closed", -1.0)
    assert begun.reason == "no word from the drive yet"
    assert drive_of(agent, T0) == Drive(u_mps=0.0, w_radps=0.0, active=True)
    (_, drive), (_, status) = agent.on_stop(T0)
    assert drive == Drive(u_mps=0.0, w_radps=0.0, active=False)
    assert isinstance(status, Status)
    assert (status.mode, status.reason) == ("stopped", "told to stop")


def test_odometry_at_once_from_encoder_counts(make_scenario: Make) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    agent.on_message(motion(T0, (7000, 7000)), T0)
    forward, turn = 0.01, 0.02
    wheels = [7000 + round((forward + side * 0.165 * turn) * PER_METRE) for side in (-1, 1)]
    ((topic, odometry),) = agent.on_message(motion(T0 + TICK, (wheels[0], wheels[1])), T0 + TICK)
    assert topic == "robot/r1/odometry"
    assert isinstance(odometry, Odometry)
    expected = Pose(0, 0, 0).advance(forward, turn)
    assert odometry.frame_id == "r1"
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == pytest.approx(expected, abs=1e-4)
    assert (odometry.u_mps, odometry.w_radps) == pytest.approx((0.2, 0.4), abs=1e-3)
    assert odometry.applied is None


@pytest.mark.parametrize(
    ("reports", "jumps"),
    [
        ([motion(T0 + TICK, (-900_000, 0)), motion(T0 + 2 * TICK, (-900_000, 0))], 1),
        ([motion(T0 + TICK, (-900_000, 0), incarnation=2)], 0),
        ([motion(T0 + TICK, (0, 0), "connected"), motion(T0 + 2 * TICK, (90_000, 0), "configured")], 0),
    ],
)
def test_encoders_that_restart_move_nothing(make_scenario: Make, reports: list[Received], jumps: int) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    agent.on_message(motion(T0, (0, 0)), T0)
    for k, report in enumerate(reports, start=1):
        odometry = only(Odometry, agent.on_message(report, T0 + k * TICK))
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad, odometry.u_mps) == (0.0, 0.0, 0.0, 0.0)
    assert status_of(agent, T0 + SECOND).counters.get("encoder_jumps", 0) == jumps


def test_passes_scans_on_as_they_are(make_scenario: Make) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    seen = scan(1.0)
    assert agent.on_message(seen, T0) == (Outgoing("robot/r1/ranges", seen.message),)
    assert isinstance(seen.message, Scan)
    assert returns_of(seen.message).distance == pytest.approx([1.018])


def test_tracks_a_fresh_command_within_its_limits_and_says_which(
    make_scenario: Make, command_from: CommandFrom
) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    first = run(agent, command_from, (0.1, 0.0), T0, 2)
    assert (first.u_mps, first.w_radps) == pytest.approx((0.3 * 0.05, 0.0))
    assert first.active
    drive = run(agent, command_from, (0.1, 0.03), T0 + 2 * TICK, 30)
    assert (drive.u_mps, drive.w_radps) == pytest.approx((0.1, 0.03 / 0.3))
    now = T0 + 31 * TICK
    status = status_of(agent, now)
    assert (status.mode, status.guard, status.reason, status.driver) == ("tracking", "none", "", "active")
    odometry = only(Odometry, agent.on_message(motion(now), now))
    assert odometry.applied == Stamp(1, 0, now)


@pytest.mark.parametrize("layer", ["drive", "compensation", "avoidance"])
def test_behind_the_kinematics_values_are_speeds(
    make_scenario: Make, command_from: CommandFrom, layer: Layer
) -> None:
    agent = RobotAgent(make_scenario(placement=Placement(robot_from=layer)), "r1")
    for k in range(30):
        now = T0 + k * TICK
        agent.on_message(motion(now), now)
        agent.on_message(command_from(now, (0.1, 0.2), layer=layer), now)
        drive = drive_of(agent, now)
    assert (drive.u_mps, drive.w_radps) == pytest.approx((0.1, 0.2))


def test_refuses_commands_for_others_and_counts_what_the_host_refused(
    make_scenario: Make, command_from: CommandFrom
) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    agent.on_message(motion(T0), T0)
    agent.on_message(motion(T0, (1, 2, 3)), T0)  # type: ignore[arg-type]
    agent.on_message(command_from(T0, (0.1, 0.0), layer="drive"), T0)
    agent.on_message(command_from(T0, (0.1, 0.0), incarnation=2), T0)
    refused = Refused(topic="robot/r1/command", sender="x", reason="sender", count=3)
    agent.on_message(Received(topics.HOST_REFUSED, refused), T0)
    agent.on_message(Received(topics.HOST_COUNTERS, Counters(counters={"received": 12})), T0)
    drive_of(agent, T0)
    status = status_of(agent, T0)
    assert (status.mode, status.command_age_s, status.reason) == ("waiting", -1.0, "no command yet")
    assert status.counters == {
        "received": 12,
        "refused_layer": 1,
        "refused_ticks": 1,
        "refused_incarnation": 1,
        "refused_sender": 3,
    }


def last_word(**changes: Any) -> Received:
    """What the first life of r1 said last."""
    fields = {
        "source": "r1",
        "incarnation": 1,
        "seq": 99,
        "stamp_ns": T0 - SECOND,
        "frame_id": "r1",
        "x_m": 1.0,
        "y_m": -2.0,
        "psi_rad": 0.5,
        "u_mps": 0.1,
        "w_radps": 0.0,
        "ticks": (1000, 2000),
        "motion_incarnation": 1,
    }
    return Received(topics.odometry("r1"), Odometry(**{**fields, **changes}))


def ticks_after(forward: float, turn: float) -> tuple[int, int]:
    """Counts after an arc from where `last_word` was said."""
    left, right = (round((forward + side * 0.165 * turn) * PER_METRE) for side in (-1, 1))
    return 1000 + left, 2000 + right


@pytest.mark.parametrize("heard_first", [True, False])
def test_a_later_life_resumes_the_frame_and_knows_how_far_it_rolled_meanwhile(
    make_scenario: Make, command_from: CommandFrom, heard_first: bool
) -> None:
    agent = RobotAgent(make_scenario(), "r1", incarnation=2)
    assert not only(Status, agent.on_start(T0)).localised
    counted = motion(T0 + TICK, ticks_after(0.06, 0.1))
    first, second = (last_word(), counted) if heard_first else (counted, last_word())
    early = agent.on_message(first, T0 + TICK)
    if not heard_first:
        assert only(Odometry, early).frame_id == "r1/2"
        assert "odometry frame" in status_of(agent, T0 + TICK).reason
    status = agent.on_message(second, T0 + TICK)[0].message
    assert isinstance(status, Status)
    assert status.localised
    odometry = only(Odometry, agent.on_message(motion(T0 + 2 * TICK, ticks_after(0.06, 0.1)), T0 + 2 * TICK))
    assert odometry.frame_id == "r1"
    expected = Pose(1.0, -2.0, 0.5).advance(0.06, 0.1)
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == pytest.approx(expected, abs=1e-4)
    assert (odometry.ticks, odometry.motion_incarnation) == (ticks_after(0.06, 0.1), 1)
    agent.on_message(last_word(x_m=7.0), T0 + 2 * TICK)  # too late: it knows
    again = only(Odometry, agent.on_message(motion(T0 + 3 * TICK, ticks_after(0.06, 0.1)), T0 + 3 * TICK))
    assert again.x_m == odometry.x_m


def test_a_later_life_that_moved_before_it_heard_puts_both_ways_together(make_scenario: Make) -> None:
    agent = RobotAgent(make_scenario(), "r1", incarnation=2)
    agent.on_message(motion(T0, ticks_after(0.06, 0.1)), T0)
    agent.on_message(motion(T0 + TICK, ticks_after(0.08, 0.1)), T0 + TICK)
    agent.on_message(last_word(), T0 + TICK)
    odometry = only(Odometry, agent.on_message(motion(T0 + 2 * TICK, ticks_after(0.08, 0.1)), T0 + 2 * TICK))
    expected = Pose(1.0, -2.0, 0.5).advance(0.06, 0.1).advance(0.02, 0.0)
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    "changes", [{"motion_incarnation": 7}, {"ticks": ()}, {"ticks": (10**9, 10**9)}], ids=str
)
def test_where_the_counts_began_anew_it_stayed_where_it_was(
    make_scenario: Make, changes: dict[str, Any]
) -> None:
    agent = RobotAgent(make_scenario(), "r1", incarnation=3)
    agent.on_message(last_word(**changes), T0)
    _, (_, odometry) = agent.on_message(motion(T0, (5, 6)), T0)
    assert isinstance(odometry, Odometry)
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == (1.0, -2.0, 0.5)


@pytest.mark.parametrize("changes", [{"incarnation": 2}, {"frame_id": "r1/1"}], ids=str)
def test_it_resumes_no_frame_that_was_lost_and_takes_no_command_until_it_knows(
    make_scenario: Make, command_from: CommandFrom, changes: dict[str, Any]
) -> None:
    agent = RobotAgent(make_scenario(), "r1", incarnation=2)
    agent.on_message(motion(T0), T0)
    agent.on_message(last_word(**changes), T0)
    agent.on_message(command_from(T0, (0.1, 0.0), incarnation=2), T0)
    drive_of(agent, T0)
    status = status_of(agent, T0)
    assert (status.localised, status.mode, status.command_age_s) == (False, "waiting", -1.0)
    agent.on_message(last_word(), T0 + 2)
    agent.on_message(command_from(T0 + 1, (0.1, 0.0), incarnation=2), T0 + 2)  # computed in another frame
    agent.on_message(command_from(T0 + 2, (0.1, 0.0), incarnation=2, seq=1), T0 + 2)
    counters = status_of(agent, T0 + 2).counters
    assert (counters["refused_unlocalised"], counters["refused_earlier"]) == (1, 1)
    assert status_of(agent, T0 + 2).command_age_s == 0.0


def test_holds_and_then_stands_as_the_command_ages(make_scenario: Make, command_from: CommandFrom) -> None:
    agent = RobotAgent(make_scenario(), "r1")  # slows from 0.5 s on, stands at 1 s
    run(agent, command_from, (0.1, 0.0), T0, 20)
    last = T0 + 19 * TICK
    speeds = []
    for k in range(1, 41):
        now = last + k * TICK
        agent.on_message(motion(now), now)
        speeds.append(drive_of(agent, now).u_mps)
    assert speeds[:10] == pytest.approx([0.1] * 10)
    assert speeds[14] == pytest.approx(0.05)
    assert speeds[19:] == [0.0] * 21
    status = status_of(agent, now)
    assert (status.mode, status.guard) == ("holding", "age")
    assert (status.command_age_s, status.command_age_max_s) == (2.0, 2.0)
    assert status.reason == "the command is 2.0 s old"
    run(agent, command_from, (0.1, 0.0), now + TICK, 1)
    status = status_of(agent, now + TICK)
    assert (status.mode, status.command_age_s, status.command_age_max_s) == ("tracking", 0.0, 0.0)


def test_the_controllers_own_old_inputs_count(make_scenario: Make, command_from: CommandFrom) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    agent.on_message(motion(T0), T0)
    agent.on_message(command_from(T0, (0.1, 0.0), inputs_age=SECOND), T0)
    drive_of(agent, T0)
    assert drive_of(agent, T0 + TICK).u_mps == 0.0
    assert status_of(agent, T0 + TICK).command_age_s == 1.05


def test_a_drive_that_falls_silent_is_a_fault(make_scenario: Make, command_from: CommandFrom) -> None:
    agent = RobotAgent(make_scenario(guard=Guard(clearance=False, hold_after_s=9.0, stop_after_s=10.0)), "r1")
    run(agent, command_from, (0.1, 0.0), T0, 20)
    now = T0 + 19 * TICK
    while drive_of(agent, now).u_mps > 0.0:
        now += TICK
    assert now - (T0 + 19 * TICK) == SECOND // 2 + TICK
    status = status_of(agent, now)
    assert (status.mode, status.reason) == ("fault", "no word from the drive for 0.6 s")
    agent.on_message(motion(now, state="active", controllable=False), now)
    assert status_of(agent, now).reason == "the drive is not controllable"


def test_a_slow_drive_is_not_taken_for_silent(make_scenario: Make, command_from: CommandFrom) -> None:
    agent = RobotAgent(make_scenario(rates=Rates(motion_hz=1.0)), "r1")
    run(agent, command_from, (0.1, 0.0), T0, 1)
    agent.on_message(command_from(T0, (0.1, 0.0)), T0 + 2 * SECOND)
    drive_of(agent, T0 + 2 * SECOND)
    assert status_of(agent, T0 + 2 * SECOND).mode == "holding"
    drive_of(agent, T0 + 3 * SECOND)
    assert status_of(agent, T0 + 3 * SECOND).mode == "fault"


def test_after_a_freeze_it_starts_from_a_stand(make_scenario: Make, command_from: CommandFrom) -> None:
    agent = RobotAgent(make_scenario(), "r1")
    assert run(agent, command_from, (0.1, 0.0), T0, 40).u_mps == pytest.approx(0.1)
    late = T0 + 60 * SECOND
    assert run(agent, command_from, (0.1, 0.0), late, 1).u_mps == 0.0
    assert run(agent, command_from, (0.1, 0.0), late + TICK, 1).u_mps == pytest.approx(0.015)


def test_its_layers_are_told_the_time_since_their_step_before(
    make_scenario: Make, command_from: CommandFrom
) -> None:
    """Ticks without a command are no steps; after a freeze they begin anew."""
    steps = []

    class Noting:
        parameters = ()

        def step(self, desired: Velocity, measured: Velocity, free: bool, dt_s: float) -> Velocity:
            steps.append(dt_s)
            return desired

    made = make_scenario(compensation=Compensation(enabled=True, law="noting"))
    agent = RobotAgent(made, "r1", parts=BUILTIN._replace(compensation={"noting": lambda *_: Noting()}))
    drive_of(agent, T0 - 2 * TICK)
    drive_of(agent, T0 - TICK)
    run(agent, command_from, (0.1, 0.0), T0, 2)
    run(agent, command_from, (0.1, 0.0), T0 + 60 * SECOND, 2)
    assert steps == [0.0, 0.05, 0.0, 0.05]


def test_keeps_clear_of_what_it_senses_and_knows_how_far_it_went_since(
    make_scenario: Make, command_from: CommandFrom
) -> None:
    scenario = make_scenario(guard=Guard(stop_after_s=1.0))
    agent = RobotAgent(scenario, "r1")
    assert run(agent, command_from, (0.5, 0.0), T0, 5) == Drive(u_mps=0.0, w_radps=0.0, active=True)
    assert status_of(agent, T0 + 4 * TICK).guard == "blind"
    limits = limits_of(scenario, scenario.robots[0])
    keep, lag = limits.radius + scenario.guard.margin_m, limits.u_lag_s
    now = T0 + 4 * TICK
    for _ in range(19):
        now += TICK
        agent.on_message(scan(keep + 0.2 - 0.018), now)
        drive = run(agent, command_from, (0.5, 0.0), now, 1)
    assert drive.u_mps == pytest.approx(0.2 / limits.gain / (1.0 + lag))
    assert status_of(agent, now).guard == "clearance"
    rolled = round(0.05 * PER_METRE)
    for k in range(1, 4):
        agent.on_message(motion(now + k * TICK, (rolled, rolled)), now + k * TICK)
        drive = drive_of(agent, now + k * TICK)
    assert drive.u_mps == pytest.approx(0.15 / (1.0 + lag), abs=1e-3)


@pytest.mark.parametrize("clearance", [False, True])
def test_stands_when_its_own_layers_have_no_ranges(
    make_scenario: Make, command_from: CommandFrom, clearance: bool
) -> None:
    law = Guard(clearance=clearance, stop_after_s=1.0)
    agent = RobotAgent(make_scenario(guard=law, avoidance=Avoidance(enabled=not clearance)), "r1")
    run(agent, command_from, (0.1, 0.0), T0, 5)
    status = status_of(agent, T0 + 4 * TICK)
    assert (status.mode, status.guard, status.reason) == ("waiting", "blind", "no ranges yet")
    assert not status.sees
    now = T0 + 4 * TICK
    for _ in range(20):
        now += TICK
        agent.on_message(scan(7.0), now)
        drive = run(agent, command_from, (0.1, 0.0), now, 1)
    assert drive.u_mps == pytest.approx(0.1)
    assert status_of(agent, now).mode == "tracking"
    assert status_of(agent, now).sees
    drive = run(agent, command_from, (0.1, 0.0), now + TICK, 20)
    assert (drive.u_mps, drive.w_radps) == (0.0, 0.0)
    status = status_of(agent, now + 20 * TICK)
    assert (status.mode, status.guard, status.reason) == ("holding", "blind", "no ranges for 1.0 s")


@pytest.mark.parametrize(
    "changes",
    [
        {"placement": Placement(robot_from="compensation"), "avoidance": Avoidance()},
        {"avoidance": Avoidance(enabled=False)},
    ],
)
def test_needs_no_ranges_that_nothing_of_its_own_uses(
    make_scenario: Make, command_from: CommandFrom, changes: dict[str, object]
) -> None:
    scenario = make_scenario(**changes)
    agent = RobotAgent(scenario, "r1")
    layer = scenario.placement.robot_from
    for k in range(30):
        now = T0 + k * TICK
        agent.on_message(motion(now), now)
        agent.on_message(command_from(now, (0.1, 0.0), layer=layer), now)
        drive = drive_of(agent, now)
    assert drive.u_mps == pytest.approx(0.1)
    assert status_of(agent, now).mode == "tracking"


def test_it_tells_what_it_can_do_and_which_scenarios_are_run(make_scenario: Make) -> None:
    assert status_of(RobotAgent(make_scenario(), "r1"), T0).scenario == "", "nobody asks"
    scenario = replace(make_scenario(), preflight=Preflight(enabled=True))
    agent = RobotAgent(scenario, "r1")
    model, status = scenario.model_of(scenario.robots[0]), status_of(agent, T0)
    assert status.limits == (model.u_max_mps, model.w_max_radps, 0.0)
    assert (status.scenario, status.drive_scenario) == (short_digest(scenario), "")
    report = motion(T0).message
    assert isinstance(report, Motion)
    agent.on_message(Received(topics.motion("r1"), replace(report, scenario="f" * 16)), T0)
    assert status_of(agent, T0).drive_scenario == "f" * 16


class Commander:
    """Stands for the controller: commands one robot after every odometry, until it falls silent."""

    name = "controller"
    subscriptions = frozenset({"robot/r1/odometry"})

    def __init__(self, values: tuple[float, float], until: int) -> None:
        self.timers: dict[str, int] = {}
        self._values = values
        self._until = until

    def on_start(self, now: int) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: int) -> Sequence[Outgoing]:
        odometry = message.message
        if now >= self._until:
            return ()
        answers = Stamp(odometry.incarnation, odometry.seq, odometry.stamp_ns)
        command = Command(layer="drive", values=self._values, answers=answers, inputs_age_ns=0)
        return (Outgoing("robot/r1/command", command),)

    def on_timer(self, timer: str, now: int) -> Sequence[Outgoing]:
        return ()

    def on_stop(self, now: int) -> Sequence[Outgoing]:
        return ()


def simulate(scenario: Scenario, values: tuple[float, float], until_s: float, end_s: float) -> list[object]:
    """Everything a robot said in the simulated world while commanded for `until_s`, and the truth."""
    said: list[object] = []

    def tap(envelope: Envelope, arrival: int) -> None:
        said.append(codec.decode(envelope.topic, envelope.data))

    commander = Commander(values, VIRTUAL_EPOCH + round(until_s * SECOND))
    host = VirtualHost([Simulator(scenario), RobotAgent(scenario, "r1"), commander], scenario, tap)
    host.start()
    host.run(host.now + round(end_s * SECOND))
    host.stop(["r1"])
    return said


def last(kind: type[T], said: list[object]) -> T:
    return next(message for message in reversed(said) if isinstance(message, kind))


def test_in_the_simulated_world_odometry_agrees_with_the_truth(make_scenario: Make) -> None:
    scenario = make_scenario(placement=Placement(robot_from="drive"))
    said = simulate(scenario, (0.3, 0.4), until_s=10.0, end_s=14.0)
    x, y, psi = unpack_floats(last(Truth, said).poses, 3)[0]
    odometry = last(Odometry, said)
    assert math.hypot(x, y) > 0.3
    assert (odometry.x_m, odometry.y_m) == pytest.approx((x, y), abs=2e-3)
    assert math.remainder(odometry.psi_rad - psi, 2 * math.pi) == pytest.approx(0.0, abs=2e-3)
    assert odometry.u_mps == pytest.approx(0.0, abs=1e-3)  # 4 s after the last command
    modes = [message.mode for message in said if isinstance(message, Status)]
    assert modes == sorted(modes, key=["waiting", "tracking", "holding", "stopped"].index)
    assert set(modes) == {"waiting", "tracking", "holding", "stopped"}


def test_in_the_simulated_world_it_is_not_driven_into_a_post(make_scenario: Make) -> None:
    robot = Robot(id="r1", control_point_m=0.3, pose=(0.0, 0.0, 0.0))
    scenario = make_scenario(
        robots=(robot,),
        placement=Placement(robot_from="drive"),
        guard=Guard(stop_after_s=1.0),
        world=World(obstacles=(Circle(centre=(2.0, 0.1), radius_m=0.15),)),
    )
    said = simulate(scenario, (0.6, 0.0), until_s=20.0, end_s=20.0)
    truths = [message for message in said if isinstance(message, Truth)]
    assert truths[-1].collisions == 0
    assert min(unpack_floats(truth.clearances)[0] for truth in truths) > 0.03
    assert unpack_floats(truths[-1].poses, 3)[0][0] > 1.2


@pytest.mark.parametrize("model", ["pioneer-3dx", "pioneer-3dx-bare", "robotino", "f1tenth"])
@pytest.mark.parametrize("speeds", [(0.7, 0.0), (-0.7, 0.0), (0.6, 0.3), (0.7, -1.5)])
def test_in_the_simulated_world_it_does_not_leave_its_fence(
    make_scenario: Make, model: str, speeds: tuple[float, float]
) -> None:
    robot = Robot(id="r1", model=model, control_point_m=0.3, pose=(3.0, -2.0, 0.7))
    corners = ((1.5, -4.5), (4.5, -3.5), (5.0, 0.0), (3.4, -0.6), (2.0, 0.0))
    scenario = make_scenario(
        robots=(robot,),
        models={model: robot_models()[model]},
        placement=Placement(robot_from="drive"),
        guard=Guard(clearance=False, hold_after_s=9.0, stop_after_s=10.0, fence=corners),
    )
    said = simulate(scenario, speeds, until_s=20.0, end_s=20.0)
    fence, limits = fence_of(corners), limits_of(scenario, robot)
    assert fence is not None
    gaps = [
        float(seen_from(Pose(*pose).compose(Pose(limits.centre, 0.0, 0.0)), fence).distance.min())
        for message in said
        if isinstance(message, Truth)
        for pose in unpack_floats(message.poses, 3).tolist()
    ]
    assert min(gaps) >= limits.radius
    assert "fence" in {message.guard for message in said if isinstance(message, Status)}
