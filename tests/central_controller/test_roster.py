import numpy as np
import pytest

from central_controller.roster import Member, Presence, Roster
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Message, Mode, Odometry, Scan, Status, pack_floats
from maniple.core.scenario.types import Robot
from maniple.core.time import MILLISECOND, SECOND

T0 = 100 * SECOND
ROBOT = Robot(id="r1", pose=(1.0, 2.0, 0.0), control_point_m=0.3)


def odometry(incarnation: int = 1, u: float = 0.0, now: int = T0, frame: str = "r1") -> Odometry:
    """Sent at `now`; the robot's clock has just begun then."""
    return Odometry(
        incarnation=incarnation,
        seq=7,
        stamp_ns=5 + now - T0,
        frame_id=frame,
        x_m=0.5,
        y_m=0.0,
        psi_rad=0.0,
        u_mps=u,
        w_radps=0.0,
    )


def alive(incarnation: int, lives: bool) -> Alive:
    return Alive(node="r1", node_incarnation=incarnation, alive=lives)


def scan() -> Scan:
    ranges = pack_floats(np.full(3, 8.0))
    return Scan(
        first_angle_rad=-0.1,
        increment_rad=0.1,
        range_min_m=0.1,
        range_max_m=8.0,
        mount=(0, 0, 0),
        ranges=ranges,
    )


@pytest.mark.parametrize(
    ("history", "after_ms", "presence"),
    [
        ([], 0, "absent"),
        ([odometry()], 0, "absent"),
        ([alive(1, True), odometry()], 500, "present"),
        ([alive(1, True), odometry()], 501, "silent"),
        ([alive(1, True)], 0, "silent"),
        ([alive(1, True), odometry()], 0, "present"),
        ([odometry(), alive(1, False)], 0, "absent"),
        ([odometry(), alive(1, False), alive(1, True)], 0, "present"),
        ([odometry(1), alive(2, True), alive(1, False)], 0, "present"),
        ([odometry(1), alive(1, False), odometry(2)], 0, "absent"),
        ([odometry(2), alive(2, True), alive(1, False)], 0, "present"),
    ],
)
def test_presence(history: list[Message], after_ms: int, presence: Presence) -> None:
    member = Member(ROBOT)
    for message in history:
        member.heard(message, T0)
    assert member.presence(T0 + after_ms * MILLISECOND) == presence
    assert member.report(T0 + after_ms * MILLISECOND).state == presence


def test_report_before_and_after_the_first_words() -> None:
    member = Member(ROBOT)
    assert (member.report(T0).odometry_age_s, member.report(T0).mode) == (-1.0, "")
    member.heard(odometry(), T0)
    status = Status(
        mode="tracking",
        guard="none",
        command_age_s=0.1,
        command_age_max_s=0.2,
        driver="active",
        reason="",
        counters={},
    )
    member.heard(status, T0)
    report = member.report(T0 + 250 * MILLISECOND)
    assert (report.id, report.odometry_age_s, report.mode) == ("r1", 0.25, "tracking")
    assert (report.incarnation, report.reason, report.round_trip_s) == (0, "", -1.0)


def test_once_located_only_that_life_is_believed() -> None:
    member = Member(ROBOT)
    member.heard(alive(1, True), T0)
    member.heard(odometry(1), T0)
    member.locate()
    member.heard(alive(2, True), T0)
    member.heard(odometry(2), T0)
    assert member.presence(T0) == "unlocalised"
    assert member.odometry is not None
    assert member.odometry.incarnation == 1


def status(incarnation: int = 1, mode: Mode = "tracking", localised: bool = True) -> Status:
    return Status(
        incarnation=incarnation,
        mode=mode,
        guard="none",
        command_age_s=0.1,
        command_age_max_s=0.2,
        driver="active",
        reason="",
        counters={},
        localised=localised,
    )


def test_a_later_life_that_has_resumed_its_frame_is_believed() -> None:
    member = Member(ROBOT)
    for message in (alive(1, True), status(1), odometry(1)):
        member.heard(message, T0)
    member.locate()
    member.heard(alive(2, True), T0)
    member.heard(status(2, localised=False), T0)
    member.heard(odometry(2), T0)
    assert member.presence(T0) == "unlocalised"
    member.heard(status(2), T0)
    member.heard(odometry(2), T0)
    assert member.presence(T0) == "present"
    assert member.odometry is not None
    assert member.odometry.incarnation == 2


def test_before_the_task_too_a_robot_may_not_know_where_its_frame_is() -> None:
    member = Member(ROBOT)
    for message in (alive(2, True), status(2, localised=False), odometry(2)):
        member.heard(message, T0)
    assert member.presence(T0) == "unlocalised"


def platoon(n: int = 3) -> Roster:
    """Robots that are there, heard and tracking at T0."""
    roster = Roster([Robot(id=f"r{k}", pose=(float(k), 0.0, 0.0)) for k in range(n)])
    for member in roster.members:
        for message in (alive(1, True), status(), odometry()):
            member.heard(message, T0)
    roster.locate()
    return roster


