"""Parts of a recording: nothing lost, nothing doubled, each stands alone."""

import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from maniple.core import codec, messages, topics
from maniple.core.errors import RecordingError
from maniple.core.time import SECOND
from maniple.recording.cut import cut
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.recording.selection import Selection
from maniple.recording.split import PartsWriter, Splits, ViewerChannel
from maniple.recording.tally import GAPS_NAME
from maniple.recording.writer import Latched, RecordingWriter, part, parts_of
from tests.recording.traffic import METADATA, SCENARIO, Sent, traffic

VIEWER = ViewerChannel("/viz/numbers", "json", "maniple.Numbers", "jsonschema", b"{}")


def writer_to(folder: Path, splits: Splits) -> PartsWriter:
    numbers = count(1)

    def begin(latched: Sequence[Latched]) -> RecordingWriter:
        number = next(numbers)
        about = {**METADATA, "part": str(number)}
        return RecordingWriter(
            part(folder / "a.mcap", number), SCENARIO, about, prefix="maniple", latched=latched
        )

    return PartsWriter(begin, splits, lambda _: True)


def fill(writer: PartsWriter, sent: Sequence[Sent]) -> None:
    for message in sent:
        writer.write(*message)
        writer.tick(message.log_time_ns)
    writer.close()


def goal(seq: int) -> bytes:
    stop = messages.EmergencyStop(source="operator", incarnation=1, seq=seq, stamp_ns=seq, stopped=True)
    return codec.encode(stop)


@pytest.mark.parametrize("splits", [Splits(duration=SECOND), Splits(bytes=5_000)])
def test_parts_together_are_what_one_file_would_be(tmp_path: Path, splits: Splits) -> None:
    sent = traffic(100)
    writer = writer_to(tmp_path, splits)
    fill(writer, sent)
    assert len(writer.paths) > 3
    assert writer.paths == parts_of(tmp_path / "a.mcap")
    recording = read(writer.paths[0])
    assert recording.paths == tuple(writer.paths)
    assert recording.complete
    assert list(recording.messages()) == sent


def test_a_part_is_over_after_its_time(tmp_path: Path) -> None:
    sent = traffic(100)
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    fill(writer, sent)
    assert len(writer.paths) == 5
    for number, path in enumerate(writer.paths, 1):
        later = [read(other).paths for other in writer.paths[number:]]
        assert all(path not in paths for paths in later)
        own = [record.log_time_ns for record in read(path).messages() if number == len(writer.paths)]
        assert not own or max(own) - min(own) < SECOND


def test_a_part_that_is_gone_is_told_of(tmp_path: Path) -> None:
    """In the middle, and the last; but not one that holds nothing, as after a crash."""
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    fill(writer, traffic(100))
    log, second, *_, last = writer.paths
    assert read(log).lacking == ""
    last.write_bytes(b"")
    assert (read(log).lacking, len(read(log).passed_over)) == ("", 1)
    last.unlink()
    assert read(log).lacking == f"{writer.paths[-2]} goes on in {last.name}, which is not there"
    whole = Selection(start_ns=0)
    assert read(cut(read(log), whole, tmp_path / "b.mcap").out).lacking == ""
    second.unlink()
    assert read(log).paths == (log,)
    assert read(log).lacking == f"{log} goes on in {second.name}, which is not there"
    assert describe(read(log)).lacking == read(log).lacking


def test_a_part_is_over_soon_after_its_size(tmp_path: Path) -> None:
    writer = writer_to(tmp_path, Splits(bytes=60_000))
    for _ in range(10):
        for message in traffic(40):
            writer.write(*message)
            writer.tick(message.log_time_ns)
            writer.flush()
    writer.close()
    sizes = [path.stat().st_size for path in writer.paths]
    assert len(sizes) > 2
    assert all(size >= 60_000 for size in sizes[:-1])


def test_every_part_stands_alone(tmp_path: Path) -> None:
    """Scenario, channels of viewers, what was noted, and what was latched before."""
    sent = traffic(100)
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    writer.add_viewer_channel(VIEWER)
    writer.note("said", {"once": "yes"})
    writer.write(topics.STOP, goal(0), 1, 1, 0)
    writer.write(topics.STOP, goal(1), 2, 2, 1)
    for message in sent:
        writer.write(*message)
        writer.draw("/viz/numbers", b"{}", message.log_time_ns, message.log_time_ns)
        writer.tick(message.log_time_ns)
    writer.close()
    for number, path in enumerate(writer.paths, 1):
        recording = read(path)
        assert recording.scenario_json == SCENARIO
        layout = recording.layouts[0]
        assert layout.metadata["said"] == {"once": "yes"}
        assert recording.metadata["part"] == str(number)
        assert "/viz/numbers" in recording.viewer_keys
        held = layout.attachments.get(f"latched/{topics.STOP}")
        if number == 1:
            assert held is None
        else:
            assert held is not None
            assert (held.data, held.log_time, held.create_time) == (goal(1), 2, 2)


def test_each_part_says_what_the_whole_lacks_so_far(tmp_path: Path) -> None:
    sent = traffic(100)
    lost = [m for m in sent if m.topic == topics.drive("r1") and m.sequence in (0, 1, 5, 70)]
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    fill(writer, [m for m in sent if m not in lost])
    found = []
    for path in writer.paths:
        gaps = read(path).layouts[0].metadata[GAPS_NAME]
        own = json.loads(gaps[f"{topics.drive('r1')} r1 1"])
        assert own["missed_first"] == 2
        found.append((gaps["missing"], own["missing"]))
    assert found == [("3", 3)] * 3 + [("4", 4)] * 2


def test_a_part_that_can_not_be_begun_leaves_the_one_before_whole(tmp_path: Path) -> None:
    (tmp_path / "a-2.mcap").touch()
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    sent = traffic(100)
    with pytest.raises(RecordingError, match=r"a-2.mcap exists already"):
        fill(writer, sent)
    writer.close()
    (tmp_path / "a-2.mcap").unlink()
    recording = read(tmp_path / "a.mcap")
    assert recording.complete
    found = list(recording.messages())
    assert found == sent[: len(found)]


def test_the_names_of_parts(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    assert parts_of(log) == []
    for name in (
        "a.mcap",
        "a-10.mcap",
        "a-2.mcap",
        "a-1.mcap",
        "a-02.mcap",
        "a-x.mcap",
        "b-2.mcap",
        "a-3.txt",
    ):
        (tmp_path / name).touch()
    assert [path.name for path in parts_of(log)] == ["a.mcap", "a-2.mcap", "a-10.mcap"]
    assert parts_of(tmp_path / "nowhere" / "a.mcap") == []
