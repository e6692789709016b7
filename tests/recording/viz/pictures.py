"""A short run, and what a viewer makes of it."""

import atexit
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import NamedTuple, TypeVar

import maniple
from maniple.cli.recording_options import RecordingOptions
from maniple.core.messages import Message
from maniple.core.scenario.types import Scenario
from maniple.core.time import VIRTUAL_EPOCH, Time
from maniple.recording.reader import read
from maniple.recording.viz import Drawn, Viewer

M = TypeVar("M", bound=Message)

SCENE = """
name = "drawn"
task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.3 }
formation.points = [[1, 0.9], [0.2, -0.9], [-0.6, 0.9], [-1.4, -0.9]]
robots = [
  { id = "r1", sensor = "rplidar-a2" },
  { id = "r2", sensor = "pioneer-3dx-sonar" },
  { id = "r3", model = "odd" },
  { id = "r4", pose = [-1.7, -1.0, 0.3] },
]
controller.host = "r4"
crashes = [{ node = "r2", at_s = 2.0, restart_after_s = 1.0 }]
world.obstacles = [
  { kind = "circle", centre = [3.4, 0.45], radius_m = 0.15 },
  { kind = "wall", start = [-4, 3], end = [5, 3] },
  { kind = "box", centre = [40, 40], size = [1, 2], angle_rad = 0.5 },
  { kind = "polygon", points = [[4, -3], [6, -3], [6, -1], [5, -2]] },
]

[models.odd]
length_m = 0.5
width_m = 0.4
body_offset_m = -0.05
wheel_radius_m = 0.1
track_m = 0.33
ticks_per_revolution = 70000
u_max_mps = 0.75
w_max_radps = 1.745
u_accel_mps2 = 0.3
w_accel_radps2 = 1.745
brake_mps2 = 0.6
theta = [0.26, 0.25, -0.0005, 0.99, 0.003, 1.07]
sensor_mount = [0.1, 0.02, 0.1]
wheel_error = [0.01, -0.01]
"""


class Seen(NamedTuple):
    """A message, and when it was logged."""

    topic: str
    message: Message
    time: Time


class Run(NamedTuple):
    """What a run said that viewers want."""

    scenario: Scenario
    seen: tuple[Seen, ...]

    def of(self, kind: type[M], name: str = "") -> list[tuple[Time, M]]:
        """The messages of one type with their times; of one topic if asked."""
        return [
            (one.time, one.message)
            for one in self.seen
            if isinstance(one.message, kind) and name in ("", one.topic)
        ]


@cache
def recorded(viz: bool = False) -> Path:
    """A recording of the scene in virtual time, with channels for viewers if asked."""
    folder = Path(mkdtemp())
    atexit.register(rmtree, folder)
    scene, log = folder / "drawn.toml", folder / "drawn.mcap"
    scene.write_text(SCENE)
    maniple.run(scene, virtual=True, log=log, duration_s=8.0, recording=RecordingOptions(viz=viz))
    return log


@cache
def run() -> Run:
    """The scene in virtual time."""
    recording = read(recorded())
    wanted = recording.messages(Viewer(recording.scenario).wants)
    return Run(recording.scenario, tuple(Seen(one.topic, one.decode(), one.log_time_ns) for one in wanted))


def draw(scenario: Scenario, seen: Iterable[Seen]) -> Iterator[Drawn]:
    """What a viewer makes of messages."""
    viewer = Viewer(scenario, VIRTUAL_EPOCH)
    for one in seen:
        yield from viewer.see(*one)


@cache
def drawn() -> tuple[Drawn, ...]:
    """What a viewer makes of the run."""
    return tuple(draw(run().scenario, run().seen))
