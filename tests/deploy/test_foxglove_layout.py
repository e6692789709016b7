"""The layout for Foxglove and Lichtblick shows what there is, for robots named r1 to r6."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from maniple.cli.loading import load
from maniple.recording.viz import channels_of

ROOT = Path(__file__).parents[2]
LAYOUT = json.loads((ROOT / "deploy" / "foxglove-layout.json").read_text())
CHANNELS = {channel.key: channel for channel in channels_of(load(ROOT / "scenarios" / "chaos.toml"))}


def panels(of: Any) -> Iterator[str]:
    """The panels in a layout, those in tabs among them."""
    if isinstance(of, dict):
        yield from panels(of["first"])
        yield from panels(of["second"])
        return
    yield of
    for tab in LAYOUT["configById"][of].get("tabs", ()):
        yield from panels(tab["layout"])


def test_every_panel_is_there_once_and_configured() -> None:
    found = list(panels(LAYOUT["layout"]))
    assert sorted(found) == sorted(LAYOUT["configById"])


def test_every_series_has_a_field_of_a_channel() -> None:
    count = 0
    for config in LAYOUT["configById"].values():
        for path in config.get("paths", ()):
            key, field = path["value"].split(".")
            assert field in json.loads(CHANNELS[key].schema)["properties"]
            count += 1
    assert count > 30


def test_all_that_moves_is_in_the_3d_panel() -> None:
    topics = LAYOUT["configById"]["3D!platoon"]["topics"]
    drawn = {key for key, channel in CHANNELS.items() if channel.schema_name.startswith("foxglove.")}
    assert topics.keys() == drawn - {"/viz/tf", "/viz/log"}
    assert LAYOUT["configById"]["RosOut!log"]["topicToRender"] in CHANNELS
