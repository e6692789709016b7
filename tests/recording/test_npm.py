"""Oracle: the MCAP implementation in TypeScript, which shares no code with the one in Python."""

from collections import Counter
from pathlib import Path

import pytest

from maniple.cli.loading import completed
from maniple.core import topics
from maniple.core.time import SECOND
from maniple.recording.split import Splits, ViewerChannel
from maniple.recording.viz import Viewer
from maniple.recording.writer import Compression
from tests.cli.scenes import platoon
from tests.recording.npm_reader import check, install
from tests.recording.test_split import goal, writer_to
from tests.recording.traffic import METADATA, SCENARIO, Sent, record, traffic


@pytest.fixture(scope="module")
def checker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("npm"))


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_typescript_readers_agree(checker: Path, tmp_path: Path, compression: Compression) -> None:
    sent = [*traffic(200), Sent("else/where", b"\x01", 1, 1, 0)]
    found = check(checker, record(tmp_path / "a.mcap", sent, compression))
    counts = Counter(f"maniple/{message.topic}" for message in sent)
    assert found["streamed"] == found["indexed"] == counts
    assert found["attachments"] == {"scenario.json": SCENARIO.decode()}
    assert found["metadata"] == {"maniple": {**METADATA, "prefix": "maniple"}}
    assert found["schemas"].pop("maniple/else/where") is None
    assert found["schemas"] == {
        key: f"maniple.{topics.topic(key.removeprefix('maniple/')).type.__name__}" for key in found["schemas"]
    }


@pytest.mark.slow
def test_typescript_readers_take_a_recording_without_messages(checker: Path, tmp_path: Path) -> None:
    found = check(checker, record(tmp_path / "a.mcap", []))
    assert found["streamed"] == found["indexed"] == {}


@pytest.mark.slow
def test_typescript_readers_take_parts_with_channels_for_viewers(checker: Path, tmp_path: Path) -> None:
    sent = traffic(100)
    viewer = Viewer(completed(platoon(3)))
    writer = writer_to(tmp_path, Splits(duration=SECOND))
    for channel in viewer.channels:
        writer.add_viewer_channel(ViewerChannel(*channel))
    first = sent[0].log_time_ns
    writer.write(topics.STOP, goal(0), first, first, 0)
    for number, message in enumerate(sent):
        writer.write(*message)
        writer.draw("/viz/log", b"", message.log_time_ns, message.log_time_ns)
        writer.note("counted", {"so far": str(number)})
    writer.close()
    counts: Counter[str] = Counter()
    for path in writer.paths:
        found = check(checker, path)
        assert found["streamed"] == found["indexed"]
        assert found["schemas"]["/viz/log"] == "foxglove.Log"
        counts.update(found["streamed"])
    assert counts["/viz/log"] == len(sent)
    assert counts.total() == 2 * len(sent) + 1
    assert f"latched/{topics.STOP}" in found["attachments"]
    assert found["metadata"]["counted"] == {"so far": str(len(sent) - 1)}
