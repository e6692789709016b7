import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
import shapely
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore

from maniple.core.geometry import Pose
from maniple.core.messages import FormationState, Mission, Odometry, Scan, Status, Truth, unpack_floats
from maniple.core.scenario.types import Circle, Waypoints
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.recording.ros2 import Names, Said, Translation
from maniple.recording.ros2.translation import way_poses
from maniple.recording.viz.viewer import Viewer
from tests.recording.viz.pictures import Seen, run

TYPES = get_typestore(Stores.ROS2_JAZZY)
WORLD = "world"


def translation() -> Translation:
    return Translation(run().scenario, Names(run().scenario), VIRTUAL_EPOCH)


@cache
def said() -> tuple[Said, ...]:
    made = translation()
    return tuple(one for seen in run().seen for one in made.see(*seen))


def on(name: str) -> list[Said]:
    return [one for one in said() if one.topic.name == name]


def place(transform: Any) -> Pose:
    return Pose(transform.translation.x, transform.translation.y, heading(transform.rotation))


def pose(of: Any) -> Pose:
    return Pose(of.position.x, of.position.y, heading(of.orientation))


def heading(turn: Any) -> float:
    assert (turn.x, turn.y) == (0.0, 0.0)
    assert turn.z**2 + turn.w**2 == pytest.approx(1.0)
    return 2 * math.atan2(turn.z, turn.w)


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec * SECOND + message.header.stamp.nanosec)


class Tree:
    """The frames as tf2 keeps them: the newest of each child."""

    def __init__(self) -> None:
        self.parents: dict[str, tuple[str, Pose]] = {}

    def hear(self, message: Any) -> None:
        for one in message.transforms:
            self.parents[one.child_frame_id] = one.header.frame_id, place(one.transform)

    def in_world(self, frame: str) -> Pose:
        at = Pose(0.0, 0.0, 0.0)
        while frame != WORLD:
            frame, of_parent = self.parents[frame]
            at = of_parent.compose(at)
        return at


def told() -> Iterator[tuple[Tree, Said]]:
    tree = Tree()
    for one in said():
        if one.topic.name in ("/tf", "/tf_static"):
            tree.hear(one.message)
        yield tree, one


def test_every_message_is_one_of_its_topics_type_and_survives_cdr() -> None:
    for one in said():
        assert one.message.__msgtype__ == one.topic.type
        data = TYPES.serialize_cdr(one.message, one.topic.type)
        again = TYPES.deserialize_cdr(data, one.topic.type)
        assert TYPES.serialize_cdr(again, one.topic.type) == data


def test_every_topic_but_what_a_sensor_has_not_is_heard() -> None:
    names = Names(run().scenario)
    sonar = {"r2"}
    silent = {topic.name for topic in names} - {one.topic.name for one in said()}
    assert silent == {
        *(names.points[one.id].name for one in run().scenario.robots if one.id not in sonar),
        *(names.scan[one].name for one in sonar),
    }


def test_frames_are_where_viewers_have_the_robots() -> None:
    """An independent composition of tf's frames against the viewer's frame in the world."""
    viewer = Viewer(run().scenario, VIRTUAL_EPOCH)
    for seen in run().seen:
        if not isinstance(seen.message, Scan):
            viewer.see(*seen)
    checked = Counter[str]()
    for tree, one in told():
        if one.topic.name.endswith("/pose"):
            robot = one.topic.name.split("/")[2]
            assert tree.in_world(f"{robot}/base_link") == pytest.approx(pose(one.message.pose), abs=1e-9)
            checked[robot] += 1
    assert set(checked) == {"r1", "r2", "r3", "r4"}
    for name in checked:
        last = viewer._robots[name].believed
        assert last is not None
        at = pose(on(f"/maniple/{name}/pose")[-1].message.pose)
        assert at == pytest.approx(last, abs=1e-9)


