from pathlib import Path
from typing import Any

import pytest

from maniple.cli.log.options import selection_of
from maniple.core.errors import ArgumentError
from maniple.core.time import SECOND
from maniple.recording.reader import Recording, read
from maniple.recording.selection import Selection
from tests.recording.traffic import record, traffic


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return read(record(tmp_path / "a.mcap", traffic(41)))


def test_nothing_given_is_everything(recording: Recording) -> None:
    assert selection_of(recording) == Selection()


def test_times_count_from_the_first_message(recording: Recording) -> None:
    chosen = selection_of(recording, 0.5, 1.0, ["hw/r1/**"], ["**/scan"])
    start = recording.start_ns
    assert chosen == Selection(start + SECOND // 2, start + SECOND, ("hw/r1/**",), ("**/scan",))
    found = [(entry.topic, entry.sequence) for entry in recording.selected(chosen)]
    assert found == [("hw/r1/drive", seq) for seq in range(10, 20)]
    everything = list(recording.messages())
    early, late = selection_of(recording, until_s=1.0), selection_of(recording, 1.0)
    assert [*recording.selected(early), *recording.selected(late)] == everything


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topics": ["robot/*"]}, "no topic of .* matches 'robot/\\*'; there are hw/r1/drive, hw/r1/scan"),
        ({"without": ["hw/r3/scan"]}, "no topic of .* matches 'hw/r3/scan'"),
        ({"topics": ["hw/r1/*"], "without": ["hw/**"]}, "leave nothing"),
        ({"start_s": 2.5}, "ends after 2.000 s"),
        ({"start_s": -1.0}, "--from -1: must be at least 0"),
        ({"start_s": float("nan")}, "--from nan"),
        ({"until_s": 0.0}, "--until 0: must be above 0"),
        ({"until_s": float("inf")}, "--until inf"),
        ({"start_s": 1.0, "until_s": 1.0}, "--from 1 --until 1: must end"),
    ],
)
def test_what_selects_nothing_is_an_error(
    recording: Recording, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        selection_of(recording, **options)
