"""An agent whose robot has a driver of its own: poses, frames, sources, loss of control, the fence."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import pytest

from maniple.core import topics
from maniple.core.edges import WORLD
from maniple.core.geometry import Pose
from maniple.core.messages import (
    Alive,
    Command,
    Drive,
    EmergencyStop,
    Message,
    Motion,
    Odometry,
    Scan,
    Stamp,
    Status,
    pack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.parse import digest_of, to_json
from maniple.core.scenario.types import Guard, Placement, Robot, Scenario
from maniple.core.streams import stream
from maniple.core.time import MILLISECOND, SECOND
from robot_agent.drivers.interface import Capabilities
from robot_agent.node import DRIVE, STATUS, RobotAgent

T0 = 1000 * SECOND
TICK = 50 * MILLISECOND
START = (2.0, 1.0, math.pi / 2)
SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
LAW = Guard(clearance=False, hold_after_s=0.5, stop_after_s=1.0)
FENCED = Guard(clearance=False, hold_after_s=0.5, stop_after_s=1.0, fence=SQUARE)
T = TypeVar("T")
Make = Callable[..., Scenario]


class Wired(NamedTuple):
    """What the agent looks at of a driver, before that is connected."""

    capabilities: Capabilities


def wired(frame: str, scan_hz: float) -> Any:
    able = Capabilities(0.6, 1.0, True, True, 20.0, scan_hz, frame)
    return lambda scenario, robot, endpoint="": Wired(able)


class Cell:
    """The agent of r1, and what is said to it."""

    def __init__(
        self, make: Make, frame: str = "r1", guard: Guard = LAW, incarnation: int = 1, scans: str = ""
    ) -> None:
        robot = Robot(id="r1", control_point_m=0.3, pose=START, driver="wire", scans=scans)
        drivers = {"wire": wired(frame, 10.0 if scans in ("", "wire") else 0.0)}
        self.scenario = make(robots=(robot,), guard=guard, placement=Placement(robot_from="drive"))
        self.agent = RobotAgent(self.scenario, "r1", incarnation, drivers=drivers)
        self.now = T0
        self.seq = 0
        self.incarnation = incarnation
        self.agent.on_start(T0)

    def hear(self, topic: str, message: Message) -> Sequence[Outgoing]:
        return self.agent.on_message(Received(topic, message), self.now)

    def report(self, pose: tuple[float, float, float] | None, **changes: Any) -> Sequence[Outgoing]:
        fields: dict[str, Any] = {
            "source": "r1-driver",
            "incarnation": 1,
            "stamp_ns": self.now,
            "ticks": (),
            "applied": (0.0, 0.0),
            "state": "active",
            "controllable": True,
        }
        return self.hear(topics.motion("r1"), Motion(pose=pose, **{**fields, **changes}))

    def command(self, u: float, w: float = 0.0, answered: int | None = None) -> None:
        stamp = self.now if answered is None else answered
        answers = Stamp(self.incarnation, 0, stamp)
        message = Command(source="controller", layer="drive", values=(u, w), answers=answers, inputs_age_ns=0)
        self.hear(topics.command("r1"), message)

    def tick(self) -> Drive:
        self.now += TICK
        return self.due()

    def due(self) -> Drive:
        return only(Drive, self.agent.on_timer(DRIVE, self.now))

    @property
    def status(self) -> Status:
        return only(Status, self.agent.on_timer(STATUS, self.now))

    def cruise(self, pose: tuple[float, float, float], ticks: int, u: float = 0.2, **changes: Any) -> Drive:
        """Reports from one place, a command that answers each, and what the drive is told in the end."""
        for _ in range(ticks):
            self.now += TICK
            self.report(pose, **changes)
            self.command(u)
            drive = self.due()
        return drive


def only(kind: type[T], outgoing: Sequence[Outgoing]) -> T:
    (found,) = (message for _, message in outgoing if isinstance(message, kind))
    return found


def test_poses_are_rebased_to_where_the_first_was(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    first = only(Odometry, cell.report((100.0, 50.0, math.pi / 2), twist=(0.2, 0.1, 0.05)))
    assert (first.frame_id, first.x_m, first.y_m, first.psi_rad) == ("r1", 0.0, 0.0, 0.0)
    assert (first.u_mps, first.w_radps, first.v_mps) == (0.2, 0.1, 0.05)
    assert (first.ticks, first.motion_pose) == ((), (100.0, 50.0, math.pi / 2))
    cell.now += TICK
    second = only(Odometry, cell.report((100.0, 50.04, math.pi / 2 + 0.02)))
    assert (second.x_m, second.y_m, second.psi_rad) == pytest.approx((0.04, 0.0, 0.02))


def test_in_the_world_frame_poses_are_given_as_they_come_by_every_life(make_scenario: Make) -> None:
    for life in (1, 3):
        cell = Cell(make_scenario, WORLD, incarnation=life)
        assert cell.status.localised
        odometry = only(Odometry, cell.report((7.0, -8.0, 4.0)))
        assert (odometry.frame_id, odometry.x_m, odometry.y_m) == ("world", 7.0, -8.0)
        assert odometry.psi_rad == pytest.approx(4.0 - 2.0 * math.pi)


def test_who_is_restarted_resumes_its_frame_by_the_drivers_pose(make_scenario: Make) -> None:
    cell = Cell(make_scenario, incarnation=2)
    word = Odometry(
        source="r1",
        incarnation=1,
        stamp_ns=T0 - SECOND,
        frame_id="r1",
        x_m=1.0,
        y_m=2.0,
        psi_rad=0.0,
        u_mps=0.0,
        w_radps=0.0,
        motion_pose=(100.0, 50.0, math.pi / 2),
        motion_incarnation=1,
    )
    assert not cell.status.localised
    cell.hear(topics.odometry("r1"), word)
    status, odometry = (message for _, message in cell.report((100.0, 50.3, math.pi / 2)))
    assert isinstance(status, Status)
    assert status.localised
    assert isinstance(odometry, Odometry)
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == pytest.approx((1.3, 2.0, 0.0))


@pytest.mark.parametrize(
    "between",
    [
        {"incarnation": 2},
        {"pose": None, "incarnation": 2},
        {"pose": None, "state": "closed", "controllable": False},
    ],
    ids=str,
)
def test_a_driver_that_begins_anew_has_a_new_origin(make_scenario: Make, between: dict[str, Any]) -> None:
    cell = Cell(make_scenario)
    cell.report((0.0, 0.0, 0.0))
    cell.now += TICK
    odometry = only(Odometry, cell.report((0.02, 0.0, 0.0)))
    changes = {"pose": (70.0, 0.0, 1.0), **between}
    cell.report(**changes)
    cell.now += TICK
    life = between.get("incarnation", 1)
    odometry = only(Odometry, cell.report((70.0, 0.0, 1.0), incarnation=life))
    assert (odometry.x_m, odometry.y_m, odometry.psi_rad) == pytest.approx((0.02, 0.0, 0.0))
    assert "pose_jumps" not in cell.status.counters


def test_a_driver_that_tells_when_its_frame_begins_anew_is_believed(make_scenario: Make) -> None:
    """The vehicle rolled on for 0.6 m while its link was cut, and later was switched off and on."""
    cell = Cell(make_scenario)
    cell.report((50.0, 0.0, 0.0), origin=0)
    for state in ("fault", "closed", "connected"):
        cell.now += SECOND
        cell.report(None, state=state, controllable=False)
    cell.now += SECOND
    odometry = only(Odometry, cell.report((50.6, 0.0, 0.0), origin=0))
    assert odometry.x_m == pytest.approx(0.6)
    assert odometry.motion_origin == 0
    cell.now += TICK
    odometry = only(Odometry, cell.report((50.65, 0.0, 0.0), origin=1))
    assert odometry.x_m == pytest.approx(0.6)
    assert odometry.motion_origin == 1
    cell.now += TICK
    assert only(Odometry, cell.report((50.65, 0.0, 0.0), origin=1, incarnation=2)).x_m == pytest.approx(0.6)
    assert cell.status.counters == {}


def test_what_only_tells_the_state_is_no_odometry_and_no_mistake(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    assert cell.report(None, state="connected", controllable=False, reason="no EKF origin yet") == ()
    cell.tick()
    status = cell.status
    assert (status.driver, status.controllable, status.reason) == ("connected", False, "no EKF origin yet")
    assert status.counters == {}


def test_foreign_and_absurd_reports_are_counted_and_move_nothing(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    for source in ("simulator", "r1-scanner", ""):
        assert cell.report((0.0, 0.0, 0.0), source=source) == ()
    assert cell.status.driver == "closed"
    assert cell.report((2e6, 0.0, 0.0)) == ()
    assert cell.report((0.0, 0.0, 0.0), twist=(2e3, 0.0, 0.0)) == ()
    assert cell.report(None, ticks=(1, 2, 3)) == ()
    assert cell.status.counters == {"refused_foreign": 3, "refused_absurd": 2, "refused_ticks": 1}
    in_world = Cell(make_scenario, WORLD)
    assert in_world.report(None, ticks=(1, 2)) == ()
    assert in_world.status.counters == {"refused_ticks": 1}


@pytest.mark.parametrize(
    ("scans", "heard"),
    [("", "r1-driver"), ("wire", "r1-driver"), ("laser", "r1-scanner"), ("simulator", "simulator")],
)
def test_scans_come_from_whom_the_scenario_names(make_scenario: Make, scans: str, heard: str) -> None:
    cell = Cell(make_scenario, scans=scans)
    for source in ("r1-driver", "r1-scanner", "simulator"):
        message = Scan(
            source=source,
            first_angle_rad=0.0,
            increment_rad=0.1,
            range_min_m=0.0,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=pack_floats([1.0]),
        )
        assert len(cell.hear(topics.scan("r1"), message)) == (source == heard)
    assert cell.status.counters == {"refused_foreign": 2}


def test_a_small_jump_in_the_world_is_believed_and_a_large_one_needs_a_new_command(
    make_scenario: Make,
) -> None:
    cell = Cell(make_scenario, WORLD)
    assert cell.cruise((2.0, 1.0, 0.0), 20).u_mps == pytest.approx(0.2)
    assert cell.cruise((2.5, 1.0, 0.0), 1).u_mps == pytest.approx(0.2)
    assert cell.status.counters == {"pose_jumps": 1}
    old = cell.now
    cell.now += TICK
    odometry = only(Odometry, cell.report((9.0, 1.0, 0.0)))
    assert odometry.x_m == 9.0
    cell.command(0.2, answered=old)
    assert cell.due().u_mps == 0.0
    status = cell.status
    assert (status.mode, status.reason) == ("waiting", "no command yet")
    assert status.counters == {"pose_jumps": 2, "refused_earlier": 1}
    assert cell.cruise((9.0, 1.0, 0.0), 20).u_mps == pytest.approx(0.2)


@pytest.mark.parametrize("at", [2.0, 2.4])
def test_what_it_saw_before_a_jump_is_still_where_it_was_seen(make_scenario: Make, at: float) -> None:
    """A wall is 0.6 m ahead, and then the position estimate is corrected by 0.4 m, or not."""
    guard = Guard(hold_after_s=0.5, stop_after_s=1.0)
    cell = Cell(make_scenario, WORLD, guard)
    for _ in range(80):
        ranges = pack_floats([8.0] * 90 + [0.6] + [8.0] * 90)
        scan = Scan(
            source="r1-driver",
            first_angle_rad=-math.pi / 2,
            increment_rad=math.pi / 180,
            range_min_m=0.0,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=ranges,
        )
        cell.hear(topics.scan("r1"), scan)
        steady = cell.cruise((2.0, 1.0, 0.0), 1, u=0.5).u_mps
    assert 0.1 < steady < 0.3
    assert cell.cruise((at, 1.0, 0.0), 1, u=0.5).u_mps == pytest.approx(steady)
    assert cell.status.counters.get("pose_jumps", 0) == (at > 2.0)


def test_a_jump_in_its_own_frame_moves_nothing_and_does_not_stop_it(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    cell.cruise((2.0, 1.0, 0.0), 20)
    assert cell.cruise((9.0, 1.0, 0.0), 1).u_mps == pytest.approx(0.2)
    cell.now += TICK
    odometry = only(Odometry, cell.report((9.02, 1.0, 0.0)))
    assert (odometry.x_m, odometry.y_m) == pytest.approx((0.02, 0.0))
    assert cell.status.counters == {"pose_jumps": 1}


def test_the_drive_is_told_whether_a_controller_is_there(make_scenario: Make) -> None:
    cell = Cell(make_scenario)

    def alive(node: str, life: int, there: bool) -> bool:
        cell.hear(topics.HOST_ALIVE, Alive(node=node, node_incarnation=life, alive=there))
        return cell.tick().controller_alive

    assert not cell.tick().controller_alive
    assert not alive("r2", 1, True)
    assert alive("controller", 1, True)
    assert alive("controller", 2, True)
    assert alive("controller", 1, False)
    assert not alive("controller", 2, False)
    assert alive("controller", 3, True)
    assert alive("router", 1, True)
    assert not alive("router", 1, False)
    assert alive("router", 2, True)
    stopped = only(Drive, cell.agent.on_stop(cell.now))
    assert (stopped.active, stopped.controller_alive) == (False, True)


def test_a_pilot_takes_over_and_gives_back(make_scenario: Make) -> None:
    """It is not fought, and under control again it begins from a stand with a command of that time."""
    cell = Cell(make_scenario)
    assert cell.cruise((0.0, 0.0, 0.0), 20).u_mps == pytest.approx(0.2)
    taken: dict[str, Any] = {"controllable": False, "reason": "a pilot chose the mode MANUAL"}
    drive = cell.cruise((0.0, 0.0, 0.0), 1, **taken)
    assert (drive.u_mps, drive.w_radps, drive.active) == (0.0, 0.0, False)
    status = cell.status
    assert (status.mode, status.controllable) == ("fault", False)
    assert status.reason == "a pilot chose the mode MANUAL"
    cell.cruise((0.0, 0.0, 0.0), 10, **taken)
    before = cell.now
    cell.now += TICK
    cell.report((0.0, 0.0, 0.0), state="configured")
    drive = cell.due()
    assert (drive.u_mps, drive.active, cell.status.mode) == (0.0, True, "waiting")
    cell.now += TICK
    cell.report((0.0, 0.0, 0.0))
    cell.command(0.2, answered=before)
    assert cell.due().u_mps == 0.0
    assert cell.status.reason == "no command yet"
    assert cell.cruise((0.0, 0.0, 0.0), 1).u_mps == pytest.approx(0.3 * 0.05)
    assert cell.status.mode == "tracking"


def test_control_that_is_lost_and_back_between_two_ticks_needs_a_new_command(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    cell.cruise((0.0, 0.0, 0.0), 20)
    cell.now += TICK
    cell.report((0.0, 0.0, 0.0), controllable=False)
    cell.report((0.0, 0.0, 0.0))
    assert cell.due().u_mps == 0.0
    assert cell.status.mode == "waiting"
    assert cell.cruise((0.0, 0.0, 0.0), 1).u_mps == pytest.approx(0.3 * 0.05)


def stop(cell: Cell, stopped: bool, seq: int) -> None:
    cell.hear(topics.STOP, EmergencyStop(source="operator", incarnation=1, seq=seq, stopped=stopped))


def test_what_moves_against_what_it_is_told_stands_until_it_was_stopped_and_armed(
    make_scenario: Make,
) -> None:
    """Told to drive forwards it moves backwards; whatever its drive says afterwards, it stays where it is."""
    cell = Cell(make_scenario)
    backwards: dict[str, Any] = {"twist": (-0.2, 0.0, 0.0)}
    assert cell.cruise((0.0, 0.0, 0.0), 20, **backwards).u_mps == pytest.approx(0.2)
    assert cell.status.mode == "tracking"
    drive = cell.cruise((0.0, 0.0, 0.0), 10, **backwards)
    assert (drive.u_mps, drive.w_radps, drive.active) == (0.0, 0.0, False)
    said = (
        "told to drive forwards for 1 s and moves backwards (its motors, its compass); it stands until an "
        "operator has stopped and armed it"
    )
    assert (cell.status.mode, cell.status.reason) == ("fault", said)
    assert cell.status.counters["contrary"] == 1
    stop(cell, False, 1)  # there is no stop to be released
    for changes in ({}, {"controllable": False}, {"state": "configured"}, {"incarnation": 2}, {}):
        drive = cell.cruise((0.0, 0.0, 0.0), 40, **changes)
        assert (drive.u_mps, drive.active, cell.status.mode) == (0.0, False, "fault")
    cell.hear(topics.HOST_ALIVE, Alive(node="controller", node_incarnation=2, alive=True))
    cell.cruise((9.0, 0.0, 0.0), 5)
    assert (cell.status.mode, cell.status.reason) == ("fault", said)
    stop(cell, True, 2)
    assert cell.cruise((9.0, 0.0, 0.0), 5).u_mps == 0.0
    stop(cell, False, 3)
    assert (cell.status.mode, cell.status.reason) == ("waiting", "no command yet")
    assert cell.cruise((9.0, 0.0, 0.0), 60, twist=(0.2, 0.0, 0.0)).u_mps == pytest.approx(0.2)
    assert (cell.status.mode, cell.status.reason) == ("tracking", "")
    assert cell.cruise((9.0, 0.0, 0.0), 30, **backwards).u_mps == 0.0
    assert cell.status.counters["contrary"] == 2


def test_what_a_pilot_or_an_emergency_stop_makes_of_it_is_not_held_against_it(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    cell.cruise((0.0, 0.0, 0.0), 20, twist=(0.2, 0.0, 0.0))
    away: dict[str, Any] = {"twist": (-0.4, 0.0, 0.0)}
    cell.cruise((0.0, 0.0, 0.0), 60, controllable=False, **away)
    cell.cruise((0.0, 0.0, 0.0), 20, twist=(0.1, 0.0, 0.0))
    stop(cell, True, 1)
    cell.cruise((0.0, 0.0, 0.0), 60, **away)
    stop(cell, False, 2)
    assert cell.cruise((0.0, 0.0, 0.0), 20, twist=(0.1, 0.0, 0.0)).u_mps == pytest.approx(0.2)
    assert "contrary" not in cell.status.counters


def test_what_does_not_move_though_it_is_told_to_says_so_and_is_told_on(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    cell.cruise((0.0, 0.0, 0.0), 60)
    assert cell.status.reason == ""
    assert cell.cruise((0.0, 0.0, 0.0), 10).u_mps == pytest.approx(0.2)
    assert cell.status.mode == "tracking"
    assert cell.status.reason == "told to drive for 3 s and does not move (blocked, its motors)"
    cell.cruise((0.0, 0.0, 0.0), 1, twist=(0.1, 0.0, 0.0))
    assert cell.status.reason == ""


def test_the_emergency_stop_counts_as_tested_where_the_drive_was_heard_and_stood(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    stop(cell, False, 0)
    assert not cell.status.estop_tested
    cases: list[tuple[dict[str, Any], bool]] = [
        ({"controllable": False}, False),
        ({"twist": (0.3, 0.0, 0.0)}, False),
        ({"twist": (0.0, 0.3, 0.0)}, False),
        ({"twist": (0.0, 0.0, 0.3)}, False),
        ({"pose": None}, False),
        ({"twist": (0.01, 0.01, 0.0), "state": "configured"}, True),
        ({"twist": (0.3, 0.0, 0.0)}, True),
    ]
    for seq, (said, tested) in enumerate(cases, start=1):
        stop(cell, True, 2 * seq)
        cell.tick()
        assert cell.status.mode == "emergency"
        cell.report(**{"pose": (0.0, 0.0, 0.0), **said})
        stop(cell, False, 2 * seq + 1)
        assert cell.status.estop_tested == tested, said
    silent = Cell(make_scenario)
    silent.report((0.0, 0.0, 0.0))
    stop(silent, True, 1)
    silent.now += SECOND
    stop(silent, False, 2)
    assert not silent.status.estop_tested


def test_it_says_which_scenario_it_runs_and_whether_it_is_controllable(make_scenario: Make) -> None:
    cell = Cell(make_scenario)
    assert cell.status.scenario == digest_of(to_json(cell.scenario))[:16]
    assert not cell.status.controllable
    cell.report((0.0, 0.0, 0.0))
    assert cell.status.controllable
    cell.now += SECOND
    assert not cell.status.controllable


@pytest.mark.parametrize("frame", ["r1", WORLD])
def test_the_fence_is_kept_in_either_frame(make_scenario: Make, frame: str) -> None:
    """It drives north from (2, 1) towards the fence at y = 4, and its poses are believed."""
    cell = Cell(make_scenario, frame, FENCED)
    world, drive = Pose(*START), Drive(u_mps=0.0, w_radps=0.0, active=True)
    offset = Pose(0.0, 0.0, 0.0) if frame == WORLD else Pose(77.0, 5.0, 1.0)
    reasons = set()
    for _ in range(800):
        cell.now += TICK
        world = world.advance(0.05 * drive.u_mps, 0.05 * drive.w_radps)
        cell.report(offset.compose(world), twist=(drive.u_mps, drive.w_radps, 0.0))
        cell.command(0.5)
        drive = cell.due()
        reasons.add(cell.status.guard)
    radius = math.hypot(0.511, 0.425) / 2.0
    assert 4.0 - radius - 0.06 < world.y < 4.0 - radius - 0.045
    assert "fence" in reasons


def test_who_does_not_know_where_it_is_stands_where_there_is_a_fence(make_scenario: Make) -> None:
    """The drive is heard, but has lost its position."""
    for guard, moves in ((FENCED, False), (LAW, True)):
        cell = Cell(make_scenario, WORLD, guard)
        assert cell.cruise((2.0, 2.0, 0.0), 20).u_mps == pytest.approx(0.2)
        for _ in range(11):
            cell.now += TICK
            cell.report(None)
            cell.command(0.2)
            drive = cell.due()
        assert (drive.u_mps > 0.0) == moves
        assert (cell.status.guard == "fence") == (not moves)


@pytest.mark.parametrize("frame", ["r1", WORLD])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_a_driver_says_it_stands_where_it_may_not_move(
    make_scenario: Make, frame: str, seed: int
) -> None:
    """Reports of every kind in any order: finite odometry, nothing beyond the limits, and zero without a
    drive that is active and controllable."""
    random = stream(seed, f"wired/{frame}")
    cell = Cell(make_scenario, frame, FENCED)
    told = Drive(u_mps=0.0, w_radps=0.0, active=True)
    moved = 0
    for _ in range(600):
        wild = random.random() < 0.1
        x, y, psi = random.normal(2.0, 1e3 if wild else 0.01, 3).tolist()
        pose = None if random.random() < 0.05 else (x, y, psi)
        state = str(random.choice(["active"] * 12 + ["closed", "connected", "configured", "fault"]))
        controllable = bool(random.random() < 0.95)
        twist = tuple(random.normal(0.0, 1e3 if wild else 0.1, 3).tolist())
        cell.now += int(random.choice([TICK, TICK, TICK, 0, 12 * TICK]))
        said = cell.report(
            pose,
            ticks=() if pose or random.random() < 0.5 else (int(random.integers(0, 2**40)), 5),
            state=state,
            controllable=controllable,
            twist=twist,
            incarnation=int(random.choice([1, 1, 1, 1, 2])),
            origin=(None, 1, 1, 2)[int(random.integers(4))],
            stamp_ns=cell.now + int(random.choice([0, 0, -SECOND, SECOND])),
        )
        for _, message in said:
            if isinstance(message, Odometry):
                values = (message.x_m, message.y_m, message.psi_rad, message.u_mps, message.w_radps)
                assert all(map(math.isfinite, values))
        if random.random() < 0.8:
            cell.command(*random.choice([-1.0, 0.3, 1e300], 2).tolist())
        before, told = told, cell.due()
        assert abs(told.u_mps) <= 0.6
        assert abs(told.w_radps) <= 1.0
        assert abs(told.u_mps) <= abs(before.u_mps) + 0.3 * 0.05 * 13
        status = cell.status
        moved += told.u_mps != 0.0
        if not status.controllable or status.driver != "active":
            assert (told.u_mps, told.w_radps) == (0.0, 0.0)
    assert moved > 5