def test_what_scans_see_is_where_the_obstacles_are() -> None:
    """Through the frames to the world, against the obstacle's outline; robots see each other, too."""
    (post,) = [one for one in run().scenario.world.obstacles if isinstance(one, Circle)]
    ring = shapely.Point(*post.centre).buffer(post.radius_m).exterior
    near = 0
    for tree, one in told():
        if one.topic.name == "/maniple/r1/scan":
            scan = one.message
            at = tree.in_world(scan.header.frame_id)
            angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
            assert scan.angle_max == pytest.approx(angles[-1], abs=1e-6)
            for angle, distance in zip(angles, scan.ranges, strict=True):
                if math.isfinite(distance):
                    x, y, _ = at.compose(Pose(distance * math.cos(angle), distance * math.sin(angle), 0.0))
                    if math.hypot(x - post.centre[0], y - post.centre[1]) < 0.35:
                        assert ring.distance(shapely.Point(x, y)) < 0.12
                        near += 1
    assert near > 100


def test_ranges_are_as_rep_117_says() -> None:
    scan = Scan(
        source="r1",
        first_angle_rad=-1.0,
        increment_rad=0.5,
        range_min_m=0.1,
        range_max_m=4.0,
        mount=(0.1, 0.0, 0.0),
        ranges=np.array([0.05, 0.1, 3.9, 4.0, 9.0], dtype="<f4").tobytes(),
    )
    *_, heard = translation().see("robot/r1/ranges", scan, VIRTUAL_EPOCH)
    expected = np.array([-np.inf, 0.1, 3.9, np.inf, np.inf], dtype=np.float32)
    np.testing.assert_array_equal(heard.message.ranges, expected)
    assert (heard.message.range_min, heard.message.range_max) == (0.1, 4.0)


def test_sonars_are_points_where_their_echoes_are() -> None:
    scans = [scan for _, scan in run().of(Scan, "robot/r2/ranges")]
    clouds = [one.message for one in on("/maniple/r2/points")]
    assert len(scans) == len(clouds)
    for scan, cloud in zip(scans, clouds, strict=True):
        echoes = unpack_floats(scan.ranges)
        beams = unpack_floats(scan.beams, 3)
        seen = echoes < scan.range_max_m
        points = np.frombuffer(cloud.data.tobytes(), dtype="<f4").reshape(-1, 3)
        assert cloud.width == len(points) == seen.sum()
        x = beams[seen, 0] + echoes[seen] * np.cos(beams[seen, 2])
        y = beams[seen, 1] + echoes[seen] * np.sin(beams[seen, 2])
        np.testing.assert_allclose(points[:, :2], np.stack([x, y], axis=-1), atol=1e-5)


def test_odometry_is_what_the_robot_said() -> None:
    for (time, odometry), one in zip(
        run().of(Odometry, "robot/r1/odometry"), on("/maniple/r1/odom"), strict=True
    ):
        message = one.message
        own = Pose(odometry.x_m, odometry.y_m, odometry.psi_rad)
        assert pose(message.pose.pose) == pytest.approx(own, abs=1e-9)
        assert (message.twist.twist.linear.x, message.twist.twist.angular.z) == (
            odometry.u_mps,
            odometry.w_radps,
        )
        assert (message.header.frame_id, message.child_frame_id) == ("r1/odom", "r1/base_link")
        assert stamp(message) == time == one.time


def test_truth_is_in_the_world() -> None:
    truths = [truth for _, truth in run().of(Truth)]
    for truth, one in zip(truths, on("/maniple/r3/true_pose"), strict=True):
        row = unpack_floats(truth.poses, 3)[truth.robots.index("r3")]
        assert pose(one.message.pose) == pytest.approx(tuple(row), abs=1e-6)
        assert one.message.header.frame_id == WORLD


def test_static_frames_are_told_all_at_once() -> None:
    """Who comes later is given the last message only."""
    *_, last = on("/tf_static")
    assert last.topic.latched
    children = {one.child_frame_id for one in last.message.transforms}
    assert children == {f"r{k}/{part}" for k in (1, 2, 3, 4) for part in ("odom", "laser")}


