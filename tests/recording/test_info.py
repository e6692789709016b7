import json
from pathlib import Path

import pytest

from maniple.core import codec
from maniple.core.messages import Call, Journal
from maniple.core.scenario.parse import digest_of
from maniple.recording.info import Info, StreamInfo, describe
from maniple.recording.reader import read
from maniple.recording.tally import Gap
from maniple.recording.writer import RecordingWriter, part
from tests.recording.traffic import METADATA, SCENARIO, Sent, drive, record, traffic


def info_of(tmp_path: Path, sent: list[Sent]) -> Info:
    return describe(read(record(tmp_path / "a.mcap", sent)))


def drives(seqs: list[int], incarnation: int = 1, source: str = "r1") -> list[Sent]:
    """One every 10 ns of log time, by their numbers."""
    return [Sent("hw/r1/drive", drive(seq, source, incarnation), 10 * seq, 0, seq) for seq in seqs]


def journal(sent: dict[str, int], now: int, source: str = "r1") -> Sent:
    message = Journal(source=source, incarnation=1, seq=0, stamp_ns=now, calls=(), sent=sent)
    return Sent(f"journal/{source}", codec.encode(message), now, now, 0)


def noted(path: Path, sent: list[Sent], notes: dict[str, dict[str, str]], **about: str) -> Info:
    """Of a recording with metadata."""
    with RecordingWriter(path, SCENARIO, {**METADATA, **about}, prefix="maniple") as writer:
        for name, values in notes.items():
            writer.note(name, values)
        for message in sent:
            writer.write(*message)
    return describe(read(path))


def stream(info: Info, topic: str = "hw/r1/drive") -> StreamInfo:
    [found] = next(channel.streams for channel in info.channels if channel.topic == topic)
    return found


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


def test_whose_journal_begins_with_another_scenario_is_told(tmp_path: Path) -> None:
    sent = []
    for now, (source, digest) in enumerate((("r1", digest_of(SCENARIO)), ("r2", "a" * 64), ("r3", ""))):
        calls = (Call("start", now, digest), Call("timer", now, "b" * 64))
        journal = Journal(source=source, incarnation=3, seq=0, stamp_ns=now, calls=calls)
        sent.append(Sent(f"journal/{source}", codec.encode(journal), now, now, 0))
    (told,) = info_of(tmp_path, sent).other_scenarios
    assert told.startswith(f"r2 (life 3) runs another scenario ({'a' * 16}) than the recorder's (")


def test_recording_without_messages(tmp_path: Path) -> None:
    found = info_of(tmp_path, [])
    assert (found.messages, found.duration_s, found.channels) == (0, 0.0, ())


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


def test_messages_that_this_version_cannot_read(tmp_path: Path) -> None:
    """They are counted; those of an unknown topic can't be judged."""
    data = drive(1).replace(b"u_mps", b"u_xxx")
    found = info_of(
        tmp_path, [*drives([0]), Sent("hw/r1/drive", data, 0, 0, 1), Sent("else/where", data, 0, 0, 1)]
    )
    assert [(channel.unreadable, channel.headless) for channel in found.channels] == [(0, 0), (1, 0)]


def test_senders_say_what_was_lost_at_the_end_and_altogether(tmp_path: Path) -> None:
    sent = [*drives([0, 1]), journal({"hw/r1/drive": 5, "robot/r1/status": 3}, 100)]
    found = info_of(tmp_path, sent)
    assert (stream(found).sent, stream(found).missing, stream(found).missed_last) == (5, 3, 3)
    [lost] = [channel for channel in found.channels if not channel.messages]
    assert (lost.topic, lost.type, lost.missing, lost.rate_hz) == ("robot/r1/status", "Status", 3, 0.0)
    assert found.missing == 6


def test_a_pause_is_a_reason_and_what_is_missing_beside_it_is_not(tmp_path: Path) -> None:
    pauses = [{"from_ns": 45, "until_ns": 75, "reason": "lunch"}, {"from_ns": 115, "reason": ""}]
    notes = {"maniple.pauses": {"pauses": json.dumps(pauses)}}
    sent = [*drives([0, 2, 3, 4, 8, 9, 11]), journal({"hw/r1/drive": 14}, 140)]
    found = noted(tmp_path / "a.mcap", sent, notes)
    assert stream(found).gaps == (Gap(1, 1), Gap(5, 7), Gap(10, 10), Gap(12, 13))
    assert (found.missing, found.left_out) == (2, 5)
    assert found.absences == (
        "from 0.000 s until 0.000 s: paused: lunch",
        "from 0.000 s: paused: no reason given",
    )


def test_a_late_message_of_a_pause_is_there(tmp_path: Path) -> None:
    notes = {"maniple.pauses": {"pauses": json.dumps([{"from_ns": 5, "until_ns": 25, "reason": "x"}])}}
    sent = [*drives([0, 3]), Sent("hw/r1/drive", drive(1), 40, 0, 1)]
    assert stream(noted(tmp_path / "a.mcap", sent, notes)).left_out == 1


def test_a_filter_is_a_reason(tmp_path: Path) -> None:
    sent = [*drives([0, 2]), journal({"hw/r1/drive": 3, "hw/r1/scan": 7}, 50)]
    found = noted(tmp_path / "a.mcap", sent, {}, without="**/scan")
    assert (found.missing, found.left_out) == (1, 7)
    assert found.absences == ("**/scan: not recorded, as the recorder was told",)


@pytest.mark.parametrize("said", [{"pauses": "["}, {"pauses": '[{"reason": 1}]'}, {}])
def test_metadata_that_says_nothing_explains_nothing(tmp_path: Path, said: dict[str, str]) -> None:
    found = noted(tmp_path / "a.mcap", drives([1]), {"maniple.pauses": said}, topics="a//b")
    assert (found.missing, found.left_out, found.absences) == (1, 0, ())


def test_what_a_recorder_that_came_late_has_missed(tmp_path: Path) -> None:
    found = stream(info_of(tmp_path, drives([5, 6])))
    assert (found.missed_first, found.missing, found.left_out) == (5, 5, 0)


def test_parts_count_as_one(tmp_path: Path) -> None:
    """What is missing between them too; what both hold is not counted twice."""
    log = tmp_path / "a.mcap"
    for number, seqs in enumerate([[0, 1, 3], [2, 3, 7], [9]], 1):
        noted(part(log, number), drives(seqs), {}, part=str(number))
    assert [(describe(read(part(log, number))).missing) for number in (1, 2, 3)] == [4, 4, 0]
    whole = stream(describe(read(log)))
    assert whole.gaps == (Gap(4, 6), Gap(8, 8))
    assert whole.repeated == 1
    later = describe(read(part(log, 2)))
    assert (stream(later).left_out, later.absences) == (2, ("until 0.000 s: in earlier parts",))
    assert later.parts == (str(part(log, 2)), str(part(log, 3)))


def test_damage_is_told_and_the_rest_is_counted(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(41))
    recording = read(path)
    place = recording.layouts[0].chunks[1]
    content = bytearray(path.read_bytes())
    content[place.offset + place.length - 9] ^= 1
    path.write_bytes(content)
    found = describe(read(path))
    assert found.complete
    [what] = found.damage
    assert what.startswith(f"{path}: the chunk at byte {place.offset} is damaged")
    assert 0 < found.messages < 164
    assert found.missing == 164 - found.messages


def test_a_changed_byte_that_no_chunk_holds_is_told(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(41))
    path.write_bytes(path.read_bytes().replace(b"virtual", b"virtuel"))
    [what] = describe(read(path)).damage
    assert "checksum of the whole" in what
