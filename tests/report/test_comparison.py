"""Quantities and figures of two runs side by side."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from maniple.cli.loading import loads
from maniple.recording.reader import read
from maniple.report.comparison import (
    Pair,
    apart,
    difference,
    error_track,
    outcome_rows,
    pairs_of,
    quantities,
    scenario_changes,
    set_out_s,
)
from maniple.report.comparison_diff import compare
from maniple.report.comparison_tolerances import Tolerances, tolerances_of
from maniple.report.samples import Track
from maniple.report.series import series_of
from tests.report.recordings import SCENE, recorded


def track(t: list[float], *columns: list[float]) -> Track:
    return Track(np.array(t), np.array(columns).T)


def test_values_are_interpolated_at_the_denser_samples() -> None:
    a = track([0.0, 1.0, 2.0], [0.0, 1.0, 2.0])
    b = track([0.5, 0.75, 1.0, 1.25, 1.5, 3.0], [0.5, 0.75, 1.0, 2.25, 1.5, 9.0])
    (row,) = apart([Pair("x", ("u_mps",), a, b)], tolerances_of(["x:u_mps=0.5"], []))
    assert (row.samples, row.largest, row.at_s, row.a, row.b) == (5, 1.0, 1.25, 1.25, 2.25)
    assert row.mean == pytest.approx(-0.2)
    assert row.rms == pytest.approx(np.sqrt(0.2))
    assert not row.within
    (same,) = apart([Pair("x", ("u_mps",), a, b)], tolerances_of(["x:*=1"], []))
    assert same.within


def test_headings_go_the_short_way_round() -> None:
    a = track([0.0, 1.0, 2.0], [3.1, 3.1, 3.1])
    b = track([0.0, 2.0], [-3.1, -3.1 - 2 * np.pi])
    _, _, _, off = difference(Pair("x", ("psi_rad",), a, b), 0)
    assert np.abs(off) == pytest.approx(np.full(3, 2 * np.pi - 6.2))


def test_breaks_are_left_out() -> None:
    a = track([0.0, 1.0, 2.0, 3.0], [0.0, np.nan, 0.0, 0.0])
    b = track([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, np.nan, 1.0])
    t, _, _, off = difference(Pair("x", ("u_mps",), a, b), 0)
    assert t.tolist() == [0.0, 3.0]
    assert off.tolist() == [-1.0, -1.0]


def test_what_only_one_has_is_not_the_same() -> None:
    none = Track(np.empty(0), np.empty((0, 1)))
    (row,) = apart([Pair("x", ("u_mps",), track([0.0], [1.0]), none)], Tolerances())
    assert (row.only, row.within, row.largest) == ("A", False, None)
    late = track([5.0, 6.0], [1.0, 1.0])
    (row,) = apart([Pair("x", ("u_mps",), track([0.0, 1.0], [1.0, 1.0]), late)], Tolerances())
    assert (row.only, row.within, row.samples) == ("", False, 0)


def test_commands_for_other_layers_are_not_compared() -> None:
    some = track([0.0], [1.0], [0.0])
    a = {"robot/r1/command": (("u_mps", "w_radps"), some), "robot/r2/command": (("u_mps", "w_radps"), some)}
    b = {"robot/r1/command": (("vx_mps", "vy_mps"), some), "robot/r3/command": (("u_mps", "w_radps"), some)}
    assert [pair.name for pair in pairs_of(a, b)] == ["robot/r2/command", "robot/r3/command"]


def test_the_worst_triangle_counts() -> None:
    one = track([0.0, 1.0], [3.0, 0.0], [4.0, 0.0], [0.1, 0.0], [0.0, 0.0], [0.2, 0.0], [-0.3, 0.0])
    other = track([1.0], [0.0], [1.0], [-0.5], [0.0], [0.0], [0.0])
    found = error_track([one, other])
    assert found.t.tolist() == [0.0, 1.0]
    assert found.values == pytest.approx(np.array([[5.0, 0.1, 0.2, 0.3], [1.0, 0.5, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = [tmp_path_factory.mktemp(name) for name in "ab"]
    return recorded(folders[0]), recorded(folders[1], "controller.kappa=0.3", "guard.gamma_per_s=2")


def test_two_runs_compared(runs: tuple[Path, Path]) -> None:
    a, b = map(read, runs)
    found = compare(a, b, Tolerances()).diff
    assert found.by == "message"
    assert not found.same
    assert [(row.field, row.a, row.b) for row in found.scenario] == [
        ("controller.kappa", 0.25, 0.3),
        ("guard.gamma_per_s", 1.0, 2.0),
    ]
    assert found.made == ()
    rows = {row.field: row for row in found.outcome}
    assert rows["completed"].within
    peak = rows["peak_error.position_m"]
    assert peak.difference == pytest.approx(peak.b - peak.a)
    assert not peak.within
    apart_by = {(row.name, row.field): row for row in found.series}
    assert 0.0 < (apart_by["robot/r2/pose", "x_m"].largest or 0.0) < 0.2
    assert {topic.topic for topic in found.messages if topic.same} >= {"faults/decisions"} - set(a.topics)
    assert json.loads(msgspec.json.encode(found))["same"] is False


def test_a_run_is_the_same_as_itself(runs: tuple[Path, Path]) -> None:
    recording = read(runs[0])
    by_message = compare(recording, recording, Tolerances()).diff
    assert by_message.same
    assert all(topic.identical == topic.a == topic.b for topic in by_message.messages)
    by_time = compare(recording, recording, Tolerances(), "time").diff
    assert by_time.same
    assert by_time.messages == ()
    assert all(row.largest == 0.0 for row in by_time.series)


def test_outcomes_are_judged_by_time(runs: tuple[Path, Path]) -> None:
    a, b = map(read, runs)
    assert not compare(a, b, Tolerances(), "time").diff.same
    assert compare(a, b, tolerances_of(["1e3"], []), "time").diff.same
    loose = tolerances_of(["1e3", "outcome:peak_error.position_m=1e-9"], [])
    assert not compare(a, b, loose, "time").diff.same
    ignored = compare(a, b, tolerances_of(["1e3"], ["outcome", "robot/*/drive"]), "time").diff
    assert ignored.same
    assert ignored.outcome == ()
    assert not any(row.name == "robot/r1/drive" for row in ignored.series)


def test_time_counts_from_when_the_platoon_set_out(runs: tuple[Path, Path]) -> None:
    recording = read(runs[0])
    series = series_of(recording)
    later = series._replace(
        phases=tuple(span._replace(begin=span.begin + 5, end=span.end + 5) for span in series.phases),
        robots=tuple(
            robot._replace(poses=robot.poses._replace(t=robot.poses.t + 5)) for robot in series.robots
        ),
    )
    assert set_out_s(later) == set_out_s(series) + 5
    pairs = pairs_of(quantities(recording, series), quantities(recording, later))
    poses = [pair for pair in pairs if pair.name.endswith("/pose")]
    assert len(poses) == 4
    assert all((row.largest or 0.0) < 1e-9 for row in apart(poses, Tolerances()))


def test_scenarios_are_compared_by_the_paths_of_set() -> None:
    a = loads(SCENE.encode())
    b = loads(
        SCENE.encode(), ["faults=[]", "robots.r3.pose=[1, 2, 3]", "world.obstacles.1.end=[9, 3]"], seed=5
    )
    found = {row.field: (row.a, row.b) for row in scenario_changes(a, b)}
    assert found["seed"] == (1, 5)
    assert found["world.obstacles.1.end.0"] == (5.0, 9.0)
    assert found["robots.r3.pose.2"][1] == 3.0
    rule, nothing = found["faults.0"]
    assert rule["loss"] == 0.2
    assert nothing is None
    assert scenario_changes(a, a) == ()


def test_figures_that_are_no_numbers_have_no_difference(runs: tuple[Path, Path]) -> None:
    figures = series_of(read(runs[0])).figures
    other = msgspec.structs.replace(figures, completed=False, lost_robots=["r2"], min_clearance_m=None)
    rows = {row.field: row for row in outcome_rows(figures, other, tolerances_of(["1e9"], []))}
    for field in ("completed", "lost_robots", "min_clearance_m"):
        assert rows[field].difference is None
        assert not rows[field].within
    assert rows["collisions"].within
