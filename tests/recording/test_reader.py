import itertools
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer

from maniple.core import codec, messages
from maniple.core.errors import MessageError, RecordingError
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Formation, Line, Robot, Scenario
from maniple.recording.reader import read
from maniple.recording.scan import ChunkPlace, Damage, read_chunk, scan
from maniple.recording.writer import Compression, RecordingWriter, part
from tests.recording.traffic import METADATA, SCENARIO, Sent, drive, record, traffic, writer_to


def test_decoded_messages(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(3)))
    drives = list(recording.decoded(messages.Drive))
    assert [(entry.topic, message.source, message.seq) for entry, message in drives] == [
        (f"hw/{robot}/drive", robot, tick) for tick in range(3) for robot in ("r1", "r2")
    ]


def test_only_wanted_topics(tmp_path: Path) -> None:
    sent = traffic(3)
    recording = read(record(tmp_path / "a.mcap", sent))
    found = list(recording.messages(lambda topic: topic == "hw/r2/scan"))
    assert found == [message for message in sent if message.topic == "hw/r2/scan"]


def test_invalid_bytes_come_raw(tmp_path: Path) -> None:
    [entry] = read(record(tmp_path / "a.mcap", [Sent("hw/r1/drive", b"\xff", 1, 1, 0)])).messages()
    assert entry.data == b"\xff"
    assert entry.message is None
    with pytest.raises(MessageError, match="hw/r1/drive"):
        entry.decode()


def test_order_across_chunks_is_log_time_then_place(tmp_path: Path) -> None:
    """Chunks that overlap in time, and equal times on both sides of a chunk border."""
    path = tmp_path / "a.mcap"
    times = [[10, 30, 20], [20, 15, 40], [5, 20, 40], [40, 1]]
    number = 0
    expected = []
    with writer_to(path) as writer:
        for chunk in times:
            for time in chunk:
                writer.write("hw/r1/drive", drive(number), time, time, number)
                expected.append((time, number))
                number += 1
            writer.flush()
    assert [(entry.log_time_ns, entry.sequence) for entry in read(path).messages()] == sorted(expected)


def test_can_be_read_twice_and_side_by_side(tmp_path: Path) -> None:
    sent = traffic(20)
    recording = read(record(tmp_path / "a.mcap", sent))
    pairs = list(zip(recording.messages(), recording.messages(), strict=True))
    assert [a for a, _ in pairs] == [b for _, b in pairs] == sent


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_every_prefix_is_readable_or_refused(tmp_path: Path, compression: Compression) -> None:
    """Cut anywhere, all whole chunks are there; cut before the scenario is whole, one clear error."""
    sent = traffic(30)
    whole = record(tmp_path / "whole.mcap", sent, compression)
    data = whole.read_bytes()
    with whole.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    scenario_end = max(index.offset + index.length for index in summary.attachment_indexes)
    ends = [place.offset + place.length for place in scan(whole).chunks]
    per_chunk = _messages_per_chunk(whole)
    cut = tmp_path / "cut.mcap"
    near = {end + step for end in [scenario_end, *ends, len(data)] for step in range(-12, 12)}
    for size in sorted(size for size in {*range(0, len(data), 61), *near} if size < len(data)):
        cut.write_bytes(data[:size])
        if size < scenario_end:
            assert str(cut) in _problem(cut)
            continue
        recording = read(cut)
        count = sum(per_chunk[: sum(end <= size for end in ends)])
        assert list(recording.messages()) == sent[:count]
        assert not recording.complete
        assert recording.scenario_json == SCENARIO


def test_flipped_bytes_give_an_answer_or_one_error(tmp_path: Path) -> None:
    data = record(tmp_path / "whole.mcap", traffic(20)).read_bytes()
    rng = random.Random(5)
    damaged = tmp_path / "damaged.mcap"
    problems = 0
    for _ in range(600):
        content = bytearray(data)
        content[rng.randrange(len(content))] ^= rng.randrange(1, 256)
        damaged.write_bytes(content)
        if problem := _problem(damaged):
            assert str(damaged) in problem
            problems += 1
    assert problems > 50


def test_damaged_chunk_is_named(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic())
    place = scan(path).chunks[1]
    with path.open("r+b") as file:
        file.seek(place.offset + place.length - 30)
        file.write(b"garbage")
    with pytest.raises(RecordingError, match=f"chunk at byte {place.offset} is damaged"):
        list(read(path).messages())


@pytest.mark.parametrize("lost", [10, 500])
def test_zeros_at_the_end(tmp_path: Path, lost: int) -> None:
    """What a power failure leaves: the length is there, the content is not."""
    path = record(tmp_path / "a.mcap", traffic())
    *others, last = scan(path).chunks
    with path.open("r+b") as file:
        file.seek(last.offset + last.length - lost)
        file.write(bytes(path.stat().st_size))
    recording = read(path)
    assert not recording.complete
    assert len(list(recording.messages())) == sum(_messages_per_chunk(path)[: len(others)])


