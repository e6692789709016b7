import numpy as np
import pytest

from central_controller.roster import Member, Presence, Roster
from maniple.core.messages import Alive, Message, Odometry, Scan, Status, pack_floats
from maniple.core.scenario.types import Robot
from maniple.core.time import MILLISECOND, SECOND

T0 = 100 * SECOND
ROBOT = Robot(id="r1", pose=(1.0, 2.0, 0.0), control_point_m=0.3)


def odometry(incarnation: int = 1, u: float = 0.0) -> Odometry:
    return Odometry(
        incarnation=incarnation,
        seq=7,
        stamp_ns=5,
        frame_id="r1",
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
    assert roster.views(T0) is None
    second.heard(odometry(), T0)
    assert roster.ready(T0, with_ranges=False)
    assert roster.views(T0) is not None
    assert not roster.ready(T0, with_ranges=True)
    first.heard(scan(), T0)
    second.heard(scan(), T0 + 1)
    assert roster.ready(T0, with_ranges=True)
    assert second.returns_age(T0 + 3) == 2
    second.heard(alive(1, False), T0)
    assert not roster.ready(T0, with_ranges=False)


def test_reports_are_in_the_order_of_the_chain() -> None:
    roster = Roster([Robot(id=name, pose=(0.0, 0.0, 0.0)) for name in ("z", "a", "m")])
    assert roster.ids == ("z", "a", "m")
    assert tuple(report.id for report in roster.reports(T0)) == roster.ids
