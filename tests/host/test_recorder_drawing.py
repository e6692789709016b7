"""Drawing for viewers: it costs no recorded message, whatever it does."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from maniple.cli.loading import completed
from maniple.core import topics
from maniple.core.messages import Drive, Message
from maniple.core.time import Time
from maniple.host.recorder_drawing import LATE, Drawing, Picture
from maniple.recording.reader import read
from maniple.recording.split import PartsWriter, ViewerChannel
from maniple.recording.viz import Viewer
from tests.cli.scenes import platoon
from tests.host.test_latched import message
from tests.recording.traffic import drive, writer_to

TOPIC = topics.drive("r1")
CHANNEL = ViewerChannel("/viz/speed", "json", "maniple.Speed", "jsonschema", b'{"type": "object"}')


class Drawn(NamedTuple):
    key: str
    data: bytes
    time_ns: Time


class Speedometer:
    """Draws the speed of drives, and fails for those numbered so."""

    def __init__(self, fails: Sequence[int] = ()) -> None:
        self._fails = fails

    def wants(self, topic: str) -> bool:
        return topic == TOPIC

    def see(self, topic: str, message: Message, log_time_ns: Time) -> Sequence[Picture]:
        assert isinstance(message, Drive)
        if message.seq in self._fails:
            raise ZeroDivisionError("no such speed")
        return [Drawn("/viz/speed", b'{"u": %.1f}' % message.u_mps, log_time_ns)]


def drawn(path: Path) -> list[str]:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return [message.data.decode() for _, _, message in make_reader(file).iter_messages(["/viz/speed"])]


def test_what_is_drawn_is_beside_what_is_recorded(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mcap"
    writer = PartsWriter(lambda _: writer_to(path))
    drawing = Drawing(Speedometer(fails=(2, 3)), [CHANNEL], writer)
    for seq, waited in enumerate((0, LATE, 0, 0, LATE + 1, 0)):
        writer.write(TOPIC, drive(seq), seq, seq, seq)
        drawing.draw(TOPIC, drive(seq), seq, waited)
    for data in (b"", b"garbage"):
        drawing.draw(TOPIC, data, 9, 0)
    drawing.draw("else/where", b"x", 9, 0)
    writer.close()
    assert drawn(path) == ['{"u": 0.1}'] * 3
    assert [record.sequence for record in read(path).messages()] == list(range(6))
    assert (drawing.late, drawing.failed) == (1, 2)
    assert drawing.summary() == "messages not drawn for viewers: 1 to keep up, 2 as that failed"
    said = capfd.readouterr().err
    assert said.count("can't be drawn") == 1
    assert "no such speed" in said


def test_all_well_is_nothing_to_speak_of(tmp_path: Path) -> None:
    writer = PartsWriter(lambda _: writer_to(tmp_path / "a.mcap"))
    drawing = Drawing(Speedometer(), [CHANNEL], writer)
    drawing.draw(TOPIC, drive(0), 0, 0)
    writer.close()
    assert drawing.summary() == ""


def test_the_viewer_of_recordings_fits(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    viewer = Viewer(completed(platoon(3)))
    writer = PartsWriter(lambda _: writer_to(path))
    drawing = Drawing(viewer, (ViewerChannel(*channel) for channel in viewer.channels), writer)
    for seq in range(3):
        data = message(seq)
        writer.write(topics.odometry("r1"), data, seq, seq, seq)
        drawing.draw(topics.odometry("r1"), data, seq, 0)
    writer.close()
    recording = read(path)
    assert set(recording.viewer_keys) == {channel.key for channel in viewer.channels}
    assert len(list(recording.messages())) == 3
    assert drawing.failed == 0