def test_a_robot_whose_frame_nobody_knows_has_no_frame() -> None:
    made = translation()
    seen: defaultdict[str, int] = defaultdict(int)
    for one in run().seen:
        message = one.message
        if one.topic == "robot/r3/status" and isinstance(message, Status):
            message = replace(message, localised=False)
        if one.topic == "robot/r3/odometry" and isinstance(message, Odometry):
            message = replace(message, frame_id="r3#another")
        if isinstance(message, Mission):
            message = replace(
                message, seats=tuple(replace(seat, frame_id="r3#first") for seat in message.seats)
            )
        for told in made.see(one.topic, message, one.time):
            seen[told.topic.name] += told.topic.name != "/tf" or any(
                transform.child_frame_id == "r3/base_link" for transform in told.message.transforms
            )
    assert seen["/maniple/r3/odom"] > 100
    assert seen["/maniple/r3/pose"] == seen["/tf"] <= 10  # before the first status and mission


def test_a_robot_that_knows_where_in_the_world_it_is_has_its_odometry_frame_there() -> None:
    told = Odometry(source="r4", frame_id="world", x_m=3.0, y_m=-2.0, psi_rad=0.5, u_mps=0.0, w_radps=0.0)
    tree = Tree()
    for one in translation().see("robot/r4/odometry", told, VIRTUAL_EPOCH):
        if one.topic.type == "tf2_msgs/msg/TFMessage":
            tree.hear(one.message)
    assert tree.parents["r4/odom"] == (WORLD, Pose(0.0, 0.0, 0.0))
    assert tree.in_world("r4/base_link") == pytest.approx((3.0, -2.0, 0.5))


def test_markers_are_what_viewers_draw_and_what_goes_is_deleted() -> None:
    """r2 stands by an emergency stop for two seconds, and has a ring then."""
    made, shown, most = translation(), dict[tuple[str, int], Any](), 0
    middle = run().seen[0].time + 4 * SECOND
    for seen in run().seen:
        message = seen.message
        if seen.topic == "robot/r2/status" and isinstance(message, Status):
            stopped = abs(seen.time - middle) < SECOND
            message = replace(message, mode="emergency" if stopped else "tracking", guard="none")
        for one in made.see(seen.topic, message, seen.time):
            if one.topic.name != "/maniple/robots/markers":
                continue
            for marker in one.message.markers:
                if marker.action == marker.DELETE:
                    del shown[marker.ns, marker.id]
                else:
                    shown[marker.ns, marker.id] = marker
            most = max(most, sum(name == "r2" for name, _ in shown))
    assert most == 4
    now = Counter(name for name, _ in shown)
    assert (now["r1"], now["r2"], now["r2/true"]) == (3, 3, 1)
    body = shown["r1", 0]
    assert (body.header.frame_id, body.type, body.frame_locked) == ("r1/base_link", body.CUBE, True)
    model = run().scenario.model_of(run().scenario.robots[0])
    assert (body.scale.x, body.scale.y) == (model.length_m, model.width_m)
    assert shown["r2", 2].text == "r2"


def test_obstacles_and_formation_stand_in_the_world() -> None:
    stones = on("/maniple/obstacles/markers")[0].message.markers
    assert {marker.header.frame_id for marker in stones} == {WORLD}
    assert Counter(marker.type for marker in stones) == {1: 2, 3: 1, 11: 1}
    shape = on("/maniple/formation/markers")[-1].message.markers
    assert {marker.ns for marker in shape} == {"desired", "actual"}
    assert all(marker.lifetime.sec * SECOND + marker.lifetime.nanosec == SECOND for marker in shape)
    (fill,) = [marker for marker in shape if marker.type == marker.TRIANGLE_LIST]
    assert len(fill.points) == 3 * 2


def test_the_way_is_that_of_the_task() -> None:
    (way,) = on("/maniple/formation/path")
    assert way.topic.latched
    poses = [pose(one.pose) for one in way.message.poses]
    assert [round(one.x, 6) for one in poses] == [round(0.1 * k, 6) for k in range(16)]
    assert all(one.y == one.psi == 0.0 for one in poses)


