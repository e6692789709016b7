"""Platoons of which not all robots are simulated: recordings with ground truth of some robots, or none."""

import json
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from typer.testing import CliRunner, Result

from maniple.cli.outcome import figures_of
from maniple.cli.program import app
from maniple.core import codec
from maniple.core.geometry import Pose
from maniple.core.messages import Message, Odometry, Truth, pack_floats, unpack_floats
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter
from maniple.report.page import notes
from maniple.report.series import Series, outcome, series_of
from maniple.report.summary import Errors, RunFigures, magnitudes
from tests.report.recordings import recorded

IDS = ("r1", "r2", "r3", "r4")


class Seen(NamedTuple):
    log: Path
    figures: RunFigures
    series: Series


def rewritten(source: Path, target: Path, change: Callable[[Message], Message | None]) -> Seen:
    """The same recording with some of its messages others, or none."""
    recording = read(source)
    metadata = {name: value for name, value in recording.metadata.items() if name != "prefix"}
    with RecordingWriter(target, recording.scenario_json, metadata, prefix=recording.prefix) as writer:
        for record in recording.messages():
            message = record.message
            assert message is not None
            if (changed := change(message)) is not None:
                data = record.data if changed is message else codec.encode(changed)
                writer.write(*record._replace(data=data))
                writer.tick(record.log_time_ns)
    again = read(target)
    return Seen(target, figures_of([target], again.scenario), series_of(again))


def only(robots: Collection[str]) -> Callable[[Message], Message | None]:
    """Ground truth of these robots alone, as where only they have a body in the simulator."""

    def change(message: Message) -> Message | None:
        if not isinstance(message, Truth):
            return message
        rows = [place for place, name in enumerate(message.robots) if name in robots]
        if not rows:
            return None
        return replace(
            message,
            robots=tuple(message.robots[row] for row in rows),
            poses=pack_floats(unpack_floats(message.poses, 3)[rows]),
            velocities=pack_floats(unpack_floats(message.velocities, 2)[rows]),
            clearances=pack_floats(unpack_floats(message.clearances)[rows]),
        )

    return change


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    log = recorded(tmp_path_factory.mktemp("whole"))
    recording = read(log)
    return Seen(log, figures_of([log], recording.scenario), series_of(recording))


