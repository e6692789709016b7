import json
from collections.abc import Callable
from pathlib import Path

import pytest

from maniple.core.errors import ArgumentError, RecordingError
from maniple.core.time import MILLISECOND, SECOND, to_seconds
from maniple.recording.info import describe
from maniple.recording.merge import Merged, merge
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter
from tests.recording.traffic import METADATA, SCENARIO, Sent, drive, traffic


def written(
    path: Path, sent: list[Sent], scenario: bytes = SCENARIO, viewers: bool = False, **about: str
) -> Path:
    with RecordingWriter(path, scenario, {**METADATA, **about}, prefix="maniple") as writer:
        if viewers:
            writer.add_viewer_channel("/viz/x", "json", "x", "jsonschema", b"{}")
        for message in sent:
            writer.write(*message)
            writer.tick(message.log_time_ns)
            if viewers:
                writer.draw("/viz/x", b"{}", message.log_time_ns, message.log_time_ns)
    return path


def heard_by(sent: list[Sent], ahead_ns: int, keep: Callable[[int], bool]) -> list[Sent]:
    """What another recorder has of the same: some of it, by its own clock."""
    return [
        entry._replace(log_time_ns=entry.log_time_ns + ahead_ns)
        for number, entry in enumerate(sent)
        if keep(number)
    ]


def merged(tmp_path: Path, *logs: Path, reference: int = 0, take_reference: bool = False) -> Merged:
    return merge([read(log) for log in logs], tmp_path / "out.mcap", reference, take_reference)


def test_gaps_of_one_are_filled_by_the_other_on_one_clock(tmp_path: Path) -> None:
    sent = traffic(60)
    a = written(tmp_path / "a.mcap", heard_by(sent, 0, lambda n: n % 3 != 0), viewers=True)
    b = written(tmp_path / "b.mcap", heard_by(sent, -7 * SECOND, lambda n: n % 5 != 1), viewers=True)
    found = merged(tmp_path, a, b)
    recording = read(tmp_path / "out.mcap")
    times = {(entry.topic, entry.sequence): entry.log_time_ns for entry in sent}
    got = list(recording.messages())
    assert {(m.topic, m.sequence): m.log_time_ns for m in got} == {
        mark: time for number, (mark, time) in enumerate(times.items()) if number % 3 != 0 or number % 5 != 1
    }
    assert {(m.topic, m.sequence): m.data for m in got}.items() <= {
        (m.topic, m.sequence): m.data for m in sent
    }.items()
    assert len(got) == found.messages == 240 - 16
    assert [source.only_here for source in found.sources] == [160, 64]
    offset = found.sources[1].offset
    assert offset is not None
    assert (offset.ahead_ns, offset.spread_ns, offset.common) == (-7 * SECOND, 0, 128)
    assert found.missing == describe(recording).missing
    assert recording.viewer_keys == ("/viz/x",)
    assert sum(not topic for _, _, topic in recording.raw(lambda _: True)) == 160


def test_whose_clock_is_kept_is_chosen(tmp_path: Path) -> None:
    sent = traffic(10)
    a = written(tmp_path / "a.mcap", heard_by(sent, 0, lambda n: n < 30))
    b = written(tmp_path / "b.mcap", heard_by(sent, SECOND, lambda n: n >= 10))
    merged(tmp_path, a, b, reference=1)
    expected = [entry.log_time_ns + SECOND for entry in sent]
    assert [entry.log_time_ns for entry in read(tmp_path / "out.mcap").messages()] == expected


def test_three_that_hang_together_through_one(tmp_path: Path) -> None:
    """The first and the second have nothing in common but the third."""
    sent = traffic(30)
    a = written(tmp_path / "a.mcap", heard_by(sent, 0, lambda n: n < 50))
    b = written(tmp_path / "b.mcap", heard_by(sent, SECOND, lambda n: n >= 70))
    c = written(tmp_path / "c.mcap", heard_by(sent, -SECOND, lambda n: 40 <= n < 90))
    found = merged(tmp_path, a, b, c)
    assert list(read(tmp_path / "out.mcap").messages()) == sent
    assert [source.files for source in found.sources] == [(str(a),), (str(c),), (str(b),)]
    assert [source.only_here for source in found.sources] == [50, 40, 30]


def test_nothing_in_common(tmp_path: Path) -> None:
    sent = traffic(20)
    early, late = heard_by(sent, 0, lambda n: n < 30), heard_by(sent, 0, lambda n: n >= 40)
    a = written(tmp_path / "a.mcap", early, mode="realtime")
    b = written(tmp_path / "b.mcap", late, mode="realtime")
    with pytest.raises(RecordingError, match="no message in common"):
        merged(tmp_path, a, b)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(("mode", "anchor"), [("realtime", "5"), ("virtual", "")])
def test_nothing_in_common_but_the_clock(tmp_path: Path, mode: str, anchor: str) -> None:
    sent = traffic(20)
    early, late = heard_by(sent, 0, lambda n: n < 30), heard_by(sent, 0, lambda n: n >= 40)
    a = written(tmp_path / "a.mcap", early, mode=mode, anchor=anchor)
    b = written(tmp_path / "b.mcap", late, mode=mode, anchor=anchor)
    found = merged(tmp_path, a, b)
    assert found.sources[1].offset is None
    assert list(read(tmp_path / "out.mcap").messages()) == early + late


