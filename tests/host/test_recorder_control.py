"""Keep, pause and resume, told without a network."""

from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from maniple.core.time import SECOND, Time
from maniple.host.recorder_control import Control
from maniple.host.recorder_orders import Order
from maniple.host.recorder_space import Space
from maniple.recording.absence import KEPT_NAME, PAUSES_NAME
from maniple.recording.reader import read
from maniple.recording.rolling import Ring, RollingWriter
from maniple.recording.split import PartsWriter
from maniple.recording.writer import Latched, RecordingWriter
from tests.recording.traffic import METADATA, SCENARIO, drive, writer_to

TOPIC = "hw/r1/drive"


class Recorder:
    """A control with a clock that a test sets."""

    def __init__(self, folder: Path, rolling: bool, space: Space | None = None) -> None:
        numbers = count(1)

        def begin(latched: Sequence[Latched]) -> RecordingWriter:
            path = folder / f"kept-{next(numbers)}.mcap"
            return RecordingWriter(path, SCENARIO, METADATA, prefix="maniple", latched=latched)

        self.now: Time = 100 * SECOND
        self.path = folder / "a.mcap"
        self.writer: PartsWriter | RollingWriter
        if rolling:
            self.writer = RollingWriter(begin, Ring(10 * SECOND))
        else:
            self.writer = PartsWriter(lambda _: writer_to(self.path))
        self.control = Control("here-7", self.writer, lambda: self.now, space)

    def hear(self, messages: int) -> None:
        """One every 0.1 s."""
        for _ in range(messages):
            self.now += SECOND // 10
            if self.control.paused:
                self.control.left_out()
            else:
                self.writer.write(TOPIC, drive(0), self.now, self.now, 0)


def test_a_pause_stands_in_the_recording_with_its_reason(tmp_path: Path) -> None:
    it = Recorder(tmp_path, rolling=False)
    it.hear(5)
    paused = it.control.obey(Order("pause", "lunch"))
    assert (paused.ok, paused.state, paused.reason, paused.recorder) == (True, "paused", "lunch", "here-7")
    assert "paused already" in it.control.obey(Order("pause")).text
    open_pause = read(it.path).layouts[0].metadata[PAUSES_NAME]["pauses"]
    assert open_pause == '[{"from_ns":100500000000,"reason":"lunch","until_ns":null,"messages":0}]'
    it.hear(3)
    state = it.control.obey(Order("state"))
    assert (state.ok, state.state, state.reason, state.file) == (True, "paused", "lunch", str(it.path))
    resumed = it.control.obey(Order("resume"))
    assert (resumed.ok, resumed.state) == (True, "recording")
    assert "3 messages in 0.3 s were left out" in resumed.text
    assert not it.control.obey(Order("resume")).ok
    it.hear(1)
    it.control.obey(Order("pause"))
    it.hear(2)
    assert it.control.end(keep=False) == ""
    it.writer.close()
    recording = read(it.path)
    assert len(list(recording.messages())) == 6
    assert recording.layouts[0].metadata[PAUSES_NAME]["pauses"] == (
        '[{"from_ns":100500000000,"reason":"lunch","until_ns":100800000000,"messages":3},'
        '{"from_ns":100900000000,"reason":"","until_ns":101100000000,"messages":2}]'
    )


def test_who_records_everything_has_nothing_to_keep(tmp_path: Path) -> None:
    it = Recorder(tmp_path, rolling=False)
    answer = it.control.obey(Order("keep"))
    assert not answer.ok
    assert "--keep-last" in answer.text
    it.writer.close()


def test_kept_and_going_on(tmp_path: Path) -> None:
    it = Recorder(tmp_path, rolling=True)
    it.hear(200)
    assert it.control.obey(Order("state")).state == "rolling"
    answer = it.control.obey(Order("keep", "a bump", after_s=2.0))
    assert (answer.ok, answer.state, answer.messages) == (True, "keeping", 101)
    assert (answer.first_ns, answer.last_ns) == (it.now - 10 * SECOND, it.now)
    assert f"kept 101 messages of 10.0 s in {tmp_path / 'kept-1.mcap'}; goes on for 2.0 s" == answer.text
    it.hear(10)
    it.control.look()
    again = it.control.obey(Order("keep", "another", after_s=3.0))
    assert (again.file, again.messages) == (answer.file, 111)
    it.hear(25)
    it.control.look()
    assert it.writer.writing
    it.hear(5)
    it.control.look()
    assert not it.writer.writing
    assert it.control.obey(Order("state")).state == "rolling"
    recording = read(answer.file)
    assert recording.complete
    assert len(list(recording.messages())) == 101 + 10 + 30
    assert recording.layouts[0].metadata[KEPT_NAME] == {"reason": "a bump; another"}


def test_kept_at_once(tmp_path: Path) -> None:
    it = Recorder(tmp_path, rolling=True)
    it.hear(20)
    first, second = it.control.obey(Order("keep")), it.control.obey(Order("keep"))
    assert (first.messages, second.messages) == (20, 20)
    assert first.file != second.file
    assert read(first.file).complete


@pytest.mark.parametrize("keep", [True, False])
def test_the_end_of_one_that_only_remembers(tmp_path: Path, keep: bool) -> None:
    it = Recorder(tmp_path, rolling=True)
    it.hear(20)
    text = it.control.end(keep)
    it.writer.close()
    files = list(tmp_path.glob("*.mcap"))
    if keep:
        assert text == f"kept 20 messages of 1.9 s in {files[0]}"
        assert read(files[0]).complete
    else:
        assert text.startswith("the last 20 messages were not kept")
        assert files == []


def test_no_room_to_keep(tmp_path: Path) -> None:
    it = Recorder(tmp_path, rolling=True, space=Space(tmp_path, 100, lambda _: 99))
    it.hear(20)
    answer = it.control.obey(Order("keep"))
    assert not answer.ok
    assert "are free in" in answer.text
    assert answer.state == "rolling"
    assert list(tmp_path.glob("*.mcap")) == []
