"""Whole reports."""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.image
import pytest

from maniple.core.errors import ArgumentError, ManipleError, MissingExtraError, RecordingError
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter, part
from maniple.report.figures import KINDS
from maniple.report.writing import PAGE, Report, write
from tests.report.recordings import filtered, recorded


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("writing"))


@pytest.fixture(scope="module")
def written(log: Path) -> Report:
    return write(log)


@pytest.mark.slow
def test_a_recording_in_parts_is_reported_as_one(log: Path, written: Report, tmp_path: Path) -> None:
    """Figures, page and pictures are those of the recording in one file."""
    recording = read(log)
    middle = recording.start_ns + (recording.end_ns - recording.start_ns) // 2
    whole = {name: value for name, value in recording.metadata.items() if name != "prefix"}
    for number in (1, 2):
        path = part(tmp_path / "short.mcap", number)
        metadata = {**whole, "part": str(number)}
        with RecordingWriter(path, recording.scenario_json, metadata, prefix=recording.prefix) as writer:
            for record in recording.messages():
                if (record.log_time_ns < middle) is (number == 1):
                    writer.write(*record[:5])
    report = write(tmp_path / "short.mcap")
    assert report.parts == [str(tmp_path / "short.mcap"), str(tmp_path / "short-2.mcap")]
    assert report.figures == written.figures
    assert report.notes == written.notes
    assert Path(report.page).read_text() == Path(written.page).read_text().replace(
        "short.mcap", "short.mcap, short-2.mcap"
    )


class Page(HTMLParser):
    """Tags, and all that a browser would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in ("meta", "img"):
            self.open.append(tag)
        self.fetched += [value or "" for name, value in attrs if name == "src"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_every_figure_is_there_twice_and_on_the_page(log: Path, written: Report) -> None:
    folder = log.with_name("short-report")
    assert written.page == str(folder / PAGE)
    stems = [kind.name for kind in KINDS]
    assert sorted(Path(p).name for p in written.pictures) == sorted(
        f"{s}.{x}" for s in stems for x in ("png", "svg")
    )
    for picture in map(Path, written.pictures):
        if picture.suffix == ".svg":
            root = ElementTree.parse(picture).getroot()
            assert float((root.get("width") or "").removesuffix("pt")) == pytest.approx(3.5 * 72)
        else:
            assert matplotlib.image.imread(picture).std() > 0.02
    page = Page(Path(written.page).read_text())
    assert page.open == []
    assert len(page.fetched) == len(KINDS)


def test_the_page_needs_nothing_else(written: Report) -> None:
    text = Path(written.page).read_text()
    page = Page(text)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.fetched)
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    assert "Four robots &amp; &lt;one&gt; obstacle." in text
    assert written.outcome in text
    assert "dead reckoning explains up to" in text


@pytest.mark.slow
def test_the_same_recording_gives_the_same_bytes(log: Path, written: Report, tmp_path: Path) -> None:
    again = write(log, tmp_path / "again")
    for one, other in zip((written.page, *written.pictures), (again.page, *again.pictures), strict=True):
        assert Path(one).read_bytes() == Path(other).read_bytes(), one


@pytest.mark.slow
def test_an_earlier_report_is_not_overwritten_unless_told(log: Path, written: Report, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"short-report is not empty.*--force"):
        write(log)
    only = {
        name: filtered(log, tmp_path / f"{name}.mcap", lambda m, name=name: m.topic.endswith(name))  # type: ignore[misc]
        for name in ("truth", "status")
    }
    folder = tmp_path / "out"
    write(only["truth"], folder)
    (folder / "mine.txt").write_text("kept")
    second = write(only["status"], folder, force=True)
    names = {Path(picture).name for picture in second.pictures}
    assert {path.name for path in folder.iterdir()} == {PAGE, "mine.txt", *names}
    assert "command-age.png" in names
    assert "clearance.png" not in names


def test_what_is_no_folder(log: Path) -> None:
    with pytest.raises(ArgumentError, match="is not a folder"):
        write(log, log)
    with pytest.raises(ManipleError, match="can't write the report"):
        write(log, Path("/proc/nowhere"))


def test_a_recording_without_messages(log: Path, tmp_path: Path) -> None:
    empty = filtered(log, tmp_path / "empty.mcap", lambda m: False)
    report = write(empty)
    assert report.pictures == []
    assert len(report.notes) == len(KINDS) + 1
    assert "no ground truth" in report.notes[0]
    assert "no word of the controller" in report.outcome


@pytest.mark.slow
def test_a_recording_that_was_cut(log: Path, tmp_path: Path) -> None:
    part = filtered(log, tmp_path / "part.mcap", lambda m: m.topic in ("sim/truth", "formation/state"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(part.read_bytes()[: part.stat().st_size // 2])
    report = write(cut)
    assert "not finished" in report.notes[0]
    assert report.outcome.startswith("Not completed: it ended running, after")
    assert "was not finished" in Path(report.page).read_text()


def test_gaps_in_the_recording_are_said(log: Path, tmp_path: Path) -> None:
    holed = filtered(log, tmp_path / "h.mcap", lambda m: m.topic == "sim/truth" and m.sequence % 10 != 3)
    report = write(holed)
    assert re.search(r"^\d+ of \d+ messages are missing .* sim/truth \(\d+\)", report.notes[0])


def test_damaged_and_foreign_files(log: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"not a recording")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        write(foreign)
    data = bytearray(log.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with pytest.raises(RecordingError, match="is damaged"):
        write(damaged)
    assert not (tmp_path / "damaged-report").exists()


def test_matplotlib_may_be_missing(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"maniple\[report\]"):
        write(log, tmp_path / "out")


@pytest.mark.slow
def test_many_robots_that_lose_one(tmp_path: Path) -> None:
    """Ten robots: shown together, by their extremes."""
    points = [[round(-0.8 * i, 2), 0.9 * (-1) ** i] for i in range(10)]
    log = recorded(
        tmp_path,
        f"formation.points={points}",
        "robots=[" + ",".join(f"{{id='r{i}'}}" for i in range(10)) + "]",
        "crashes=[{node='r9', at_s=4.0}]",
    )
    report = write(log)
    assert len(report.pictures) == 2 * len(KINDS)
    assert report.figures.lost_robots == ["r9"]
    assert "Given up as lost at some time: r9." in report.notes