def test_a_long_way_has_no_more_poses_than_fit() -> None:
    far = Waypoints(points=((0.0, 0.0), (1e4, 0.0), (1e4, 1e4)), speed_mps=1.0)
    poses = way_poses(far)
    assert len(poses) == 1001
    assert poses[-1][:2] == pytest.approx((1e4, 1e4))


def test_errors_and_reference_are_those_of_the_state() -> None:
    states = [state for _, state in run().of(FormationState)]
    with_errors = [state for state in states if state.errors]
    for state, one in zip(with_errors, on("/maniple/formation/errors"), strict=True):
        rows, columns = (dim.size for dim in one.message.layout.dim)
        assert columns == 6
        np.testing.assert_allclose(
            one.message.data.reshape(rows, columns), unpack_floats(state.errors, 6), atol=1e-7
        )
    origin = Pose(-1.7, -1.0, 0.3)  # of r4, in whose frame the controller works
    for state, one in zip(states, on("/maniple/formation/reference"), strict=True):
        assert pose(one.message.pose) == pytest.approx(origin.compose(Pose(*state.reference)), abs=1e-9)


def test_diagnostics_say_who_is_how() -> None:
    found = [one.message.status[0] for one in on("/diagnostics")]
    assert {one.name for one in found} == {"maniple: formation", *(f"maniple: r{k}" for k in (1, 2, 3, 4))}
    levels = {(one.message.split(":")[0], one.level) for one in found if one.hardware_id == "r1"}
    assert ("tracking", 0) in levels
    gone = [one for one in found if one.name == "maniple: formation" and one.level]
    assert gone
    assert {value.key for value in gone[-1].values} >= {"phase", "waits for", "r2 is", "emergency stop"}


def test_the_log_tells_what_happens() -> None:
    lines = [one.message for one in on("/rosout")]
    assert any(line.msg.startswith("running") and line.level == 20 for line in lines)
    assert all(line.name.startswith("maniple.") for line in lines)


def test_stamps_may_be_those_of_another_clock() -> None:
    ahead = 5 * SECOND
    made = Translation(
        run().scenario, Names(run().scenario), VIRTUAL_EPOCH, stamp_of=lambda time: time + ahead
    )
    for seen in run().seen[:200]:
        for one in made.see(*seen):
            assert one.time == seen.time
            if hasattr(one.message, "header"):
                assert stamp(one.message) == seen.time + ahead


def test_it_tells_anew_what_does_not_change() -> None:
    made = translation()
    half = len(run().seen) // 2
    for seen in run().seen[:half]:
        for _ in made.see(*seen):
            pass
    made.begin()
    topics = {one.topic.name for seen in run().seen[half:] for one in made.see(*seen)}
    latched = {"/tf_static", "/maniple/formation/path", "/maniple/obstacles/markers"}
    assert latched | {"/maniple/robots/markers"} <= topics


def test_a_word_of_somebody_else_says_nothing() -> None:
    made = translation()
    forged = next(one for one in run().seen if one.topic == "robot/r1/odometry")
    message = replace(forged.message, source="r2")
    assert not [*made.see(forged.topic, message, forged.time)]


def test_only_what_matters_is_wanted() -> None:
    made = translation()
    wanted = ("robot/r1/odometry", "robot/r1/ranges", "hw/r1/drive", "formation/mission", "platoon/stop")
    assert all(made.wants(name) for name in wanted)
    assert not any(
        made.wants(name)
        for name in ("hw/r1/scan", "sim/r1/drive", "robot/r9/odometry", "journal/r1", "nothing")
    )


def test_the_same_messages_say_the_same() -> None:
    again = translation()
    data = [
        (one.topic.name, TYPES.serialize_cdr(one.message, one.topic.type))
        for seen in run().seen
        for one in again.see(*Seen(*seen))
    ]
    assert data == [(one.topic.name, TYPES.serialize_cdr(one.message, one.topic.type)) for one in said()]