@pytest.fixture(scope="module", params=["r1 r2 r3", "r1 r3 r4", "r2", ""], ids=lambda ids: ids or "none")
def partial(request: pytest.FixtureRequest, whole: Seen, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    robots = request.param.split()
    return rewritten(whole.log, tmp_path_factory.mktemp("partial") / "a.mcap", only(robots))


def known(seen: Seen) -> list[str]:
    return [name for name in IDS if name not in seen.figures.without_truth]


def test_clearance_and_collisions_are_of_the_robots_with_ground_truth(whole: Seen, partial: Seen) -> None:
    figures, robots = partial.figures, known(partial)
    if not robots:
        assert (figures.collisions, figures.min_clearance_m) == (None, None)
        return
    assert figures.collisions == whole.figures.collisions
    least = min(np.nanmin(robot.clearance.values) for robot in whole.series.robots if robot.id in robots)
    assert figures.min_clearance_m == pytest.approx(least)


def test_true_errors_are_of_the_triangles_that_are_known_whole(whole: Seen, partial: Seen) -> None:
    figures, robots = partial.figures, known(partial)
    assert figures.estimated_final_error == whole.figures.estimated_final_error
    chain = whole.series.triangles[0].robots
    for triangle, full in zip(partial.series.triangles, whole.series.triangles, strict=True):
        assert triangle.robots == full.robots
        assert bool(len(triangle.true.t)) == (set(triangle.robots) <= set(robots))
        assert np.isfinite(triangle.seen.values).any()
    if not set(chain) <= set(robots):
        assert figures.final_error == figures.peak_error == Errors()
        return
    track = whole.series.triangles[0].true
    end_s = next(span.begin for span in whole.series.phases if span.what == "done")
    late = (track.t > end_s - 1.0) & (track.t <= end_s + 1e-9) & np.isfinite(track.values[:, 0])
    expected = magnitudes(track.values[late][:, None]).mean(axis=0)
    assert msgspec.structs.astuple(figures.final_error) == pytest.approx(expected, rel=1e-6)


def test_drift_is_of_those_that_can_be_compared(whole: Seen, partial: Seen) -> None:
    if not known(partial):
        assert partial.figures.odometry_drift_m is None
    else:
        assert whole.figures.odometry_drift_m is not None
        assert partial.figures.odometry_drift_m is not None
        assert 0.0 < partial.figures.odometry_drift_m <= whole.figures.odometry_drift_m + 1e-9


def test_what_no_truth_tells_does_not_change(whole: Seen, partial: Seen) -> None:
    for name in ("completed", "messages", "command_age_ms", "lost_robots"):
        assert getattr(partial.figures, name) == getattr(whole.figures, name)
    assert partial.figures.duration_s == pytest.approx(whole.figures.duration_s, abs=0.2)


def test_the_report_says_of_whom_there_is_no_ground_truth(partial: Seen, tmp_path: Path) -> None:
    said = " ".join(notes(partial.series, describe(read(partial.log))))
    without = ", ".join(partial.figures.without_truth)
    if known(partial):
        assert f"There is no ground truth of {without}: " in said
        clean = f"without a collision as far as ground truth tells (none of {without})"
        assert clean in outcome(partial.series)
    else:
        assert "There is no ground truth: " in said
        assert "with no ground truth to tell collisions" in outcome(partial.series)
    assert [robot.true for robot in partial.series.robots] == [name in known(partial) for name in IDS]


@pytest.mark.parametrize("form", ["foxglove", "csv", "rerun"])
def test_every_form_takes_it(partial: Seen, tmp_path: Path, form: str) -> None:
    found = invoke("log", "export", partial.log, "--to", form, "--out", tmp_path / "out")
    assert found.exit_code == 0, (found.output, found.exception)


@pytest.mark.slow
def test_the_report_is_drawn(whole: Seen, tmp_path: Path) -> None:
    log = rewritten(whole.log, tmp_path / "a.mcap", only(("r1", "r2", "r3"))).log
    found = invoke("report", log, "--out", tmp_path / "out")
    assert found.exit_code == 0, (found.output, found.exception)
    page = (tmp_path / "out" / "index.html").read_text()
    assert "There is no ground truth of r4: " in page
    assert "Without ground truth nobody knows how near" not in page


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_it_can_be_compared_with_the_whole(whole: Seen, partial: Seen) -> None:
    found = invoke("log", "diff", whole.log, partial.log, "--json")
    assert found.exit_code == 1, (found.output, found.exception)
    json.loads(found.stdout)


def test_odometry_in_the_world_is_not_moved_by_the_initial_pose(whole: Seen, tmp_path: Path) -> None:
    """Against the same run in own frames: drift, and ways where there is no truth."""
    origins = {robot.id: Pose(*(robot.pose or ())) for robot in whole.series.scenario.robots}

    def change(message: Message) -> Message | None:
        if isinstance(message, Truth):
            return only(("r1", "r2", "r3"))(message)
        if not isinstance(message, Odometry):
            return message
        there = origins[message.source].compose(Pose(message.x_m, message.y_m, message.psi_rad))
        return replace(message, frame_id="world", x_m=there.x, y_m=there.y, psi_rad=there.psi)

    own = rewritten(whole.log, tmp_path / "own.mcap", only(("r1", "r2", "r3")))
    world = rewritten(whole.log, tmp_path / "world.mcap", change)
    assert world.figures.odometry_drift_m == pytest.approx(own.figures.odometry_drift_m)
    np.testing.assert_allclose(
        world.series.robots[3].poses.values[:, :2], own.series.robots[3].poses.values[:, :2], atol=1e-9
    )
    assert len(world.series.robots[3].poses.t) > 100
