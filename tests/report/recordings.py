"""Recordings of short runs, whole and with parts taken out."""

from collections.abc import Callable
from pathlib import Path

import maniple
from maniple.recording.reader import Recorded, read
from maniple.recording.writer import RecordingWriter

SCENE = """
name = "short"
description = "Four robots & <one> obstacle."
task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15, settle_s = 6.0 }
formation.points = [[1, 0.9], [0.2, -0.9], [-0.6, 0.9], [-1.4, -0.9]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }, { id = "r4" }]
guard.clearance = false
compensation.enabled = true
faults = [{ loss = 0.2, topic = "robot/*/command" }]
world.obstacles = [
  { kind = "circle", centre = [2.4, 0.45], radius_m = 0.15 },
  { kind = "wall", start = [-4, 3], end = [5, 3] },
  { kind = "box", centre = [40, 40], size = [1, 1] },
]
"""


def recorded(folder: Path, *overrides: str) -> Path:
    """A virtual run of the scene, in a file."""
    scene = folder / "short.toml"
    scene.write_text(SCENE)
    log = folder / "short.mcap"
    maniple.run(scene, virtual=True, log=log, overrides=overrides)
    return log


def filtered(source: Path, target: Path, keep: Callable[[Recorded], bool]) -> Path:
    """The same recording with only some of its messages."""
    recording = read(source)
    metadata = {name: value for name, value in recording.metadata.items() if name != "prefix"}
    with RecordingWriter(target, recording.scenario_json, metadata, prefix=recording.prefix) as writer:
        for record in recording.messages():
            if keep(record):
                writer.write(*record)
                writer.tick(record.log_time_ns)
    return target
