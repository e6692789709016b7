"""What two runs may differ in: options, files, patterns."""

from pathlib import Path

import pytest

from maniple.core.errors import ArgumentError
from maniple.report.comparison_tolerances import Tolerances, read_tolerances, require_used, tolerances_of

COMMAND = "robot/r1/command"


def test_the_last_rule_that_fits_counts() -> None:
    found = tolerances_of(["1e-9", "robot/**:values=0.5", "robot/r1/*:values=0.25", "**:answers=2"], [])
    assert found.of(COMMAND, "values[0]") == 0.25
    assert found.of("robot/r2/command", "values[1]") == 0.5
    assert found.of(COMMAND, "answers.seq") == 2.0
    assert found.of(COMMAND, "stamp_ns") == 1e-9
    assert Tolerances().of(COMMAND, "stamp_ns") == 0.0


@pytest.mark.parametrize(
    ("inside", "field", "covered"),
    [
        ("values", "values[0]", True),
        ("values[0]", "values[0]", True),
        ("values[0]", "values[1]", False),
        ("values[0]", "values[0][3]", True),
        ("roster.odometry_age_s", "roster[2].odometry_age_s", True),
        ("roster[2]", "roster[2].odometry_age_s", True),
        ("roster", "roster[2].odometry_age_s", True),
        ("ros", "roster[2].odometry_age_s", False),
        ("odometry_age_s", "roster[2].odometry_age_s", False),
        ("*_s", "task_time_s", True),
        ("errors", "errors.length", True),
    ],
)
def test_a_field_covers_what_is_inside(inside: str, field: str, covered: bool) -> None:
    found = tolerances_of([f"formation/state:{inside}=1"], [])
    assert found.of("formation/state", field) == float(covered)


def test_a_topic_is_ignored_as_a_whole_or_in_a_field() -> None:
    found = tolerances_of([], ["journal/**", "robot/*/status:counters"])
    assert found.ignores("journal/r1")
    assert found.ignores("journal/r1", "calls[0]")
    assert found.ignores("robot/r1/status", "counters.received")
    assert not found.ignores("robot/r1/status")
    assert not found.ignores("robot/r1/status", "mode")


def test_a_file_and_what_overrules_it(tmp_path: Path) -> None:
    path = tmp_path / "t.toml"
    path.write_text('default = 1e-6\nignore = ["journal/*"]\n[tolerances]\n"robot/*/command:values" = 1\n')
    file = read_tolerances(path)
    both = file.and_then(tolerances_of(["robot/r1/command:values=0"], ["links/*"]))
    assert both.of(COMMAND, "values[0]") == 0.0
    assert both.of("robot/r2/command", "values[0]") == 1.0
    assert both.of(COMMAND, "third") == 1e-6
    assert both.ignores("journal/r1")
    assert both.ignores("links/r1")
    assert file.and_then(tolerances_of(["0"], [])).of(COMMAND, "third") == 0.0


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("default = -1", "number from 0"),
        ("default = 'a'", "Expected `float | null`"),
        ("tolerance = 1", "unknown field `tolerance`"),
        ("[tolerances]\n':x' = 1", "NAME:FIELD"),
        ("[tolerances]\n'a//b' = 1", "single slashes"),
        ("default = ", "not valid TOML"),
        ("\xff", "UTF-8"),
    ],
)
def test_a_bad_file_is_one_message_that_names_it(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "t.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ArgumentError, match=told) as error:
        read_tolerances(path)
    assert str(path) in str(error.value)
    with pytest.raises(ArgumentError, match="can't be read"):
        read_tolerances(tmp_path / "none.toml")


@pytest.mark.parametrize("text", ["", "x", "-1", "nan", "a:b=c", "=1", ":f=1", "a:=1"])
def test_a_bad_option_is_one_message(text: str) -> None:
    with pytest.raises(ArgumentError, match=r"NAME:FIELD|number"):
        tolerances_of([text], [])


def test_rules_for_what_is_not_there_are_refused() -> None:
    rules = tolerances_of(["robot/*/command:values=1"], ["journal/*"])
    require_used(rules, [COMMAND, "journal/r1"])
    with pytest.raises(ArgumentError, match=r"'journal/\*' matches nothing.*there is robot/r1/command"):
        require_used(rules, [COMMAND])