PROGRAM = """
import sys
from collections.abc import Callable
from pathlib import Path
from tests.recording.traffic import traffic, writer_to
writer = writer_to(Path(sys.argv[1]))
for message in traffic(1000):
    writer.write(*message)
    writer.tick(message.log_time_ns)
    if message.sequence == 500:
        print("now", flush=True)
        sys.stdin.readline()
"""


def test_sigkill_loses_only_the_chunk_in_progress(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"now\n"
        process.send_signal(signal.SIGKILL)
    recording = read(path)
    sent = traffic(1000)
    found = list(recording.messages())
    assert not recording.complete
    assert found == sent[: len(found)]
    assert sent[2000].log_time_ns - found[-1].log_time_ns <= 500_000_000


def test_recording_of_another_writer(tmp_path: Path) -> None:
    """As other tools rewrite it: channels within chunks, lz4, the scenario at the end."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4, chunk_size=300)
        writer.start()
        channel = writer.register_channel("maniple/hw/r1/drive", "msgpack", 0)
        for seq in range(20):
            writer.add_message(channel, seq, drive(seq), seq, seq)
        writer.add_metadata("maniple", {**METADATA, "prefix": "maniple"})
        writer.add_attachment(0, 0, "scenario.json", "application/json", SCENARIO)
        _finish(writer)
    recording = read(path)
    assert recording.complete
    assert [(m.topic, m.sequence, m.data) for m in recording.messages()] == [
        ("hw/r1/drive", seq, drive(seq)) for seq in range(20)
    ]
    os.truncate(path, path.stat().st_size - 1)
    assert len(list(read(path).messages())) == 20


def test_foreign_mcap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        _finish(writer)
    with pytest.raises(RecordingError, match="not one that maniple made"):
        read(path)


def test_unchunked_messages_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        writer.add_message(writer.register_channel("a", "msgpack", 0), 0, b"", 0)
        _finish(writer)
    with pytest.raises(RecordingError, match="outside chunks"):
        read(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"robots = []\n", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "ends before its first message"),
    ],
)
def test_wrong_files(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        read(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        read(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="Is a directory"):
        read(tmp_path)


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    for path in (tmp_path / "a.mcap", Path("/dev/zero"), tmp_path / ("x" * 300)):
        with pytest.raises(RecordingError, match="can't read"):
            read(path)


def test_scenario_is_what_was_attached(tmp_path: Path) -> None:
    scenario = Scenario(
        name="pair",
        robots=(Robot(id="r1", pose=(0.0, 1.0, 0.5)),),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
    )
    with RecordingWriter(tmp_path / "a.mcap", to_json(scenario), {}, prefix="maniple"):
        pass
    assert read(tmp_path / "a.mcap").scenario == scenario


def test_scenario_of_another_version(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", []))
    with pytest.raises(RecordingError, match=r"made by version 0\.1\.0"):
        assert isinstance(recording.scenario, Scenario)


def _problem(path: Path) -> str:
    """What reading all of a file complains about; empty for nothing."""
    try:
        for entry in read(path).messages():
            assert entry.topic
    except RecordingError as error:
        return str(error)
    return ""


def _messages_per_chunk(path: Path) -> list[int]:
    with path.open("rb") as file:
        return [len(list(read_chunk(file, place, {}))) for place in scan(path).chunks]


def _finish(writer: Writer) -> None:
    finish: Callable[[], None] = writer.finish
    finish()


def parts(log: Path, sent: list[Sent], borders: list[int], **about: str) -> list[list[Sent]]:
    """A recording in parts, each a stretch of what was sent."""
    stretches = [sent[a:b] for a, b in itertools.pairwise([0, *borders, len(sent)])]
    for number, stretch in enumerate(stretches, 1):
        with RecordingWriter(
            part(log, number), SCENARIO, {**METADATA, "part": str(number), **about}, prefix="maniple"
        ) as writer:
            for message in stretch:
                writer.write(*message)
                writer.tick(message.log_time_ns)
    return stretches


def test_parts_are_one_recording(tmp_path: Path) -> None:
    """Channels have other ids in each, and equal times are on both sides of a border."""
    log, sent = tmp_path / "a.mcap", traffic(60)
    first, second, third = parts(log, sent, [82, 111])
    recording = read(log)
    assert list(recording.messages()) == first + second + third == sent
    assert recording.path == log
    assert recording.paths == (log, part(log, 2), part(log, 3))
    assert recording.complete
    assert list(read(part(log, 2)).messages()) == second + third
    assert read(part(log, 2)).paths == recording.paths[1:]
    assert (recording.start_ns, recording.end_ns) == (sent[0].log_time_ns, sent[-1].log_time_ns)
    assert recording.topics == ("hw/r1/drive", "hw/r1/scan", "hw/r2/drive", "hw/r2/scan")


def test_parts_that_overlap_in_time(tmp_path: Path) -> None:
    """In the order of log time, then part, then place."""
    log = tmp_path / "a.mcap"
    sent = [Sent("hw/r1/drive", drive(n), time, time, n) for n, time in enumerate([1, 5, 9, 3, 5, 7, 2, 5])]
    parts(log, sent, [3, 6])
    found = [(entry.log_time_ns, entry.sequence) for entry in read(log).messages()]
    assert found == [(1, 0), (2, 6), (3, 3), (5, 1), (5, 4), (5, 7), (7, 5), (9, 2)]


@pytest.mark.parametrize(
    "other",
    [{"part": "3"}, {"anchor": "77"}, {"scenario": "other"}],
    ids=["another number", "another run", "another scenario"],
)
def test_a_file_that_is_only_named_like_a_part(tmp_path: Path, other: dict[str, str]) -> None:
    log, sent = tmp_path / "a.mcap", traffic(4)
    parts(log, sent, [])
    scenario = b'{"name": "other"}' if "scenario" in other else SCENARIO
    with RecordingWriter(
        part(log, 2), scenario, {**METADATA, "part": "2", **other}, prefix="maniple"
    ) as writer:
        writer.write(*sent[0])
    assert read(log).paths == (log,)
    assert read(part(log, 2)).paths == (part(log, 2),)


def test_runs_of_one_scenario_are_not_parts_of_each_other(tmp_path: Path) -> None:
    """Only what says so is a part, whatever the names."""
    log = tmp_path / "a.mcap"
    for path in (log, part(log, 2), part(part(log, 2), 2)):
        with RecordingWriter(path, SCENARIO, METADATA, prefix="maniple") as writer:
            writer.write(*traffic(1)[0])
    parts(log.with_name("a-2.mcap").with_stem("a-3"), traffic(1), [])
    assert read(log).paths == (log,)
    assert read(part(log, 2)).paths == (part(log, 2),)


def test_a_part_behind_a_file_of_another_recording(tmp_path: Path) -> None:
    """A recorder that found its next name taken went on with the one after that."""
    log, sent = tmp_path / "a.mcap", traffic(10)
    parts(log, sent, [10, 20])
    with RecordingWriter(tmp_path / "other.mcap", SCENARIO, METADATA, prefix="maniple") as writer:
        writer.write(*sent[0])
    part(log, 2).rename(tmp_path / "second.mcap")
    (tmp_path / "other.mcap").rename(part(log, 2))
    recording = read(log)
    assert recording.paths == (log, part(log, 3))
    assert list(recording.messages()) == [*sent[:10], *sent[20:]]


def test_parts_without_a_message_are_passed_over(tmp_path: Path) -> None:
    log, sent = tmp_path / "a.mcap", traffic(12)
    parts(log, sent, [10, 20, 30])
    for number in (1, 3):
        part(log, number).write_bytes(b"")
    recording = read(log)
    assert recording.paths == (part(log, 2), part(log, 4))
    assert list(recording.messages()) == [*sent[10:20], *sent[30:]]
    assert [
        str(part(log, number)) in text for number, text in zip((1, 3), recording.passed_over, strict=True)
    ]


def test_the_end_of_a_name_is_not_always_a_part(tmp_path: Path) -> None:
    """Files are named after process ids."""
    log = tmp_path / "run-20261123-4711.mcap"
    sent = traffic(4)
    parts(log, sent, [8])
    assert read(log).paths == (log, tmp_path / "run-20261123-4711-2.mcap")


def test_damage_of_a_later_part_is_an_error(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    parts(log, traffic(12), [20])
    part(log, 2).write_bytes(b"something else")
    with pytest.raises(RecordingError, match=r"a-2\.mcap is not an MCAP file"):
        read(log)


def test_a_span_of_time_reads_only_its_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = traffic(200)
    recording = read(record(tmp_path / "a.mcap", sent))
    opened: list[int] = []

    def counted(file: Any, place: ChunkPlace, *others: Any) -> Any:
        opened.append(place.offset)
        return read_chunk(file, place, *others)

    monkeypatch.setattr("maniple.recording.reader.read_chunk", counted)
    start, end = sent[300].log_time_ns, sent[340].log_time_ns
    found = list(recording.messages(start_ns=start, end_ns=end))
    assert found == [entry for entry in sent if start <= entry.log_time_ns < end]
    assert len(opened) <= 3 < len(recording.layouts[0].chunks)


def test_what_can_not_be_read_is_told_where_that_is_asked_for(tmp_path: Path) -> None:
    sent = traffic()
    path = record(tmp_path / "a.mcap", sent)
    counts = _messages_per_chunk(path)
    place = scan(path).chunks[1]
    with path.open("r+b") as file:
        file.seek(place.offset + place.length - 30)
        file.write(b"garbage")
    damage: list[Damage] = []
    found = list(read(path).messages(skipped=damage.append))
    assert found == sent[: counts[0]] + sent[sum(counts[:2]) :]
    [one] = damage
    assert (one.path, one.offset, one.length) == (path, place.offset, place.length)


def test_messages_of_another_version_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their bytes may mean something else, even where they fit."""
    with monkeypatch.context() as older:
        older.setattr(codec, "encoding", lambda name: "application/msgpack;maniple.Drive@0")
        path = record(tmp_path / "a.mcap", traffic(1))
    [entry, *_] = read(path).messages()
    assert entry.message is None
    with pytest.raises(MessageError, match=r"another encoding than application/msgpack;maniple\.Drive@1"):
        entry.decode()
    assert list(read(path).decoded(messages.Drive)) == []
