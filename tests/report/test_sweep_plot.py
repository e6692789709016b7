from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image

from maniple.report.sweep_plot import Table, curve, draw, edge_of, levels, where, write
from maniple.report.sweep_types import Plot

PLOT = Plot(name="p", x="latency", y="error_m", series="layer", facets="loss", edge=2.0, log=True)


def table() -> Table:
    rng = np.random.default_rng(1)
    rows: list[dict[str, Any]] = [
        {"loss": loss, "layer": layer, "latency": latency, "seed": seed}
        for loss in (0.0, 0.3, 0.6)
        for layer in ("drive", "kinematics")
        for latency in (0.2, 0.1, 0.4)
        for seed in (1, 2, 3)
    ]
    found: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    found["error_m"] = [None if row["latency"] == 0.4 else float(rng.uniform(0.1, 2.0)) for row in rows]
    found["completed"] = [row["latency"] < 0.4 and row["seed"] > 1 for row in rows]
    found["tolerated_delay_s"] = [0.3 if row["layer"] == "drive" else 5.0 for row in rows]
    found["delay_margin_s"] = [0.4 if row["layer"] == "drive" else None for row in rows]
    return found


def test_a_curve_is_the_median_and_the_extremes_by_x() -> None:
    data = table()
    runs = where(data, {"loss": 0.3, "layer": "drive"})
    assert runs.sum() == 9
    found = curve(data, PLOT, runs)
    assert found.x.tolist() == [0.1, 0.2, 0.4]
    for index, latency in enumerate((0.1, 0.2)):
        here = [data["error_m"][k] for k in np.flatnonzero(runs & where(data, {"latency": latency})).tolist()]
        assert found.low[index] == min(here)
        assert found.middle[index] == sorted(here)[1]
        assert found.high[index] == max(here)
    assert np.isnan([found.low[2], found.middle[2], found.high[2]]).all()


def test_of_truths_the_share() -> None:
    data = table()
    found = curve(data, Plot(name="p", x="latency", y="completed"), where(data, {}))
    assert found.middle == pytest.approx([2 / 3, 2 / 3, 0.0])


def test_values_are_drawn_within_the_limits() -> None:
    data = table()
    found = curve(data, Plot(name="p", x="latency", y="error_m", y_min=0.5, y_max=1.0), where(data, {}))
    assert np.nanmin(found.low) == 0.5
    assert np.nanmax(found.high) == 1.0


def test_the_edge_is_where_x_makes_the_tolerated_delay() -> None:
    data = table()
    assert edge_of(data, PLOT, where(data, {"layer": "drive"}), "tolerated_delay_s") == [0.15]
    assert edge_of(data, PLOT, where(data, {}), "tolerated_delay_s") == [0.15, 2.5]
    assert edge_of(data, PLOT, where(data, {}), "delay_margin_s") == [0.2]
    without = Plot(name="p", x="latency", y="error_m")
    assert edge_of(data, without, where(data, {}), "tolerated_delay_s") == []


def test_levels_come_in_the_order_of_the_runs() -> None:
    assert levels(table(), "latency") == [0.2, 0.1, 0.4]
    assert levels(table(), "") == [None]


def test_a_panel_for_each_facet_and_a_line_for_each_of_the_series() -> None:
    figure = draw(PLOT, table())
    assert [axes.get_title() for axes in figure.axes] == ["loss 0", "loss 0.3", "loss 0.6"]
    for axes in figure.axes:
        marked = [line for line in axes.get_lines() if line.get_marker() != "None"]
        assert len(marked) == 2
        upright = [line.get_xdata() for line in axes.get_lines() if line.get_marker() == "None"]
        assert upright == [[0.15, 0.15], [0.2, 0.2]]


@pytest.mark.parametrize(
    "plot",
    [
        PLOT,
        Plot(name="p", x="latency", y="completed", log_x=True, title="All"),
        Plot(name="p", x="latency", y="nothing_m", log=True, log_x=True, facets="seed"),
    ],
)
def test_it_is_drawn_the_same_every_time(tmp_path: Path, plot: Plot) -> None:
    data = {**table(), "nothing_m": [None] * 54}
    for name in ("a.png", "b.png"):
        write(plot, data, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert image.imread(tmp_path / "a.png").std() > 0.05
