"""What it costs the recorder to draw for viewers: user + system time for each second of a run."""

import tempfile
from functools import partial
from pathlib import Path

import maniple
from benchmarks.common import Budget, Row, best_of, cpu_s, show
from maniple.core import codec
from maniple.core.time import SECOND
from maniple.recording.reader import Recorded, read
from maniple.recording.viz import Viewer
from maniple.recording.writer import RecordingWriter

TITLE = "Channels for viewers, CPU time for each second of a run"
BUDGET = Budget(20.0, "ours")

SCENE = Path(__file__).parents[1] / "scenarios" / "chaos.toml"
"""Six robots with scanners that look all round, 360 beams at 10 Hz."""
SECONDS, QUICK_SECONDS = 20.0, 2.0


def rows(quick: bool = False) -> list[Row]:
    """One row."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        maniple.run(
            SCENE, virtual=True, log=folder / "run.mcap", duration_s=QUICK_SECONDS if quick else SECONDS
        )
        recording = read(folder / "run.mcap")
        said = list(recording.messages())
        span_s = (said[-1].log_time_ns - said[0].log_time_ns) / SECOND
        scenario = recording.scenario
        drawing, writing = best_of(
            partial(cpu_s, lambda: _draw(Viewer(scenario), said)),
            partial(cpu_s, lambda: _record(folder / "again.mcap", said)),
            rounds=1 if quick else 5,
        )
    scale = 1e3 / span_s
    return [Row("6 robots, 360 beams", drawing * scale, "ms", "recording them", writing * scale, BUDGET)]


def _draw(viewer: Viewer, said: list[Recorded]) -> None:
    wanted: dict[str, bool] = {}
    for topic, data, log_time, _, _ in said:
        if topic not in wanted:
            wanted[topic] = viewer.wants(topic)
        if wanted[topic]:
            viewer.see(topic, codec.decode(topic, data), log_time)


def _record(path: Path, said: list[Recorded]) -> None:
    with RecordingWriter(path, b"{}", {}, prefix="maniple") as writer:
        for one in said:
            writer.write(*one)
            writer.tick(one.log_time_ns)
    path.unlink()


if __name__ == "__main__":
    show(TITLE, rows())
