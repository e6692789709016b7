import numpy as np
import pytest
from msgspec.structs import replace

from central_controller.roster import AgeLimits, Member, Presence, Roster, waiting_for
from maniple.core.geometry import Pose
from maniple.core.messages import Alive, Message, Mode, Odometry, Scan, Seat, Status, pack_floats
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
        ([odometry(1), alive(2, True), alive(1, False)], 0, "unlocalised"),
        ([odometry(1), alive(1, False), odometry(2)], 0, "absent"),
        ([odometry(2), alive(2, True), alive(1, False)], 0, "unlocalised"),
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


def test_before_the_task_what_a_later_life_said_before_it_knew_its_frame_is_not_believed() -> None:
    """However late the word comes that it knows, and whatever that overtakes."""
    member = Member(ROBOT)
    member.heard(alive(2, True), T0)
    member.heard(odometry(2, frame="r1/2"), T0)
    assert member.presence(T0) == "unlocalised"
    member.heard(status(1), T0)
    assert member.presence(T0) == "unlocalised"
    member.heard(replace(status(2), stamp_ns=5 + SECOND), T0 + SECOND)
    member.heard(odometry(2, frame="r1/2", now=T0 + SECOND // 2), T0 + SECOND)
    assert member.presence(T0 + SECOND) == "silent"
    member.heard(odometry(2, now=T0 + SECOND), T0 + SECOND)
    assert member.presence(T0 + SECOND) == "present"
    member.locate()
    assert member.seat(0) == Seat("r1", 0, 2, "r1", False)


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


def later(roster: Roster, now: int, seconds: float, *names: str) -> tuple[int, int]:
    """Go on with only these heard: when it is then, and how often the chain changed."""
    changes = 0
    for _ in range(round(10 * seconds)):
        now += 100 * MILLISECOND
        hear(roster, now, *names)
        changes += roster.review(2 * SECOND, now)
    return now, changes


def test_a_robot_that_comes_and_goes_has_to_stay_ever_longer() -> None:
    roster = platoon()
    now, changes = T0, 0
    for _ in range(10):
        for names in (("r0", "r1"), ("r0", "r1", "r2")):
            now, changed = later(roster, now, 3.0, *names)
            changes += changed
    assert changes <= 5
    now, _ = later(roster, now, 16.5, "r0", "r1", "r2")
    assert [member.id for member in roster.active] == ["r0", "r1", "r2"]
    now, _ = later(roster, now, 60.0, "r0", "r1", "r2")
    now, _ = later(roster, now, 3.0, "r0", "r1")
    assert roster.members[2].lost
    later(roster, now, 1.2, "r0", "r1", "r2")
    assert not roster.members[2].lost


def test_in_a_partition_those_that_are_heard_go_on() -> None:
    roster = platoon(6)
    now, changes = later(roster, T0, 10.0, "r3", "r4", "r5")
    assert [member.id for member in roster.active] == ["r3", "r4", "r5"]
    assert changes == 1
    assert roster.waited_for(now) == {}
    later(roster, now, 1.2, "r0", "r1", "r2", "r3", "r4", "r5")
    assert len(roster.active) == 6


def test_a_robot_in_an_emergency_is_waited_for_and_not_lost() -> None:
    roster = platoon()
    roster.members[1].heard(status(mode="emergency"), T0)
    now, changes = later(roster, T0, 30.0, "r0", "r1", "r2")
    assert changes == 0
    assert roster.waited_for(now) == {"r1": "emergency"}


def test_an_emergency_stop_is_said_once() -> None:
    member = Member(ROBOT)
    member.heard(alive(1, True), T0)
    member.heard(odometry(), T0)
    member.heard(replace(status(mode="emergency"), reason="emergency stop: a dog"), T0)
    assert member.cause(T0) == "emergency stop: a dog"


def test_one_that_is_frozen_is_lost_though_its_token_lives_and_told_of_as_silent() -> None:
    roster = platoon()
    now, _ = later(roster, T0, 1.0, "r0", "r1")
    assert roster.members[2].report(now).state == "silent"
    assert later(roster, now, 5.0, "r0", "r1")[1] == 1


LIMITS = AgeLimits(hold_s=1.0, stop_s=2.0)


def test_how_old_its_commands_may_be_says_when_it_is_waited_for_and_when_it_is_silent() -> None:
    member = Member(ROBOT, limits=LIMITS)
    for message in (alive(1, True), status(), odometry(u=1.0)):
        member.heard(message, T0)
    for after_s, presence, cause in (
        (0.9, "present", ""),
        (1.1, "present", "it is not heard"),
        (2.1, "silent", "it is not heard"),
    ):
        now = T0 + round(after_s * SECOND)
        assert (member.presence(now), member.cause(now)) == (presence, cause)
    view = member.view(T0 + 5 * SECOND)
    assert view is not None
    assert view.point == pytest.approx((1.8 + 2.0, 2.0)), "carried forward for 2 s"
    member.limit(AgeLimits(hold_s=0.1, stop_s=0.2))
    assert member.presence(T0 + 600 * MILLISECOND) == "silent"


def test_late_odometry_is_carried_forward_over_what_it_is_old() -> None:
    """It comes 0.8 s late once the network is slow, by whatever clock."""
    member = Member(ROBOT, limits=LIMITS)
    member.heard(alive(1, True), T0)
    member.heard(odometry(u=1.0, now=T0), T0)
    now = T0 + 2 * SECOND
    member.heard(odometry(u=1.0, now=now - 800 * MILLISECOND), now)
    view = member.view(now)
    assert view is not None
    assert view.point == pytest.approx((2.6, 2.0), abs=0.01)
    assert view.age == pytest.approx(0.8 * SECOND, rel=0.01)
    assert member.report(now).odometry_age_s == pytest.approx(0.8, rel=0.01)


def test_causes_stay_the_same_while_nothing_changes_but_figures() -> None:
    member = Member(ROBOT, limits=LIMITS)
    member.heard(alive(1, True), T0)
    said = []
    for k, age_s in enumerate((4.1, 4.3, 3.9)):
        now = T0 + k * SECOND
        member.heard(odometry(now=now), now)
        member.heard(replace(status(mode="holding"), command_age_s=age_s), now)
        said.append(member.cause(now))
    assert said == ["the command is 4.1 s old, the limit 1.00 s"] * 3
    member.heard(replace(status(mode="fault"), reason="no word from the drive for 1.2 s"), now)
    assert member.cause(now) == "fault: no word from the drive for 1.2 s"
    assert member.report(now).reason == "no word from the drive for 1.2 s"


def test_whom_it_waits_for_in_a_line() -> None:
    assert waiting_for({}) == ""
    causes = {"r1": "the command is 4.1 s old", "r3": "it is not heard", "r4": "the command is 4.3 s old"}
    assert waiting_for(causes) == "waits for r1, r4: the command is 4.1 s old; for r3: it is not heard"


def test_odometry_in_another_frame_is_not_believed_whatever_its_life_said() -> None:
    """It was sent before the robot resumed its frame, and overtaken."""
    member = Member(ROBOT)
    for message in (alive(1, True), status(1), odometry(1)):
        member.heard(message, T0)
    member.locate()
    for message in (alive(2, True), status(2), odometry(2, frame="r1/2")):
        member.heard(message, T0)
    assert member.odometry is not None
    assert member.odometry.incarnation == 1
    member.heard(odometry(2), T0)
    assert member.odometry.incarnation == 2


def test_the_next_life_knows_whom_to_believe() -> None:
    former = Member(ROBOT)
    for message in (alive(2, True), status(2), odometry(2)):
        former.heard(message, T0)
    former.locate()
    seat = former.seat(3)
    assert seat == Seat("r1", 3, 2, "r1", False)
    for incarnation, frame, believed in ((2, "r1", True), (3, "r1/3", False), (2, "r1/2", False)):
        member = Member(ROBOT, incarnation=2)
        member.heard(odometry(incarnation, frame=frame), T0)
        member.recall(seat)
        assert (member.odometry is not None) == believed
        member.heard(odometry(incarnation, frame=frame), T0)
        assert (member.odometry is not None) == believed


@pytest.mark.parametrize("host", [None, "r1", "r2"])
def test_a_robot_that_says_where_in_the_world_it_is_is_taken_to_be_there(host: str | None) -> None:
    """As one that says the same in its own frame, which begins at its pose in the scenario."""
    robots = (ROBOT, Robot(id="r2", pose=(-1.0, 0.5, 2.0), control_point_m=0.2))
    roster, own = Roster(robots, host), Pose(0.4, -0.3, 0.7)
    for robot, member in zip(robots, roster.members, strict=True):
        world = Pose(*(robot.pose or ())).compose(own)
        said = {}
        for frame, at in ((robot.id, own), ("world", world)):
            message = replace(odometry(frame=frame), x_m=at.x, y_m=at.y, psi_rad=at.psi)
            member.heard(message, T0)
            view = member.view(T0)
            assert view is not None
            turned = Pose(0.0, 0.0, at.psi).inverse().rotate(*member.mounting.velocity_in_own(0.3, -0.2))
            said[frame] = (*view.point, *turned)
        assert said["world"] == pytest.approx(said[robot.id])
        assert world.compose(Pose(robot.control_point_m, 0.0, 0.0))[:2] == pytest.approx(
            roster.frame.compose(Pose(*said["world"][:2], 0.0))[:2]
        )


def test_the_next_life_of_the_controller_believes_the_same_frame_alone() -> None:
    before = Member(ROBOT)
    before.heard(alive(1, True), T0)
    before.heard(odometry(frame="world"), T0)
    before.locate()
    seat = before.seat(0)
    assert seat.frame_id == "world"
    after = Member(ROBOT, incarnation=2)
    after.recall(seat)
    after.heard(alive(1, True), T0)
    after.heard(odometry(frame="r1"), T0)
    assert after.view(T0) is None
    after.heard(odometry(frame="world"), T0)
    view = after.view(T0)
    assert view is not None
    assert view.point == pytest.approx((0.8, 0.0))


def test_who_waits_for_something_of_his_own_is_told_of_by_himself() -> None:
    causes = {"r1": "nobody shows /r1/odom for 1.2 s", "r2": "nobody shows /r2/odom for 1.2 s"}
    assert waiting_for(causes) == (
        "waits for r1: nobody shows /r1/odom for 1.2 s; for r2: nobody shows /r2/odom for 1.2 s"
    )
    both = {"r1": "it is 1.25 s old", "r2": "it is 10.5 s old"}
    assert waiting_for(both) == "waits for r1, r2: it is 1.25 s old"


def test_robots_that_wait_for_other_vehicles_do_not_wait_for_the_same() -> None:
    heard = "no heartbeat of system {0}, component 1 yet"
    assert waiting_for({"r1": heard.format(1), "r2": heard.format(2)}).count("no heartbeat") == 2
    at = "udpin:0.0.0.0:1455{0}: nobody has come yet"
    assert waiting_for({"r1": at.format(1), "r2": at.format(2)}).count("nobody") == 2
    fix = "GNSS: no fix, {0} satellites"
    assert (
        waiting_for({"r1": fix.format(0), "r2": fix.format(4)})
        == "waits for r1, r2: GNSS: no fix, 0 satellites"
    )
