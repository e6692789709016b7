from pathlib import Path

import pytest

from maniple.recording.info import Gap, Info, describe, missing
from maniple.recording.reader import read
from tests.recording.traffic import Sent, drive, record, traffic


def info_of(tmp_path: Path, sent: list[Sent]) -> Info:
    return describe(read(record(tmp_path / "a.mcap", sent)))


def drives(seqs: list[int], incarnation: int = 1, source: str = "r1") -> list[Sent]:
    return [Sent("hw/r1/drive", drive(seq, source, incarnation), 0, 0, seq) for seq in seqs]


def test_overview(tmp_path: Path) -> None:
    sent = traffic(41)
    found = info_of(tmp_path, sent)
    assert (found.scenario, found.version, found.mode, found.seed) == ("test", "0.1.0", "virtual", "7")
    assert found.complete
    assert found.messages == len(sent)
    assert found.bytes == sum(len(message.data) for message in sent)
    assert found.missing == 0
    assert found.duration_s == pytest.approx(2.0)
    assert (found.start_ns, found.end_ns) == (sent[0].log_time_ns, sent[-1].log_time_ns)


def test_channels(tmp_path: Path) -> None:
    found = info_of(tmp_path, traffic(41)).channels
    assert [(channel.topic, channel.type, channel.messages) for channel in found] == [
        ("hw/r1/drive", "Drive", 41),
        ("hw/r1/scan", "Scan", 41),
        ("hw/r2/drive", "Drive", 41),
        ("hw/r2/scan", "Scan", 41),
    ]
    assert all(channel.rate_hz == pytest.approx(20.0) for channel in found)


def test_recording_without_messages(tmp_path: Path) -> None:
    found = info_of(tmp_path, [])
    assert (found.messages, found.duration_s, found.channels) == (0, 0.0, ())


@pytest.mark.parametrize(
    ("seqs", "gaps", "expected", "missed_first", "repeated"),
    [
        ([0, 1, 2], [], 3, 0, 0),
        ([0, 1, 4, 5, 7], [(2, 3), (6, 6)], 8, 0, 0),
        ([3, 4], [(0, 2)], 5, 3, 0),
        ([0, 1, 1, 2, 0], [], 3, 0, 2),
        ([0, 5, 2], [(1, 1), (3, 4)], 6, 0, 0),
        ([0, 3, 1, 2], [], 4, 0, 0),
        ([2, 0], [(1, 1)], 3, 0, 0),
        ([4, 2, 2, 6], [(0, 1), (3, 3), (5, 5)], 7, 2, 1),
    ],
)
def test_gaps(
    tmp_path: Path,
    seqs: list[int],
    gaps: list[tuple[int, int]],
    expected: int,
    missed_first: int,
    repeated: int,
) -> None:
    [channel] = info_of(tmp_path, drives(seqs)).channels
    [stream] = channel.streams
    assert stream.gaps == tuple(Gap(first, last) for first, last in gaps)
    assert stream.missing == channel.missing == len(set(range(expected)) - set(seqs))
    assert (stream.received, stream.expected) == (len(seqs), expected)
    assert (stream.missed_first, stream.repeated) == (missed_first, repeated)


def test_each_life_of_each_sender_counts_for_itself(tmp_path: Path) -> None:
    sent = [*drives([0, 1, 2]), *drives([0, 2], incarnation=2), *drives([1], source="x")]
    [channel] = info_of(tmp_path, sent).channels
    assert [(s.source, s.incarnation, s.missing) for s in channel.streams] == [
        ("r1", 1, 0),
        ("r1", 2, 1),
        ("x", 1, 1),
    ]
    assert channel.missing == 2


def test_messages_without_a_header(tmp_path: Path) -> None:
    sent = [
        *drives([0]),
        Sent("hw/r1/drive", b"\x00", 0, 0, 0),
        *drives([-1]),
        Sent("else/where", b"?", 0, 0, 0),
    ]
    unknown, known = info_of(tmp_path, sent).channels
    assert (known.messages, known.headless, known.missing) == (3, 2, 0)
    assert (unknown.topic, unknown.type, unknown.headless) == ("else/where", "", 1)


def test_what_is_missing_in_the_parts_of_a_recording_together(tmp_path: Path) -> None:
    """Also between them; what both hold is not counted twice."""
    parts = [drives([0, 1, 3]), drives([2, 3, 7]), drives([0, 2], incarnation=2)]
    logs = [record(tmp_path / f"{number}.mcap", sent) for number, sent in enumerate(parts)]
    assert [missing([read(log)]) for log in logs] == [1, 5, 1]
    assert missing(map(read, logs)) == 4
    assert missing([]) == 0
