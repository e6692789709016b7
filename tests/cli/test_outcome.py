"""Figures of a recording that has several parts."""

from pathlib import Path

import pytest

import maniple
from maniple.cli.outcome import figures_of, recordings_of
from maniple.core.errors import RecordingError
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter, part
from tests.cli.scenes import platoon


def test_names_of_parts() -> None:
    assert [str(part(Path("a/b.c.mcap"), number)) for number in (1, 2, 11)] == [
        "a/b.c.mcap",
        "a/b.c-2.mcap",
        "a/b.c-11.mcap",
    ]


def test_a_run_in_two_parts_has_the_figures_of_the_whole(tmp_path: Path) -> None:
    whole = maniple.run(platoon(3), virtual=True, duration_s=20, log=tmp_path / "whole.mcap")
    recording = read(whole.log)
    records = list(recording.messages())
    halves = (records[: len(records) // 2], records[len(records) // 2 :])
    logs = [part(tmp_path / "a.mcap", number) for number in (1, 2)]
    for log, half in zip(logs, halves, strict=True):
        with RecordingWriter(
            log, recording.scenario_json, dict(recording.metadata), prefix="maniple", now=half[0].log_time_ns
        ) as writer:
            for record in half:
                writer.write(*record)
    assert figures_of(logs, recording.scenario) == figures_of([Path(whole.log)], recording.scenario)


def test_a_part_that_was_never_begun_is_passed_over(tmp_path: Path) -> None:
    good = Path(maniple.run(platoon(3), virtual=True, duration_s=1, log=tmp_path / "a.mcap").log)
    (empty := tmp_path / "a-2.mcap").write_bytes(b"")
    assert [recording.path for recording in recordings_of([empty, good])] == [good]
    with pytest.raises(RecordingError, match=r"a-2\.mcap"):
        recordings_of([empty])
    assert recordings_of([]) == []
