import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from maniple.core.errors import ArgumentError
from maniple.core.messages import FormationState, Odometry, RobotReport, Scan, Stamp, Status, pack_floats
from maniple.recording.compare import Difference, Tolerance, differences, tolerance_of

ODOMETRY = Odometry(
    source="r1",
    incarnation=1,
    seq=7,
    stamp_ns=10**18,
    frame_id="r1",
    x_m=1.5,
    y_m=0.0,
    psi_rad=0.1,
    u_mps=0.2,
    w_radps=0.0,
    applied=Stamp(1, 2, 3),
    ticks=(10, 12),
)
STATE = FormationState(
    phase="running",
    task_time_s=1.0,
    task_duration_s=9.0,
    reference=(0.0, 1.0, 2.0),
    reference_velocity=(0.0, 0.0, 0.0),
    chain=("r1", "r2", "r3"),
    errors=pack_floats(np.arange(6.0)),
    roster=(RobotReport("r1", "present", 0.1, "tracking"), RobotReport("r2", "present", 0.2, "tracking")),
)


def found(first: Any, second: Any, *texts: str) -> list[tuple[str, Any, Any]]:
    return [tuple(one) for one in differences(first, second, tolerance_of(texts))]


def test_the_same_message() -> None:
    assert found(ODOMETRY, ODOMETRY) == []
    assert found(STATE, replace(STATE)) == []


def test_each_kind_of_value() -> None:
    changed = replace(
        ODOMETRY,
        x_m=math.nextafter(1.5, 2.0),
        y_m=-0.0,
        applied=Stamp(1, 5, 3),
        ticks=(10, 13),
        frame_id="r2",
    )
    assert found(ODOMETRY, changed) == [
        ("frame_id", "r1", "r2"),
        ("x_m", 1.5, 1.5000000000000002),
        ("y_m", 0.0, -0.0),
        ("applied.seq", 2, 5),
        ("ticks[1]", 12, 13),
    ]
    assert found(ODOMETRY, replace(ODOMETRY, applied=None)) == [
        ("applied", {"incarnation": 1, "seq": 2, "stamp_ns": 3}, None)
    ]
    assert found(ODOMETRY, replace(ODOMETRY, ticks=(10,))) == [("ticks", (10, 12), (10,))]


def test_inside_of_structs_and_arrays() -> None:
    errors = np.arange(6.0)
    errors[4] += 0.5
    roster = (STATE.roster[0], replace(STATE.roster[1], mode="holding"))
    assert found(STATE, replace(STATE, errors=pack_floats(errors), roster=roster)) == [
        ("errors[0][4]", 4.0, 4.5),
        ("roster[1].mode", "tracking", "holding"),
    ]
    longer = pack_floats(np.zeros(12))
    assert found(STATE, replace(STATE, errors=longer)) == [("len(errors)", 1, 2)]


def test_an_array_of_one_column_and_the_sign_of_nothing() -> None:
    scan = Scan(
        first_angle_rad=0.0,
        increment_rad=0.1,
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0, 0, 0),
        ranges=pack_floats([1.0, 0.0]),
    )
    assert found(scan, replace(scan, ranges=pack_floats([1.0, -0.0]))) == [("ranges[1]", 0.0, -0.0)]
    assert found(scan, replace(scan, ranges=pack_floats([1.0, -0.0])), "1e-12") == []


def test_a_map_by_its_keys() -> None:
    status = Status(
        mode="tracking",
        guard="none",
        command_age_s=0.1,
        command_age_max_s=0.1,
        driver="active",
        reason="",
        counters={"received": 5, "refused_old": 1},
    )
    other = replace(status, counters={"received": 6, "skipped": 2})
    assert found(status, other) == [
        ("counters[received]", 5, 6),
        ("counters[refused_old]", 1, None),
        ("counters[skipped]", None, 2),
    ]
    assert found(status, other, "counters=inf") == []


@pytest.mark.parametrize(
    ("values", "tolerance", "equal"),
    [
        ((1e-3, 2e-3), "1e-2", True),
        ((1e-3, 2e-3), "1e-4", False),
        ((1e6, 1e6 + 1.0), "1e-5", True),
        ((1e6, 1e6 + 100.0), "1e-5", False),
    ],
)
def test_absolute_below_one_and_relative_above(
    values: tuple[float, float], tolerance: str, equal: bool
) -> None:
    first, second = (replace(ODOMETRY, x_m=value) for value in values)
    assert (found(first, second, tolerance) == []) is equal


def test_whole_numbers_only_by_name() -> None:
    later = replace(ODOMETRY, stamp_ns=ODOMETRY.stamp_ns + 5, ticks=(10, 14))
    assert [one[0] for one in found(ODOMETRY, later, "0.5")] == ["stamp_ns", "ticks[1]"]
    assert [one[0] for one in found(ODOMETRY, later, "0.5", "ticks=0.2")] == ["stamp_ns"]
    assert found(ODOMETRY, later, "ticks=inf", "stamp_ns=inf") == []


def test_the_longest_name_that_fits_counts() -> None:
    state = replace(
        STATE, roster=(replace(STATE.roster[0], odometry_age_s=0.5), STATE.roster[1]), task_time_s=1.4
    )
    assert [one[0] for one in found(STATE, state)] == ["task_time_s", "roster[0].odometry_age_s"]
    assert [one[0] for one in found(STATE, state, "roster=1")] == ["task_time_s"]
    assert [one[0] for one in found(STATE, state, "roster=1", "roster.odometry_age_s=0.1")] == [
        "task_time_s",
        "roster[0].odometry_age_s",
    ]
    assert [one[0] for one in found(STATE, state, "FormationState.task_time_s=1")] == [
        "roster[0].odometry_age_s"
    ]
    assert len(found(STATE, state, "Odometry.x_m=1")) == 2


def test_a_tolerance_in_arrays() -> None:
    errors = np.arange(6.0) + 0.01
    near = replace(STATE, errors=pack_floats(errors))
    assert len(found(STATE, near)) == 6
    assert found(STATE, near, "errors=0.02") == []
    assert found(STATE, near, "errors=inf") == []


@pytest.mark.parametrize("text", ["", "much", "-1", "nan", "x_m=", "=1", "x..m=1", "x_m=nan"])
def test_what_is_no_tolerance(text: str) -> None:
    with pytest.raises(ArgumentError, match="must be a number from 0 up, or FIELD=NUMBER"):
        tolerance_of([text])


@pytest.mark.parametrize(
    "name", ["x_m", "Odometry.x_m", "counters", "counters.refused_old", "roster.odometry_age_s", "task.end"]
)
def test_a_field_that_there_is(name: str) -> None:
    assert tolerance_of([f"{name}=1"]).fields == ((name, 1.0),)


@pytest.mark.parametrize("name", ["xm", "Odometry.roster", "roster.x_m", "x_m.y_m", "Nothing.x_m", "x=1"])
def test_a_field_that_no_message_has(name: str) -> None:
    with pytest.raises(ArgumentError, match=f"no message has a field {name};"):
        tolerance_of([f"{name}=1"])


def test_options_become_a_tolerance() -> None:
    assert tolerance_of(["1e-6", "x_m=0.1", "roster.mode=inf"]) == Tolerance(
        1e-6, (("roster.mode", math.inf), ("x_m", 0.1))
    )
    assert Difference("x_m", 1.0, 2.0).path == "x_m"
