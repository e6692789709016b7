import json
import math
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message as Proto
from google.protobuf.timestamp_pb2 import Timestamp
from msgspec.structs import replace

from central_controller.triangle import f
from maniple.core.geometry import Floats, Pose, rotation
from maniple.core.messages import (
    Drive,
    FormationState,
    Mission,
    Odometry,
    Scan,
    Seat,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.types import Guard
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.recording.viz import Drawn, Viewer
from maniple.report.truth import desired_points, estimated_poses, origin_of
from tests.recording.viz.pictures import Seen, draw, drawn, run

P = TypeVar("P", bound=Proto)


def read(key: str, kind: type[P], pictures: tuple[Drawn, ...] | None = None) -> list[tuple[int, P]]:
    """The messages of one channel, with their times."""
    return [(one.time_ns, kind.FromString(one.data)) for one in pictures or drawn() if one.key == key]


def numbers(key: str) -> list[tuple[int, dict[str, Any]]]:
    return [(one.time_ns, json.loads(one.data)) for one in drawn() if one.key == key]


def ns(stamp: Timestamp) -> int:
    return int(stamp.seconds * SECOND + stamp.nanos)


def flat(points: Iterable[Point3]) -> Floats:
    return np.array([(one.x, one.y) for one in points])


def heading(rotation: Any) -> float:
    return 2 * math.atan2(rotation.z, rotation.w)


def test_the_same_messages_make_the_same_bytes() -> None:
    assert tuple(draw(run().scenario, run().seen)) == drawn()


def test_all_is_drawn_on_known_channels() -> None:
    keys = {channel.key for channel in Viewer(run().scenario).channels}
    used = {one.key for one in drawn()}
    assert keys - used == {"/viz/scan/r2"}  # sonars are no fan
    assert used <= keys


def test_times_are_log_times_in_order() -> None:
    times = [one.time_ns for one in drawn()]
    assert times == sorted(times)
    assert set(times) <= {one.time for one in run().seen}


def test_frames_are_where_dead_reckoning_and_truth_say() -> None:
    scenario = run().scenario
    origins = {robot.id: Pose(*(robot.pose or ())) for robot in scenario.robots}
    odometry = {(one.source, time): one for time, one in run().of(Odometry)}
    truth = dict(run().of(Truth))
    found: defaultdict[str, int] = defaultdict(int)
    for time, message in read("/viz/tf", FrameTransforms):
        for one in message.transforms:
            stamp, child = ns(one.timestamp), one.child_frame_id
            at = one.translation.x, one.translation.y, heading(one.rotation)
            assert stamp <= time
            assert one.translation.z == 0.0
            name, _, what = child.partition("/")
            if what == "sensor":
                assert one.parent_frame_id == name
                assert at == pytest.approx((0.1, 0.02, 0.1) if name == "r3" else at)
            elif what == "true":
                assert one.parent_frame_id == "world"
                said = truth[stamp]
                assert at == pytest.approx(unpack_floats(said.poses, 3)[said.robots.index(name)])
            else:
                assert one.parent_frame_id == "world"
                heard = odometry[name, stamp]
                own = np.array([[heard.x_m, heard.y_m, heard.psi_rad]])
                assert at == pytest.approx(estimated_poses(origins[name], own)[0])
            found[child] += 1
    assert len(found) == 12
    assert min(found.values()) > 50


def test_every_message_of_frames_has_all_robots() -> None:
    """A viewer that jumps to a time gets the last message before it, no more."""
    for time, message in read("/viz/tf", FrameTransforms)[3:]:
        assert len({one.child_frame_id for one in message.transforms}) == 12, time


def test_frames_have_a_steady_pace() -> None:
    times = np.array([time for time, _ in read("/viz/tf", FrameTransforms)[1:]])
    assert np.diff(times).min() >= 90 * MILLISECOND
    assert np.diff(times).max() < 200 * MILLISECOND


def test_a_frame_that_nobody_knows_is_not_drawn() -> None:
    scenario = run().scenario
    told = Odometry(source="r1", frame_id="r1", x_m=1.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0)
    lost = replace(told, frame_id="r1/2", x_m=9.0, seq=1)
    frames = tuple(
        draw(
            scenario,
            [
                Seen("robot/r1/odometry", lost, SECOND),
                Seen(
                    "formation/mission",
                    Mission(source="controller", number=1, stage="running", seats=(Seat("r1", 0, 1, "r1"),)),
                    2 * SECOND,
                ),
                Seen("robot/r1/odometry", told, 3 * SECOND),
                Seen("robot/r1/odometry", lost, 4 * SECOND),
            ],
        )
    )
    x, y, _ = Pose(*(scenario.robots[0].pose or ())).compose(Pose(1.0, 0.0, 0.0))
    _, last = read("/viz/tf", FrameTransforms, frames)[-1]
    at = last.transforms[0].translation
    assert (at.x, at.y) == pytest.approx((x, y))
    assert ns(last.transforms[0].timestamp) == 3 * SECOND


def test_a_robot_that_knows_where_in_the_world_it_is_is_there() -> None:
    told = Odometry(
        source="r4", frame_id="world", x_m=3.0, y_m=-2.0, psi_rad=0.5, u_mps=0.0, w_radps=0.0, stamp_ns=1
    )
    pictures = tuple(draw(run().scenario, [Seen("robot/r4/odometry", told, SECOND)]))
    frames = {one.child_frame_id: one for one in read("/viz/tf", FrameTransforms, pictures)[0][1].transforms}
    here = frames["r4"]
    assert (here.translation.x, here.translation.y) == (3.0, -2.0)
    assert heading(here.rotation) == pytest.approx(0.5)


def test_an_unlocalised_robot_stays_where_it_was_seen() -> None:
    told = Odometry(source="r1", frame_id="r1", x_m=1.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0)
    status = Status(
        source="r1",
        mode="waiting",
        guard="none",
        command_age_s=-1.0,
        command_age_max_s=-1.0,
        driver="active",
        reason="",
        counters={},
        localised=False,
    )
    frames = tuple(
        draw(
            run().scenario,
            [
                Seen("robot/r1/odometry", told, SECOND),
                Seen("robot/r1/status", status, 2 * SECOND),
                Seen("robot/r1/odometry", replace(told, x_m=5.0), 3 * SECOND),
            ],
        )
    )
    _, last = read("/viz/tf", FrameTransforms, frames)[-1]
    assert ns(last.transforms[0].timestamp) == SECOND


def test_a_forged_sender_draws_nothing() -> None:
    viewer = Viewer(run().scenario)
    told = Odometry(source="r2", frame_id="r1", x_m=1.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0)
    assert viewer.see("robot/r1/odometry", told, SECOND) == ()


def test_only_what_it_can_draw_is_wanted() -> None:
    viewer = Viewer(run().scenario)
    wanted = ("robot/r1/odometry", "robot/r1/ranges", "hw/r1/drive", "sim/truth", "formation/state")
    others = ("robot/r9/odometry", "hw/r1/scan", "sim/r1/drive", "journal/r1", "links/r1", "else/where")
    assert all(map(viewer.wants, wanted))
    assert not any(map(viewer.wants, others))


def test_points_are_where_the_ranges_end() -> None:
    scans = {(one.source, time): one for time, one in run().of(Scan)}
    for robot in ("r1", "r2", "r3"):
        clouds = read(f"/viz/points/{robot}", PointCloud)
        assert len(clouds) > 20
        for time, cloud in clouds:
            scan = scans[robot, time]
            assert cloud.frame_id == f"{robot}/sensor"
            assert cloud.point_stride == 12
            assert [field.name for field in cloud.fields] == ["x", "y", "z"]
            points = np.frombuffer(cloud.data, dtype="<f4").reshape(-1, 3)
            expected = []
            ranges = unpack_floats(scan.ranges)
            for beam, r in enumerate(ranges):
                if r < np.float32(scan.range_max_m):
                    x, y, a = (
                        unpack_floats(scan.beams, 3)[beam]
                        if scan.beams
                        else (0.0, 0.0, scan.first_angle_rad + beam * scan.increment_rad)
                    )
                    expected.append((x + r * math.cos(a), y + r * math.sin(a), 0.0))
            assert points == pytest.approx(np.reshape(expected, (-1, 3)), abs=1e-5)


def test_a_fan_has_all_its_ranges() -> None:
    scans = dict(run().of(Scan, "robot/r1/ranges"))
    fans = read("/viz/scan/r1", LaserScan)
    gaps = np.diff([time for time, _ in fans])
    assert gaps.min() >= 150 * MILLISECOND
    assert len(fans) > 30
    for time, fan in fans:
        scan = scans[time]
        ranges, told = np.array(fan.ranges), unpack_floats(scan.ranges)
        assert ns(fan.timestamp) == time
        assert fan.start_angle == scan.first_angle_rad
        assert fan.end_angle == pytest.approx(scan.first_angle_rad + scan.increment_rad * (len(told) - 1))
        assert (np.isinf(ranges) == (told >= np.float32(scan.range_max_m))).all()
        assert (ranges[np.isfinite(ranges)] == told[np.isfinite(ranges)]).all()


def test_the_formation_is_drawn_where_reports_have_it() -> None:
    """The controller works in the frame of r4, whose initial pose is turned."""
    scenario = run().scenario
    states = dict(run().of(FormationState))
    origin = origin_of("r4", scenario)
    sides = [0, 1, 1, 2, 2, 3, 0, 2, 1, 3]
    whole = 0
    for time, update in read("/viz/formation", SceneUpdate):
        state = states[time]
        shown = {entity.id: entity for entity in update.entities}
        assert all((entity.lifetime.seconds, entity.lifetime.nanos) == (1, 0) for entity in update.entities)
        points = desired_points([state], state, np.array([state.stamp_ns]), scenario)
        assert points is not None
        world = points[0] @ rotation(origin.psi).T + origin[:2]
        assert flat(shown["desired"].triangles[0].points) == pytest.approx(world)
        assert list(shown["desired"].triangles[0].indices) == [0, 1, 2, 1, 2, 3]
        assert flat(shown["desired"].lines[0].points) == pytest.approx(world[sides])
        if "actual" in shown:
            line = flat(shown["actual"].lines[0].points)
            actual = line[[0, 1, 3, 5]]
            assert (line == actual[sides]).all()
            own = (actual - origin[:2]) @ rotation(origin.psi)
            corners = np.stack([[own[j], own[j + 1], own[j + 2]] for j in range(len(own) - 2)])
            wanted = np.stack([points[0][j : j + 3] for j in range(len(own) - 2)])
            # The controller carries odometry forward to now; what is drawn is as old as it is.
            if all(0.0 <= robot.odometry_age_s < 0.1 for robot in state.roster):
                error = (f(wanted) - f(corners))[:, 3:5]
                assert error == pytest.approx(unpack_floats(state.errors, 6)[:, 3:5], abs=0.05)
            whole += 1
    assert whole > 50


def test_bodies_have_their_size_and_move_with_their_frames() -> None:
    scenario = run().scenario
    _, update = read("/viz/robots", SceneUpdate)[-1]
    shown = {entity.id: entity for entity in update.entities}
    assert len(shown) == 8
    for robot in scenario.robots:
        body, model = shown[robot.id], scenario.model_of(robot)
        assert body.frame_id == robot.id
        assert body.frame_locked
        (cube,) = body.cubes
        assert (cube.size.x, cube.size.y) == (model.length_m, model.width_m)
        assert cube.pose.position.x == model.body_offset_m
        ghost = shown[f"{robot.id}/true"]
        assert ghost.frame_id == f"{robot.id}/true"
        xs = [point.x for point in ghost.lines[0].points]
        assert max(xs) - min(xs) == pytest.approx(model.length_m)
        assert 0.5 * (max(xs) + min(xs)) == pytest.approx(model.body_offset_m)
    colours = {(e.cubes[0].color.r, e.cubes[0].color.g) for e in update.entities if e.cubes}
    assert len(colours) == 4


def test_bodies_are_told_again_only_now_and_then() -> None:
    assert len(read("/viz/robots", SceneUpdate)) < 20
    assert 2 <= len(read("/viz/obstacles", SceneUpdate)) <= 3


def test_a_robot_in_trouble_wears_a_ring() -> None:
    told = Odometry(source="r1", frame_id="r1", x_m=0.0, y_m=0.0, psi_rad=0.0, u_mps=0.0, w_radps=0.0)
    status = Status(
        source="r1",
        mode="holding",
        guard="age",
        command_age_s=4.0,
        command_age_max_s=4.0,
        driver="active",
        reason="the command is 4.0 s old",
        counters={},
    )
    seen = [
        Seen("robot/r1/odometry", told, SECOND),
        Seen("robot/r1/status", status, 2 * SECOND),
        Seen("robot/r1/status", replace(status, mode="emergency", guard="none"), 3 * SECOND),
        Seen("robot/r1/status", replace(status, mode="tracking", guard="none"), 4 * SECOND),
    ]
    pictures = tuple(draw(run().scenario, seen))
    updates = [update.entities[0] for _, update in read("/viz/robots", SceneUpdate, pictures)]
    assert [entity.texts[0].text for entity in updates] == ["r1", "r1: holding, age", "r1: emergency", "r1"]
    assert [len(entity.lines) for entity in updates] == [1, 2, 2, 1]


def test_obstacles_stand_where_they_are() -> None:
    _, update = read("/viz/obstacles", SceneUpdate)[0]
    (entity,) = update.entities
    assert entity.frame_id == "world"
    assert [(one.pose.position.x, one.size.x) for one in entity.cylinders] == [(3.4, 0.3)]
    wall, box = entity.cubes
    assert (wall.pose.position.x, wall.pose.position.y, wall.size.x) == (0.5, 3.0, 9.0)
    assert (box.size.x, box.size.y, heading(box.pose.orientation)) == pytest.approx((1, 2, 0.5))
    (prism,) = entity.triangles
    assert len(prism.points) == 8
    assert len(prism.indices) == 3 * (2 + 8)


def test_a_fence_is_drawn_round() -> None:
    scenario = replace(run().scenario, guard=Guard(fence=((-3, -3), (9, -3), (9, 4))))
    pictures = tuple(draw(scenario, run().seen[:20]))
    (line,) = read("/viz/obstacles", SceneUpdate, pictures)[0][1].entities[0].lines
    assert line.type == line.LINE_LOOP
    assert [(one.x, one.y) for one in line.points] == [(-3, -3), (9, -3), (9, 4)]


def test_a_trail_follows_the_robot() -> None:
    trails = read("/viz/trajectory/r1", PosesInFrame)
    lengths = [len(trail.poses) for _, trail in trails]
    assert lengths == sorted(lengths)
    assert trails[-1][1].frame_id == "world"
    assert lengths[-1] > 5
    steps = np.diff([(p.position.x, p.position.y) for p in trails[-1][1].poses], axis=0)
    assert np.hypot(*steps.T).min() >= 0.05
    assert np.hypot(*steps.T).max() < 0.1


def test_numbers_are_those_of_the_messages() -> None:
    odometry = run().of(Odometry, "robot/r1/odometry")
    drives = run().of(Drive, "hw/r1/drive")
    both = {"u_mps", "u_commanded_mps"}
    said = [(time, told) for time, told in numbers("/viz/scalars/robot/r1") if both <= told.keys()]
    assert len(said) > 60
    for time, told in said:
        # Of what was logged at the very same moment only a part may have been seen.
        before = [one.u_mps for t, one in odometry if t < time][-1]
        assert told["u_mps"] in (before, *(one.u_mps for t, one in odometry if t == time))
        before = [one.w_radps for t, one in drives if t < time][-1]
        assert told["w_commanded_radps"] in (before, *(one.w_radps for t, one in drives if t == time))
        assert told["clearance_m"] > 0
        assert told["state"] == "present"


def test_nothing_stale_is_plotted() -> None:
    """The agent of r2 is dead from 2 s to 3 s; ground truth and the controller go on."""
    dead = [
        one for time, one in numbers("/viz/scalars/robot/r2") if 2.8 < (time - VIRTUAL_EPOCH) / SECOND < 3
    ]
    assert dead
    for one in dead:
        assert not {"u_mps", "u_commanded_mps"} & one.keys()
        assert {"clearance_m", "state"} <= one.keys()


def test_numbers_of_the_formation() -> None:
    states = dict(run().of(FormationState))
    told = [(time, one) for time, one in numbers("/viz/scalars/formation") if "position_m" in one]
    assert len(told) > 50
    for time, one in told:
        state = states[time]
        x, y, psi, p, q, beta = np.abs(unpack_floats(state.errors, 6)).T
        assert one["phase"] == state.phase
        assert one["position_m"] == pytest.approx(np.hypot(x, y).max())
        assert one["orientation_rad"] == psi.max()
        assert one["distance_m"] == max(p.max(), q.max())
        assert one["angle_rad"] == beta.max()
    triangles = numbers("/viz/scalars/triangle/2")
    assert triangles[-1][1]["robots"] == "r2 r3 r4"


def test_the_log_tells_what_happened_once() -> None:
    lines = [(line.name, line.message, line.level) for _, line in read("/viz/log", Log)]
    assert lines.count(("faults", "r2 is killed, back after 1 s", Log.WARNING)) == 1
    assert ("r2", "r2 lives anew", Log.WARNING) in lines
    assert ("r1", "r1 tracking", Log.INFO) in lines
    assert any(name == "controller" and text.startswith("running") for name, text, _ in lines)
    assert len(lines) < 40
