"""Pictures of two runs: they are there, the same every time, and only what there is to see."""

from pathlib import Path

import numpy as np
import pytest

from maniple.core.errors import ArgumentError
from maniple.report.comparison import Pair
from maniple.report.comparison_plot import commands, differences, drives, formation, write
from maniple.report.samples import Track

T = np.linspace(0.0, 10.0, 101)
NAMES = ("a.mcap", "b.mcap")


def pair(name: str, fields: tuple[str, ...], off: float) -> Pair:
    values = np.column_stack([np.sin(T + column) for column in range(len(fields))])
    return Pair(name, fields, Track(T, values), Track(T, values + off))


def pairs(count: int, off: float = 0.01) -> list[Pair]:
    found = [pair("formation/error", ("position_m", "orientation_rad", "distance_m", "angle_rad"), off)]
    for index in range(count):
        found.append(pair(f"robot/r{index + 1}/pose", ("x_m", "y_m", "psi_rad"), off))
        found.append(pair(f"robot/r{index + 1}/drive", ("u_mps", "w_radps", "v_mps"), off))
        found.append(pair(f"robot/r{index + 1}/clearance", ("distance_m",), off))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 12])
def test_all_pictures_are_written(tmp_path: Path, count: int) -> None:
    written = write(pairs(count), NAMES, tmp_path / "plots")
    assert [path.name for path in written[::2]] == ["formation.png", "drives.png", "differences.png"]
    first = [path.read_bytes() for path in written]
    again = write(pairs(count), NAMES, tmp_path / "plots")
    assert [path.read_bytes() for path in again] == first


def test_where_nothing_differs_there_is_no_picture_of_differences(tmp_path: Path) -> None:
    (tmp_path / "differences.png").write_bytes(b"old")
    written = write(pairs(3, 0.0), NAMES, tmp_path)
    assert [path.stem for path in written[::2]] == ["formation", "drives"]
    assert not (tmp_path / "differences.png").exists()


def test_what_there_is_not_is_not_drawn() -> None:
    assert formation([], NAMES) is None
    assert commands([], NAMES) is None
    assert drives([], NAMES) is None
    assert differences([], NAMES) is None


def test_a_run_that_lacks_a_quantity_is_drawn_without() -> None:
    def empty(track: Track) -> Track:
        return Track(track.t[:0], track.values[:0])

    assert formation([one._replace(b=empty(one.b)) for one in pairs(3)], NAMES) is not None
    assert drives([one._replace(a=empty(one.a)) for one in pairs(3)], NAMES) is not None
    assert differences([one._replace(a=empty(one.a)) for one in pairs(3)], NAMES) is None


def test_the_clearance_drawn_is_the_least_of_all_robots() -> None:
    near, far = (
        pair("robot/r1/clearance", ("distance_m",), 0.0),
        pair("robot/r2/clearance", ("distance_m",), 0.0),
    )
    far = far._replace(a=Track(T[::2], far.a.values[::2] + 5.0))
    figure = formation([near, far], NAMES)
    assert figure is not None
    assert figure.axes[0].lines[0].get_ydata() == pytest.approx(near.a.values[:, 0])


def test_a_file_in_the_way_is_one_message(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    with pytest.raises(ArgumentError, match="not a folder"):
        write(pairs(3), NAMES, tmp_path / "x")


def test_only_robots_that_both_runs_have_are_in_the_legend() -> None:
    found = pairs(3)
    found[1:4] = [one._replace(a=Track(one.a.t[:0], one.a.values[:0])) for one in found[1:4]]
    figure = differences(found, NAMES)
    assert figure is not None
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["r2", "r3"]


def test_an_axis_of_differences_is_at_least_a_decade() -> None:
    figure = differences(pairs(3), NAMES)
    assert figure is not None
    for axes in figure.axes:
        low, high = axes.get_ylim()
        assert high > 10 * low
