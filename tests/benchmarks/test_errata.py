"""What docs/paper.md says of the paper's errata is what the commands print."""

import re

import pytest

from benchmarks.errata import ERRATA, main
from benchmarks.lone_robot import AHEAD_M, BEAMS, DISC_M, drive_past, seen
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Avoidance

SLOW = ("thrown", "later", "reference", "mirror")


def figures(name: str) -> list[list[float]]:
    """The numbers of each line."""
    return [
        [float(text) for text in re.findall(r"[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?", line)]
        for line in ERRATA[name]()
    ]


@pytest.mark.parametrize("name", [name for name in ERRATA if name not in SLOW])
def test_every_erratum_is_shown(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([name])
    heading, *lines = capsys.readouterr().out.splitlines()
    assert heading == f"{name}: {ERRATA[name].__doc__}"
    assert lines
    assert "nan" not in " ".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_every_slow_erratum_is_shown(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([name])
    assert len(capsys.readouterr().out.splitlines()) > 2


def test_an_unknown_name_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["sinus"])
    assert "there are position" in capsys.readouterr().err


def test_an_unwrapped_error_goes_the_long_way() -> None:
    wrapped, raw = figures("wrapping")
    assert wrapped[-2] < 0.3
    assert raw[-2] > 5.9


def test_a_robot_drives_through_what_counts_twice() -> None:
    returns, objects = figures("twice")
    assert returns[-1] < -DISC_M
    assert objects[-1] > 0.05


def test_without_anything_in_the_way_the_robot_stays_on_its_line() -> None:
    passage = drive_past(Avoidance(), 0.1, 0.2, 2.0)
    assert passage.off_line_m == 0.0
    assert passage.clearance_m == pytest.approx(1.6, abs=1e-3)


def test_the_laser_sees_the_near_side_of_the_disc() -> None:
    returns = seen(Pose(0.0, 0.0, 0.0), (AHEAD_M, 0.0))
    assert returns.distance.min() == pytest.approx(AHEAD_M - DISC_M)
    assert returns.bearing[returns.distance.argmin()] == pytest.approx(0.0, abs=1e-12)
    assert len(BEAMS) == 181
    assert len(seen(Pose(0.0, 0.0, 3.0), (AHEAD_M, 0.0)).distance) == 0
