import pytest

from maniple.core.errors import ArgumentError
from maniple.recording.selection import Selection, matches


@pytest.mark.parametrize(
    ("pattern", "topic", "expected"),
    [
        ("robot/*/odometry", "robot/r1/odometry", True),
        ("robot/*/odometry", "robot/r1/status", False),
        ("hw/*", "hw/r1/scan", False),
        ("hw/**", "hw/r1/scan", True),
        ("hw/**", "hw", True),
        ("hw/**", "hwx/r1", False),
        ("**", "a/b", True),
        ("**/scan", "hw/r1/scan", True),
        ("**/scan", "scan", True),
        ("**/scan", "hw/r1/noscan", False),
        ("a/**/b", "a/b", True),
        ("a/**/b", "a/x/y/b", True),
        ("a/**/b", "a/xb", False),
        ("**/**", "a", True),
        ("robot/r*/status", "robot/r12/status", True),
        ("robot/r*/status", "robot/x1/status", False),
        ("a.c", "abc", False),
    ],
)
def test_patterns(pattern: str, topic: str, expected: bool) -> None:
    assert matches(pattern, topic) is expected


@pytest.mark.parametrize("pattern", ["", "/a", "a//b", "a/", "a**", "a/**b"])
def test_patterns_that_match_nothing_are_refused(pattern: str) -> None:
    with pytest.raises(ArgumentError, match="robot/\\*/odometry"):
        Selection(topics=(pattern,))
    with pytest.raises(ArgumentError):
        Selection(without=(pattern,))


def test_topics() -> None:
    selection = Selection(topics=("robot/**", "sim/truth"), without=("robot/r2/*",))
    names = ("robot/r1/odometry", "robot/r2/odometry", "sim/truth", "hw/r1/scan")
    assert [selection.takes(name) for name in names] == [True, False, True, False]
    assert Selection().takes("anything")
    assert not Selection(without=("**",)).takes("anything")


def test_a_span_has_its_beginning_and_not_its_end() -> None:
    """So two that meet take everything once."""
    selection = Selection(start_ns=10, end_ns=20)
    assert [selection.holds(time) for time in (9, 10, 19, 20)] == [False, True, True, False]
    assert Selection().holds(0)
    assert Selection(start_ns=10).holds(10**30)
    with pytest.raises(ArgumentError, match="empty"):
        Selection(start_ns=10, end_ns=10)