def hear(roster: Roster, now: int, *names: str) -> None:
    for member in roster.members:
        if member.id in names:
            member.heard(odometry(now=now), now)


def test_a_robot_that_stays_away_is_lost_and_taken_in_again() -> None:
    roster = platoon()
    for second in range(1, 4):
        now = T0 + second * SECOND
        hear(roster, now, "r0", "r1")
        assert roster.review(3 * SECOND, now) == (second == 4)
        assert [member.id for member in roster.active] == ["r0", "r1", "r2"]
        assert roster.waited_for(now) == {"r2": "it is not heard"}
    now = T0 + 4 * SECOND
    hear(roster, now, "r0", "r1")
    assert roster.review(3 * SECOND, now)
    assert [member.id for member in roster.active] == ["r0", "r1"]
    assert roster.waited_for(now) == {}
    assert roster.members[2].report(now).state == "lost"
    for k in range(11):
        assert [member.id for member in roster.active] == ["r0", "r1"]
        now += 100 * MILLISECOND
        hear(roster, now, "r0", "r1", "r2")
        assert roster.review(3 * SECOND, now) == (k == 10)
    assert [member.id for member in roster.active] == ["r0", "r1", "r2"]


@pytest.mark.parametrize(("mode", "lost"), [("fault", True), ("stopped", True), ("holding", False)])
def test_a_robot_without_control_is_lost_one_that_holds_is_waited_for(mode: Mode, lost: bool) -> None:
    roster = platoon()
    roster.members[1].heard(status(mode=mode), T0)
    for second in range(1, 6):
        now = T0 + second * SECOND
        hear(roster, now, "r0", "r1", "r2")
        roster.review(3 * SECOND, now)
    assert roster.members[1].lost == lost
    assert (list(roster.waited_for(now)) == ["r1"]) != lost


def test_when_nobody_is_heard_it_is_the_network_that_is_lost() -> None:
    roster = platoon()
    for second in range(1, 60):
        assert not roster.review(3 * SECOND, T0 + second * SECOND)
    now = T0 + 60 * SECOND
    assert list(roster.waited_for(now)) == ["r0", "r1", "r2"]
    hear(roster, now, "r0")
    assert not roster.review(3 * SECOND, now)
    hear(roster, now + 3 * SECOND, "r0")
    assert roster.review(3 * SECOND, now + 3 * SECOND)
    assert [member.id for member in roster.active] == ["r0"]


def test_on_a_robot_everything_is_in_its_odometry_frame() -> None:
    poses = {"a": (1.0, 2.0, 0.5), "b": (-1.0, 0.0, 2.0), "c": (0.0, 3.0, -1.0)}
    robots = [Robot(id=name, pose=pose, control_point_m=0.3) for name, pose in poses.items()]
    world, own = Roster(robots), Roster(robots, "b")
    assert own.frame == poses["b"]
    for one, other in zip(world.members, own.members, strict=True):
        x, y = one.mounting.point(Pose(0.4, -0.1, 0.3))
        there = own.frame.compose(Pose(*other.mounting.point(Pose(0.4, -0.1, 0.3)), 0.0))
        assert (there.x, there.y) == pytest.approx((x, y))
        assert own.frame.rotate(*own.frame.inverse().rotate(0.1, 0.2)) == pytest.approx((0.1, 0.2))


def test_view_carries_the_odometry_forward_but_not_for_ever() -> None:
    member = Member(ROBOT)
    assert member.view(T0) is None
    member.heard(odometry(u=1.0), T0)
    for age_ms, x in ((0, 1.8), (100, 1.9), (500, 2.3), (5000, 2.3)):
        view = member.view(T0 + age_ms * MILLISECOND)
        assert view is not None
        assert view.point == pytest.approx((x, 2.0))
        assert view.age == age_ms * MILLISECOND
        assert (view.answers.incarnation, view.answers.seq, view.answers.stamp_ns) == (1, 7, 5)


def test_ready_when_every_robot_was_heard() -> None:
    roster = Roster([ROBOT, Robot(id="r2", pose=(0.0, 0.0, 0.0))])
    first, second = roster.members
    for member in roster.members:
        member.heard(alive(1, True), T0)
    first.heard(odometry(), T0)
    assert not roster.ready(T0, with_ranges=False)
    second.heard(odometry(), T0)
    assert roster.ready(T0, with_ranges=False)
    assert not roster.ready(T0, with_ranges=True)
    first.heard(scan(), T0)
    second.heard(scan(), T0 + 1)
    assert roster.ready(T0, with_ranges=True)
    assert second.returns_age(T0 + 3) == 2
    second.heard(alive(1, False), T0)
    assert not roster.ready(T0, with_ranges=False)
