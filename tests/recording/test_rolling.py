"""The ring of the last seconds, against a plain list; and what is kept of it."""

import random
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from maniple.core import topics
from maniple.core.errors import RecordingError
from maniple.core.time import MILLISECOND, SECOND
from maniple.recording.reader import read
from maniple.recording.rolling import Entry, Ring, RollingWriter
from maniple.recording.split import ViewerChannel
from maniple.recording.writer import Latched, RecordingWriter
from tests.recording.test_split import goal
from tests.recording.test_writer import file_size_limit
from tests.recording.traffic import METADATA, SCENARIO, drive, traffic, writer_to

VIEWER = ViewerChannel("/viz/numbers", "json", "maniple.Numbers", "jsonschema", b"{}")


def rolling(folder: Path, seconds: int = 1) -> RollingWriter:
    numbers = count(1)

    def begin(latched: Sequence[Latched]) -> RecordingWriter:
        path = folder / f"kept-{next(numbers)}.mcap"
        return RecordingWriter(path, SCENARIO, METADATA, prefix="maniple", latched=latched)

    return RollingWriter(begin, Ring(seconds * SECOND))


def test_the_ring_holds_the_last_seconds() -> None:
    """Oracle: all entries that are not older than the newest by more than the span."""
    rng = random.Random(4)
    ring, given = Ring(SECOND), []
    now = 0
    for number in range(2000):
        now += rng.randrange(20 * MILLISECOND)
        entry = Entry(topics.drive("r1"), drive(number), now - rng.randrange(MILLISECOND), now, number)
        ring.add(entry)
        given.append(entry)
        newest = max(each.log_time_ns for each in given)
        held = ring.entries()
        assert held == tuple(given[len(given) - len(held) :])
        assert all(each.log_time_ns >= newest - SECOND - MILLISECOND for each in held)
        if len(held) < len(given):
            assert given[len(given) - len(held) - 1].log_time_ns < newest - SECOND
    ring.trim(now + 2 * SECOND)
    assert ring.entries() == ()


def test_memory_ends_the_ring_before_time_does() -> None:
    ring = Ring(SECOND, most=100_000)
    for number in range(1000):
        ring.add(Entry("hw/r1/scan", bytes(1000), number, number, number))
    assert ring.squeezed
    assert 50 < len(ring.entries()) < 100
    assert ring.entries()[-1].sequence == 999


def test_what_falls_off_and_is_latched_is_held() -> None:
    ring = Ring(SECOND)
    for number in range(3):
        ring.add(Entry(topics.STOP, goal(number), number, number, number))
    ring.trim(3 * SECOND)
    assert ring.latched == {topics.STOP: Latched(topics.STOP, goal(2), 2, 2)}


def test_nothing_is_written_until_it_is_kept(tmp_path: Path) -> None:
    sent = traffic(100)
    writer = rolling(tmp_path)
    writer.add_viewer_channel(VIEWER)
    writer.note("said", {"once": "yes"})
    for message in sent:
        writer.write(*message)
        writer.draw("/viz/numbers", b"{}", message.log_time_ns, message.log_time_ns)
        writer.tick(message.log_time_ns)
    assert list(tmp_path.iterdir()) == []
    assert not writer.writing
    last = sent[-1].log_time_ns
    kept = writer.keep(last)
    assert writer.end() == kept
    expected = [message for message in sent if message.log_time_ns >= last - SECOND]
    assert (kept.messages, kept.first_ns, kept.last_ns) == (len(expected), expected[0].log_time_ns, last)
    recording = read(kept.path)
    assert recording.complete
    assert list(recording.messages()) == expected
    assert recording.viewer_keys == ("/viz/numbers",)
    assert recording.layouts[0].metadata["said"] == {"once": "yes"}
    assert writer.waiting == 0
    writer.write(topics.drive("r1"), drive(9), last + 1, last, 9)
    assert writer.waiting == 1


def test_it_goes_on_for_a_while(tmp_path: Path) -> None:
    """A second keep meanwhile goes on with the same file; a later one has a file of its own."""
    sent = traffic(100)
    writer = rolling(tmp_path)
    for message in sent[:200]:
        writer.write(*message)
    first = writer.keep(sent[199].log_time_ns)
    for message in sent[200:300]:
        writer.write(*message)
    again = writer.keep(sent[299].log_time_ns)
    assert again.path == first.path
    assert again.messages == first.messages + 100
    writer.end()
    assert writer.end() is None
    for message in sent[300:]:
        writer.write(*message)
    other = writer.keep(sent[-1].log_time_ns)
    writer.close()
    assert [path.name for path in writer.paths] == ["kept-1.mcap", "kept-2.mcap"]
    earliest = sent[199].log_time_ns - SECOND
    assert list(read(first.path).messages()) == [m for m in sent[:300] if m.log_time_ns >= earliest]
    latest = sent[-1].log_time_ns
    assert list(read(other.path).messages()) == [m for m in sent if m.log_time_ns >= latest - SECOND]


def test_nothing_to_keep(tmp_path: Path) -> None:
    writer = rolling(tmp_path)
    for message in traffic(3):
        writer.write(*message)
    writer.keep(0)
    writer.end()
    kept = writer.keep(1 << 62)
    assert writer.end() == kept
    assert kept[1:] == (0, 0, 0)
    assert read(kept.path).complete


def test_a_full_disk_leaves_the_ring_as_it_was(tmp_path: Path) -> None:
    sent = traffic(100)
    writer = rolling(tmp_path)
    for message in sent:
        writer.write(*message)
    with writer_to(tmp_path / "front.mcap") as front:
        room = front.size + 500
    with file_size_limit(room), pytest.raises(RecordingError, match="File too large"):
        writer.keep(sent[-1].log_time_ns)
    assert not writer.writing
    kept = writer.keep(sent[-1].log_time_ns)
    writer.close()
    assert kept.messages == len(list(read(kept.path).messages()))
