"""The predicted delay margin against whole platoons: each layer, the controller, the network."""

from pathlib import Path

import pytest

import maniple
from maniple.cli.loading import load
from maniple.cli.sweep.plan import network_margin_s
from tests.cli.scenes import ROOT

SCENE = ROOT / "sweeps" / "free-space.toml"
OPEN = ("guard.clearance=false", "guard.hold_after_s=1000", "guard.stop_after_s=1001")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layer", "share", "holds"),
    [("drive", 0.8, True), ("drive", 1.2, False), ("kinematics", 0.75, True)],
)
def test_a_platoon_keeps_its_shape_up_to_the_margin(
    tmp_path: Path, layer: str, share: float, holds: bool
) -> None:
    """With `share` of the margin as latency there and back; on the robots it goes slowly, near the edge."""
    overrides = [*OPEN, f"placement.robot_from={layer}"]
    margin = network_margin_s(load(SCENE, overrides))
    assert margin is not None
    latency = f"faults.0.latency_s={0.5 * share * margin}"
    result = maniple.run(SCENE, virtual=True, overrides=[*overrides, latency], log=tmp_path / "run.mcap")
    assert result.completed
    off = result.final_error.distance_m
    assert off is not None
    assert (off < 0.05) is holds, off