def test_a_changed_message_is_evidence(tmp_path: Path) -> None:
    sent = traffic(10)
    forged = [m._replace(data=drive(2, "r1")[:-1] + b"\xc2") if i == 8 else m for i, m in enumerate(sent)]
    assert forged[8].topic == "hw/r1/drive"
    a, b = written(tmp_path / "a.mcap", sent), written(tmp_path / "b.mcap", forged)
    found = merged(tmp_path, a, b)
    assert (found.out, found.differing) == ("", 1)
    [difference] = found.differences
    assert (difference.topic, difference.seq, difference.file) == ("hw/r1/drive", 2, str(b))
    assert not (tmp_path / "out.mcap").exists()
    assert merged(tmp_path, a, b, take_reference=True).out
    recording = read(tmp_path / "out.mcap")
    assert list(recording.messages()) == sent
    assert recording.all_metadata[0]["maniple.merged"]["differing"] == "1"


def test_what_has_no_header_is_told_apart_by_its_bytes(tmp_path: Path) -> None:
    common = traffic(2)
    a = written(tmp_path / "a.mcap", [*common, Sent("x", b"1", 5, 5, 0), Sent("x", b"2", 6, 6, 0)])
    b = written(tmp_path / "b.mcap", [*common, Sent("x", b"2", 6, 6, 0), Sent("x", b"3", 7, 7, 0)])
    merged(tmp_path, a, b)
    found = [m.data for m in read(tmp_path / "out.mcap").messages() if m.topic == "x"]
    assert found == [b"1", b"2", b"3"]


def test_numbers_that_leap_do_not_fill_the_memory(tmp_path: Path) -> None:
    seqs = [0, 2**40, 1, 2**62, 200_000, 3]
    sent = [Sent("hw/r1/drive", drive(seq), place, place, 0) for place, seq in enumerate(seqs)]
    a, b = written(tmp_path / "a.mcap", sent[:4]), written(tmp_path / "b.mcap", sent[2:])
    merged(tmp_path, a, b)
    assert list(read(tmp_path / "out.mcap").messages()) == sent


def test_other_runs_are_refused(tmp_path: Path) -> None:
    sent = traffic(3)
    a = written(tmp_path / "a.mcap", sent, anchor="1")
    cases = {
        "scenarios differ": written(tmp_path / "b.mcap", sent, scenario=b'{"name": "other"}'),
        "anchor 1 and 2": written(tmp_path / "c.mcap", sent, anchor="2"),
        "mode virtual and realtime": written(tmp_path / "d.mcap", sent, mode="realtime"),
    }
    for message, log in cases.items():
        with pytest.raises(RecordingError, match=message):
            merged(tmp_path, a, log)
    with pytest.raises(ArgumentError, match="twice"):
        merged(tmp_path, a, a)
    with pytest.raises(ArgumentError, match="two"):
        merged(tmp_path, a)


def test_what_was_left_out_by_one_only_is_no_reason_any_more(tmp_path: Path) -> None:
    sent = [Sent("hw/r1/drive", drive(seq), seq * MILLISECOND, 0, seq) for seq in range(10)]
    a = written(tmp_path / "a.mcap", sent[:8], without="sim/**", part="1")
    b = written(tmp_path / "b.mcap", sent[2:], without="sim/**", topics="hw/**", part="2")
    merged(tmp_path, a, b)
    about = read(tmp_path / "out.mcap").metadata
    assert about["without"] == "sim/**"
    assert not {"topics", "part"} & about.keys()


def test_a_pause_of_all_recorders_stays_a_reason_while_nobody_recorded(tmp_path: Path) -> None:
    """One pauses from 20 to 40, the other, 7 s behind, from 25 to 45; a third was there only before."""
    sent = traffic(60)

    def paused(path: Path, ahead_ns: int, numbers: range) -> Path:
        kept = heard_by(sent, ahead_ns, lambda number: number // 4 not in numbers)
        with RecordingWriter(path, SCENARIO, METADATA, prefix="maniple") as writer:
            for message in kept:
                writer.write(*message)
            first, last = (sent[4 * n].log_time_ns + ahead_ns for n in (numbers.start, numbers.stop))
            pauses = [{"from_ns": first, "until_ns": last, "reason": "lunch"}]
            writer.note("maniple.pauses", {"pauses": json.dumps(pauses)})
        return path

    a = paused(tmp_path / "a.mcap", 0, range(20, 40))
    b = paused(tmp_path / "b.mcap", -7 * SECOND, range(25, 45))
    c = written(tmp_path / "c.mcap", heard_by(sent, 0, lambda number: number < 40))
    found = merged(tmp_path, a, b, c)
    about = describe(read(tmp_path / "out.mcap"))
    assert (found.messages, about.missing, about.left_out) == (4 * 45, 0, 4 * 15)
    begin, first, last = (sent[number].log_time_ns for number in (0, 4 * 25, 4 * 40))
    assert about.absences == (
        f"from {to_seconds(first - begin):.3f} s until {to_seconds(last - begin):.3f} s: paused: lunch",
    )


def test_what_another_recorded_in_a_pause_is_not_left_out(tmp_path: Path) -> None:
    sent = traffic(20)
    with RecordingWriter(tmp_path / "a.mcap", SCENARIO, METADATA, prefix="maniple") as writer:
        for message in sent[:20] + sent[60:]:
            writer.write(*message)
        pauses = [{"from_ns": sent[20].log_time_ns, "until_ns": sent[60].log_time_ns, "reason": ""}]
        writer.note("maniple.pauses", {"pauses": json.dumps(pauses)})
    b = written(tmp_path / "b.mcap", heard_by(sent, 0, lambda number: number != 30))
    merged(tmp_path, tmp_path / "a.mcap", b)
    about = describe(read(tmp_path / "out.mcap"))
    assert (about.missing, about.left_out, about.absences) == (1, 0, ())
