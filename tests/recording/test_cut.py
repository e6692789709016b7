from pathlib import Path

import pytest
from mcap.records import Attachment

from maniple.core import codec, messages
from maniple.core.errors import RecordingError
from maniple.core.time import SECOND
from maniple.recording.cut import cut, latched_before
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.recording.selection import EVERYTHING, Selection
from maniple.recording.writer import Latched, RecordingWriter, part
from tests.recording.test_recover import is_sound
from tests.recording.traffic import METADATA, SCENARIO, Sent, record, traffic


def stop(seq: int, now: int) -> Sent:
    """A latched message that is said on an occasion."""
    message = messages.EmergencyStop(
        source="operator", incarnation=1, seq=seq, stamp_ns=now - 5, stopped=True
    )
    return Sent("platoon/stop", codec.encode(message), now, now - 5, seq)


def with_viewers(path: Path, sent: list[Sent], **about: str) -> Path:
    with RecordingWriter(path, SCENARIO, {**METADATA, **about}, prefix="maniple") as writer:
        for key in ("/viz/x", "/viz/y"):
            writer.add_viewer_channel(key, "json", "x", "jsonschema", b"{}")
        for message in sent:
            writer.write(*message)
            writer.tick(message.log_time_ns)
            for key in ("/viz/x", "/viz/y"):
                writer.draw(key, b"{}", message.log_time_ns, message.log_time_ns)
    return path


def test_a_span_and_topics(tmp_path: Path) -> None:
    sent = traffic(60)
    recording = read(record(tmp_path / "a.mcap", sent))
    start = recording.start_ns
    chosen = Selection(start + SECOND, start + 2 * SECOND, ("hw/**",), ("**/scan",))
    found = cut(recording, chosen)
    assert found.out == str(tmp_path / "a-cut.mcap")
    got = list(read(found.out).messages())
    assert got == [entry for entry in sent if chosen.takes(entry.topic) and chosen.holds(entry.log_time_ns)]
    assert len(got) == found.messages == is_sound(Path(found.out)) == 40
    after = read(found.out)
    assert after.metadata == recording.metadata
    assert after.scenario_json == SCENARIO
    assert after.complete


def test_two_that_meet_are_the_whole(tmp_path: Path) -> None:
    sent = traffic(60)
    recording = read(record(tmp_path / "a.mcap", sent))
    middle = recording.start_ns + SECOND
    halves = [Selection(end_ns=middle), Selection(start_ns=middle)]
    for number, half in enumerate(halves):
        cut(recording, half, tmp_path / f"{number}.mcap")
    assert [m for number in (0, 1) for m in read(tmp_path / f"{number}.mcap").messages()] == sent


def test_what_is_missing_is_left_out_on_purpose_or_was_missing_before(tmp_path: Path) -> None:
    sent = [entry for entry in traffic(60) if entry.sequence != 30]
    recording = read(record(tmp_path / "a.mcap", sent))
    start = recording.start_ns
    found = cut(recording, Selection(start + SECOND, None, without=("hw/r2/**",)))
    info = describe(read(found.out))
    assert (info.missing, info.left_out) == (2, 40)
    assert info.absences == ("until 0.000 s: cut off", "hw/r2/**: cut off")
    again = cut(read(found.out), Selection(topics=("**/scan",)), tmp_path / "b.mcap")
    info = describe(read(again.out))
    assert (info.missing, info.left_out) == (1, 20)
    assert info.absences[1:] == (
        "hw/r2/**: cut off",
        "other topics than **/scan: cut off",
    )


def test_what_is_latched_goes_with_it(tmp_path: Path) -> None:
    """The last of before, with its own times, once."""
    sent = [stop(0, 10), *traffic(60), stop(1, 20 * SECOND + 10**18), stop(2, 30 * SECOND + 10**18)]
    recording = read(record(tmp_path / "a.mcap", sorted(sent, key=lambda m: m.log_time_ns)))
    chosen = Selection(start_ns=30 * SECOND + 10**18)
    found = cut(recording, chosen)
    assert found.latched == ("platoon/stop",)
    after = read(found.out)
    [held] = after.latched
    assert held == Latched(*stop(1, 20 * SECOND + 10**18)[:4])
    assert [m.sequence for m in after.messages()] == [2]
    assert latched_before(after, EVERYTHING) == after.latched
    assert latched_before(after, Selection(without=("platoon/*",))) == ()
    cut(after, Selection(start_ns=30 * SECOND + 10**18 + 1), tmp_path / "b.mcap")
    assert [one.data for one in read(tmp_path / "b.mcap").latched] == [stop(2, 30 * SECOND + 10**18).data]


def test_parts_become_one_file(tmp_path: Path) -> None:
    log, sent = tmp_path / "a.mcap", traffic(60)
    for number in (1, 2, 3):
        with_viewers(part(log, number), sent[(number - 1) * 80 : number * 80], part=str(number))
    found = cut(read(log), EVERYTHING, tmp_path / "b.mcap")
    assert found.files == tuple(str(part(log, number)) for number in (1, 2, 3))
    assert list(read(found.out).messages()) == sent
    assert found.viewer_messages == 2 * len(sent)
    assert read(found.out).viewer_keys == ("/viz/x", "/viz/y")
    is_sound(Path(found.out))


@pytest.mark.parametrize(
    ("selection", "drawn"),
    [
        (Selection(without=("**/scan",)), 40),
        (Selection(topics=("hw/**",)), 0),
        (Selection(topics=("hw/**", "viz/x")), 20),
        (Selection(without=("viz/**",)), 0),
    ],
)
def test_viewer_channels_are_chosen_by_name(tmp_path: Path, selection: Selection, drawn: int) -> None:
    recording = read(with_viewers(tmp_path / "a.mcap", traffic(5)))
    assert cut(recording, selection).viewer_messages == drawn


def test_nothing_is_left_of_a_cut_that_fails(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", traffic(60))
    recording = read(path)
    place = recording.layouts[0].chunks[-2]
    content = bytearray(path.read_bytes())
    content[place.offset + place.length - 20] ^= 4
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="maniple log recover"):
        cut(recording, EVERYTHING)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]
    with pytest.raises(RecordingError, match="exists already"):
        cut(recording, EVERYTHING, path)


def test_nothing_is_left_of_a_cut_that_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(60)))

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("maniple.recording.rewrite.Rewriter.flush", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cut(recording, EVERYTHING)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


def test_other_attachments_are_kept(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(3)))
    recording.layouts[0].attachments["x"] = Attachment(1, 2, "x", "text/plain", b"hello")
    cut(recording, EVERYTHING)
    assert [file.name for file in read(tmp_path / "a-cut.mcap").attachments] == ["scenario.json", "x"]
