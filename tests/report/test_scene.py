"""The figure of trajectories."""

import numpy as np
import pytest
from matplotlib.patches import Polygon
from msgspec.structs import replace

from maniple.core.scenario.types import Guard, Point
from maniple.recording.reader import read
from maniple.report.scene import trajectories
from maniple.report.series import Series, series_of
from tests.report.recordings import recorded

NEAR: tuple[Point, ...] = ((-3.0, -3.0), (4.0, -3.0), (4.0, 2.5), (-3.0, 2.5))
FAR: tuple[Point, ...] = ((-30.0, -3.0), (40.0, -3.0), (40.0, 25.0), (-30.0, 25.0))


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Series:
    return series_of(read(recorded(tmp_path_factory.mktemp("scene"))))


@pytest.mark.parametrize(("fence", "whole"), [(NEAR, True), (FAR, False), ((), False)], ids=str)
def test_a_fence_is_drawn_whole_where_it_is_near(
    series: Series, fence: tuple[Point, ...], whole: bool
) -> None:
    figure = trajectories(series._replace(scenario=replace(series.scenario, guard=Guard(fence=fence))))
    assert figure is not None
    for axes in figure.axes:
        corners = [patch.get_xy()[:-1].tolist() for patch in axes.patches if isinstance(patch, Polygon)]
        assert corners.count([list(point) for point in fence]) == bool(fence)
    (left, right), (low, high) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    if fence:
        inside = [left < x < right and low < y < high for x, y in fence]
        assert np.all(inside) == whole
    assert ("fence" in [text.get_text() for text in figure.legends[0].get_texts()]) == bool(fence)
