"""How a run is recorded: options as values, and as the recorder takes them."""

from typing import Any

import pytest

from maniple.cli.loading import completed
from maniple.cli.node_commands import _parser
from maniple.cli.recording_options import EVERYTHING, RecordingOptions, notices, options_of, size_of
from maniple.core.errors import ArgumentError
from maniple.core.time import SECOND
from maniple.recording.split import Splits
from tests.cli.scenes import platoon


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("0", 0),
        ("100000", 100_000),
        ("500MB", 500_000_000),
        ("2GiB", 2 << 30),
        ("1.5 MB", 1_500_000),
        ("64k", 64_000),
        ("10Mi", 10 << 20),
        (" 7B ", 7),
    ],
)
def test_sizes(text: str, size: int) -> None:
    assert size_of(text) == size


@pytest.mark.parametrize("text", ["", "x", "-5", "5 apples", "1e9", "MB", "5iB", "1,5MB", "inf"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(ArgumentError, match="is no size; 500MB"):
        size_of(text)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"split_bytes": 999_999}, "split size: must be at least 1 MB"),
        ({"split_s": 0.5}, "split time = 0.5 s: must be from 1"),
        ({"split_s": float("nan")}, "split time"),
        ({"split_s": float("inf")}, "split time"),
        ({"compression": "lz4"}, "must be zstd or none"),
        ({"min_free_bytes": -1}, "min free"),
        ({"topics": ("a//b",)}, "topic pattern 'a//b'"),
        ({"topics": ("hw/**",), "without": ("**",)}, "nothing would be recorded"),
        ({"without": ("",)}, "topic pattern"),
    ],
)
def test_what_is_not_valid(values: dict[str, Any], problem: str) -> None:
    with pytest.raises(ArgumentError, match=problem):
        RecordingOptions(**values)


@pytest.mark.parametrize(
    "options",
    [
        EVERYTHING,
        RecordingOptions(
            split_bytes=5_000_000,
            split_s=1.25,
            compression="none",
            topics=("robot/**", "-odd"),
            without=("**/ranges", "hw/*/scan"),
            min_free_bytes=0,
            viz=False,
        ),
    ],
)
def test_the_recorder_gets_what_was_chosen(options: RecordingOptions) -> None:
    """By its own command line."""
    line = ["recorder", "--scenario", "-", "--log", "a.mcap", *options.arguments()]
    parsed = vars(_parser().parse_args(line))
    names = ("split_size", "split_time", "compression", "topic", "without", "min_free", "viz")
    assert options_of(**{name: parsed[name] for name in names}) == options


def test_what_is_left_out_is_said_in_the_recording() -> None:
    options = RecordingOptions(topics=("robot/**",), without=("**/ranges", "**/status"))
    assert options.metadata == {"topics": "robot/**", "without": "**/ranges **/status"}
    assert EVERYTHING.metadata == {}
    assert EVERYTHING.splits == Splits()
    assert RecordingOptions(split_s=2.0).splits == Splits(duration=2 * SECOND)


def test_a_choice_of_topics_has_its_price() -> None:
    scenario = completed(platoon(3))
    assert notices(EVERYTHING, scenario) == []
    (said,) = notices(RecordingOptions(without=("hw/*/scan",)), scenario)
    assert said.startswith("not recorded, as asked: ")
    assert said.startswith("not recorded, as asked: hw/r1/scan, hw/r2/scan, hw/r3/scan; ")
    assert "maniple log verify can't prove" in said
    (said,) = notices(RecordingOptions(without=("camera/**",)), scenario)
    assert said == "--without camera/** matches no topic of the scenario's nodes: it is for others only"
