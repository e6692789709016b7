"""Arrays from the recording of a run, against the messages in it."""

from pathlib import Path

import numpy as np
import pytest

from maniple.core.messages import Drive, FormationState, Truth, unpack_floats
from maniple.core.time import to_seconds
from maniple.recording.reader import read
from maniple.report.samples import Track
from maniple.report.series import Series, outcome, series_of
from maniple.report.truth import control_points
from tests.report.recordings import filtered, recorded


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("series"))


@pytest.fixture(scope="module")
def series(log: Path) -> Series:
    return series_of(read(log))


def at(track: Track, t: float) -> np.ndarray:
    return np.array([np.interp(t, track.t, column) for column in track.values.T])


def test_how_it_ended(series: Series) -> None:
    assert series.figures.completed
    assert outcome(series) == f"Completed in {series.figures.duration_s:.1f} s, without a collision."
    assert series.task_share == 1.0
    assert [span.what for span in series.phases] == ["waiting", "running", "done"]
    assert series.figures.odometry_drift_m == pytest.approx(0.0, abs=1e-3)
    assert series.figures.lost_robots == []


def test_poses_and_velocities_are_those_of_the_ground_truth(log: Path, series: Series) -> None:
    truths = [message for _, message in read(log).decoded(Truth)]
    poses = np.array([unpack_floats(message.poses, 3) for message in truths])
    clearances = np.array([unpack_floats(message.clearances) for message in truths])
    for index, robot in enumerate(series.robots):
        assert robot.poses.values == pytest.approx(poses[:, index])
        assert robot.clearance.values[:, 0] == pytest.approx(clearances[:, index])
        assert robot.poses.t[0] == to_seconds(truths[0].stamp_ns - series.begin)
        speed = np.hypot(*np.gradient(poses[:, index, :2], robot.poses.t, axis=0).T)
        assert np.abs(robot.real.values[:, 0]) == pytest.approx(speed, abs=0.02)


def test_drives_follow_what_they_are_told(log: Path, series: Series) -> None:
    told = [m for _, m in read(log).decoded(Drive) if m.source == "r2"]
    assert series.robots[1].commanded.values[:, :2].tolist() == [[m.u_mps, m.w_radps] for m in told]
    for robot in series.robots:
        assert at(robot.commanded, 8.0)[0] == pytest.approx(at(robot.real, 8.0)[0], abs=0.02)


def test_the_controller_sees_the_truth_where_nothing_slips(series: Series) -> None:
    assert [one.robots for one in series.triangles] == [("r1", "r2", "r3"), ("r2", "r3", "r4")]
    for triangle in series.triangles:
        for t in (3.0, 8.0, 15.0):
            assert at(triangle.seen, t) == pytest.approx(at(triangle.true, t), abs=5e-3)


def test_snapshots(series: Series) -> None:
    start, worst, end = series.snapshots
    assert (start.name, worst.name, end.name) == ("start", "most deformed", "end")
    assert start.t < worst.t < end.t
    assert start.triangles == ((0, 1, 2), (1, 2, 3))
    assert end.points == pytest.approx(control_points(end.poses, series.scenario))
    assert end.poses[:, 0] - start.poses[:, 0] == pytest.approx(1.5, abs=0.05)
    deformed = max(np.abs(at(one.true, worst.t)[3:5]).max() for one in series.triangles)
    assert (
        deformed >= 0.9 * max(np.nanmax(np.abs(one.true.values[:, 3:5])) for one in series.triangles) - 0.02
    )


def test_the_way_of_the_reference(series: Series) -> None:
    assert series.path[0] == pytest.approx([0.0, 0.0])
    assert series.path[-1] == pytest.approx([1.5, 0.0])


def test_the_network(series: Series) -> None:
    commands = [link for link in series.links if link.topic.endswith("/command")]
    assert {link.destination for link in commands} == {"r1", "r2", "r3", "r4"}
    for link in series.links:
        assert link.sent >= link.delivered + link.lost_injected + link.lost_other
    totals = series.figures.messages
    assert sum(link.sent for link in series.links) == totals.sent
    assert sum(link.lost_injected for link in series.links) == totals.lost_injected > 0
    shares = {share.kind: share for share in series.shares}
    assert np.nanmean(shares["command"].shares) == pytest.approx(0.8, abs=0.08)
    assert np.nanmin(shares["odometry"].shares) == 1.0


def test_what_is_adapted(series: Series) -> None:
    theta = series.scenario.model_of(series.scenario.robots[0]).theta
    for robot in series.robots:
        assert robot.compensation.values[0] == pytest.approx(theta, rel=0.3)
        assert robot.age.values.shape[1] == 2
        assert (robot.age.values[:, 1] >= robot.age.values[:, 0]).all()
        assert 0 < robot.hold_s <= robot.stop_s
        assert "tracking" in {span.what for span in robot.modes}


def test_without_ground_truth_the_robots_are_where_they_believe_to_be(
    log: Path, series: Series, tmp_path: Path
) -> None:
    blind = series_of(read(filtered(log, tmp_path / "blind.mcap", lambda m: m.topic != "sim/truth")))
    assert not blind.true
    shift = to_seconds(blind.begin - series.begin)
    for believed, real in zip(blind.robots, series.robots, strict=True):
        assert not len(believed.clearance.t)
        assert at(believed.poses, 8.0) == pytest.approx(at(real.poses, 8.0 + shift), abs=0.02)
    assert [shot.name for shot in blind.snapshots] == ["start", "end"]
    assert all(not len(triangle.true.t) for triangle in blind.triangles)
    assert outcome(blind).endswith("s, with no ground truth to tell collisions.")


def test_a_controller_that_dies_leaves_a_gap(log: Path, tmp_path: Path) -> None:
    def lived(record: object) -> bool:
        t = to_seconds(record.publish_time_ns - begin)  # type: ignore[attr-defined]
        return record.topic != "formation/state" or not 4 < t < 9  # type: ignore[attr-defined]

    begin = next(m.stamp_ns for _, m in read(log).decoded(FormationState))
    torn = series_of(read(filtered(log, tmp_path / "torn.mcap", lived)))
    assert [span.what for span in torn.phases] == ["waiting", "running", "running", "done"]
    assert np.isnan(torn.triangles[0].seen.values).any()


def test_what_can_not_be_read_is_counted(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "odd.mcap"
    names = {"robot/r1/status": "robot/r1/mood", "robot/r2/odometry": "robot/r2/status"}
    records = [m._replace(topic=names.get(m.topic, m.topic)) for m in read(log).messages()]
    filtered(log, tmp_path / "empty.mcap", lambda m: False)
    recording = read(log)
    from maniple.recording.writer import RecordingWriter

    with RecordingWriter(target, recording.scenario_json, {"seed": "1"}, prefix="maniple") as writer:
        for record in records:
            writer.write(*record)
    found = series_of(read(target)).unreadable
    assert set(found) == {"robot/r1/mood", "robot/r2/status"}
    assert series_of(read(tmp_path / "empty.mcap")).end_s == 0.0
