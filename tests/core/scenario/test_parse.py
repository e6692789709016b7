import copy
import math
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.core.errors import ScenarioError
from maniple.core.scenario.parse import (
    json_data,
    scenario_of,
    to_json,
    toml_data,
    type_problems,
    with_overrides,
)
from maniple.core.scenario.types import Circle, Controller, Line, Scenario, Wall

Data = dict[str, Any]


def put(data: Data, *overrides: str) -> Scenario:
    return scenario_of(with_overrides(data, overrides))


def test_whole_numbers_become_floats(data: Data) -> None:
    scenario = scenario_of(data)
    assert isinstance(scenario.task, Line)
    assert isinstance(scenario.task.end[0], float)
    assert isinstance(scenario.models["cart"].theta[3], float)
    assert scenario.controller == Controller()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("controller.kapa=1", "controller.kapa: unknown field; valid: kappa, saturation, angle"),
        ("nonsense=1", "nonsense: unknown field; valid: name, description, seed, robots"),
        (
            "placement.robot_from=dirve",
            "placement.robot_from = 'dirve': must be one of kinematics, avoidance, compensation, drive",
        ),
        ("robots.2.control_point_m=-1", "robots[2].control_point_m = -1: must be a finite number > 0"),
        ("robots.1.control_point_m=inf", "robots[1].control_point_m = inf: must be a finite number > 0"),
        ("controller.kappa=nan", "controller.kappa = nan: must be a finite number"),
        (
            "controller.kappa=[1, 2]",
            "controller.kappa = [1, 2]: must be a list of 6, each a finite number > 0",
        ),
        ("controller.kappa=[1,1,1,1,1,-1]", "controller.kappa[5] = -1: must be a finite number > 0"),
        ("controller.kappa=fast", "controller.kappa = 'fast': must be a finite number, or a list of 6"),
        ("controller.kappa=true", "controller.kappa = true: must be a finite number, or a list of 6"),
        ("seed=1.5", "seed = 1.5: must be a whole number >= 0 and <= 9007199254740992"),
        ("seed=true", "seed = true: must be a whole number"),
        ("network.fleet_latency_s=1e300", "must be a finite number > 0 and <= 1000000"),
        ("task.settle_s=1e300", "task.settle_s = 1e+300: must be a finite number >= 0 and <= 1000000"),
        ("faults=[{latency_s=1e300}]", "faults[0].latency_s = 1e+300: must be a finite number >= 0 and <="),
        ("models.cart.drive_timeout_s=1e300", "models.cart.drive_timeout_s = 1e+300: must be"),
        (
            "guard.stop_after_s=1e300",
            "guard.stop_after_s = 1e+300: must be a finite number > 0 and <= 1",
        ),
        ("rates.status_hz=1e-300", "rates.status_hz = 1e-300: must be a finite number >= 0.001 and <= 1000"),
        ("guard.clearance=1", "guard.clearance = 1: must be true or false"),
        ("guard.hold_after_s=0", "guard.hold_after_s = 0: must be a finite number > 0"),
        ("faults.0.loss=1.5", "faults[0].loss = 1.5: must be a finite number >= 0 and <= 1"),
        ("rates.control_hz=1001", "rates.control_hz = 1001: must be a finite number >= 0.001 and <= 1000"),
        ("task.kind=arc", "task.kind = 'arc': must be one of line, waypoints, circle, figure-eight, csv, "),
        ("task=3", "task = 3: must be a table"),
        ("robots=r1", "robots = 'r1': must be a list of tables"),
        ("robots.0.pose=[1,2]", "robots[0].pose = [1, 2]: must be a list of 3"),
        ("robots.0.id='r 1'", "robots[0].id = 'r 1': must be text that matches"),
        ('robots.0.id="r1\\n"', "robots[0].id = 'r1\\n': must be text that matches"),
        (
            "world.obstacles.0={kind='cone'}",
            "world.obstacles[0].kind = 'cone': must be one of circle, box, polygon, wall",
        ),
        ("task={speed_mps=1}", "task.kind: missing; must be one of line, waypoints, circle, figure-eight, "),
        ("task={kind='sequence', tasks=[]}", "task.tasks = []: must be a list of tables, at least 1"),
        (
            "task={kind='sequence', tasks=[{kind='sequence'}]}",
            "task.tasks[0].kind = 'sequence': must be one of line, waypoints, ",
        ),
        ("controller.options={a=[1, nan]}", "controller.options.a[1] = nan: must be text, a finite number, "),
        ("controller.options={a={b=2001-01-01}}", "controller.options.a.b = datetime.date(2001, 1, 1): must"),
        (
            "world.obstacles.0={kind='circle', centre=[0,0]}",
            "world.obstacles[0].radius_m: missing; must be a finite number > 0",
        ),
        (
            "world.obstacles.0={kind='polygon', points=[[0,0],[1,1]]}",
            "world.obstacles[0].points = [[0, 0], [1, 1]]: must be a list of at least 3",
        ),
        ("models.cart.theta.0=x", "models.cart.theta[0] = 'x': must be a finite number"),
        ("sensors.eye.beams=-1", "sensors.eye.beams = -1: must be a whole number >= 0 and <= 10000"),
        ("formation.points.1.0=2001-01-01", "formation.points[1][0] = datetime.date(2001, 1, 1): must be"),
        ("name=2", "name = 2: must be text"),
    ],
)
def test_what_is_wrong_is_named_with_path_value_and_what_is_valid(
    data: Data, override: str, message: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        put(data, override)
    assert message in str(caught.value)


def test_every_problem_has_a_line(data: Data) -> None:
    with pytest.raises(ScenarioError) as caught:
        put(data, "seed=-1", "guard.margin_m=-1", "x=1")
    assert sorted(line.split(" ")[0] for line in str(caught.value).splitlines()) == [
        "guard.margin_m",
        "seed",
        "x:",
    ]


def test_missing_fields_are_named(data: Data) -> None:
    for name in ("name", "robots", "formation", "task"):
        less = {key: value for key, value in data.items() if key != name}
        with pytest.raises(ScenarioError, match=f"^{name}: missing"):
            scenario_of(less)
    del data["robots"][1]["id"]
    with pytest.raises(ScenarioError, match=r"robots\[1\].id: missing"):
        scenario_of(data)


def test_integers_too_large_for_a_float_are_refused(data: Data) -> None:
    data["task"]["speed_mps"] = 10**400
    with pytest.raises(ScenarioError, match=r"task.speed_mps = 10.*\.\.\.: must be a finite number > 0"):
        scenario_of(data)


def test_gains_may_be_one_number_or_six(data: Data) -> None:
    """A union that msgspec compiles wrongly when its lone number is constrained too."""
    assert put(data, "controller.kappa=1").controller.kappa == 1.0
    six = put(data, "controller.kappa=[1,2,3,4,5,6]", "controller.saturation=[1,1,1,1,1,0.5]").controller
    assert six.kappa == (1, 2, 3, 4, 5, 6)
    assert six.saturation == (1, 1, 1, 1, 1, 0.5)


# -- overrides


def test_overrides_leave_the_data_alone(data: Data) -> None:
    before = copy.deepcopy(data)
    with_overrides(data, ["seed=3", "robots.0.pose=[0,0,0]", "controller.kappa=1"])
    assert data == before


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("seed=3", ("seed",), 3),
        ("controller.kappa=0.5", ("controller", "kappa"), 0.5),
        ("guard.clearance = false", ("guard", "clearance"), False),
        ("placement.robot_from=drive", ("placement", "robot_from"), "drive"),
        ('description="a = b"', ("description",), "a = b"),
        ("description=a=b", ("description",), "a=b"),
        ("description=", ("description",), ""),
        ("robots.0.pose=[1, 2, 3]", ("robots", 0, "pose"), [1, 2, 3]),
        ("robots.r2.pose=[1, 2, 3]", ("robots", 1, "pose"), [1, 2, 3]),
        ("formation.points.2.1=7", ("formation", "points", 2, 1), 7),
        ("faults.0.loss=0.3", ("faults",), [{"loss": 0.3}]),
        ("faults=[{loss=0.3}]", ("faults",), [{"loss": 0.3}]),
        ("world.obstacles.0.kind=wall", ("world",), {"obstacles": [{"kind": "wall"}]}),
        ("robots.3={id='r4'}", ("robots", 3), {"id": "r4"}),
    ],
)
def test_overrides_reach_every_place(data: Data, override: str, path: tuple[Any, ...], value: Any) -> None:
    found: Any = with_overrides(data, [override])
    for key in path:
        found = found[key]
    assert found == value


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed", "must be key=value"),
        ("=3", "must be key=value"),
        ("a..b=3", "must be key=value"),
        (
            "robots.r9.pose=[0,0,0]",
            "override of robots.r9: must be an index from 0 to 3, or one of r1, r2, r3",
        ),
        ("robots.4.pose=[0,0,0]", "override of robots.4: must be an index from 0 to 3"),
        ("robots.-1.pose=[0,0,0]", "override of robots.-1: must be an index"),
        ("formation.points.x=1", "override of formation.points.x: must be an index from 0 to 3"),
        ("name.x=1", "name has no parts, it is 'small'"),
        ("robots=[1", "the value is not TOML"),
        ("name='a", "the value is not TOML"),
        ("seed=1\nname=2", "must be one value"),
    ],
)
def test_overrides_that_lead_nowhere(data: Data, override: str, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        with_overrides(data, [override])
    assert message in str(caught.value)


def test_later_overrides_win_and_see_earlier_ones(data: Data) -> None:
    result = with_overrides(
        data, ["faults.0.loss=0.1", "faults.0.latency_s=1", "faults.1.loss=1", "seed=1", "seed=2"]
    )
    assert result["faults"] == [{"loss": 0.1, "latency_s": 1}, {"loss": 1}]
    assert result["seed"] == 2


# -- JSON and TOML


def test_json_gives_the_same_scenario_back(data: Data) -> None:
    data["world"] = {"obstacles": [{"kind": "circle", "centre": [0.1, 1 / 3], "radius_m": 1e-17}]}
    data["controller"] = {"kappa": [0.1, 0.2, 0.3, 1e300, 5e-324, 6]}
    scenario = scenario_of(data)
    assert scenario_of(json_data(to_json(scenario))) == scenario
    assert to_json(scenario_of(json_data(to_json(scenario)))) == to_json(scenario)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2), max_size=5))
def test_json_keeps_every_bit_of_a_number(points: list[tuple[float, float]]) -> None:
    scenario = scenario_of(
        {
            "name": "x",
            "robots": [],
            "formation": {"points": points},
            "task": {"kind": "line", "start": [0, 0], "end": [1, 0], "speed_mps": 1},
        }
    )
    back = scenario_of(json_data(to_json(scenario))).formation.points
    assert [tuple(map(float.hex, point)) for point in back] == [tuple(map(float.hex, p)) for p in points]


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[1]", b"3", b"\xff", b'{"a": "\xff"}', b"[" * 100_000, b'{"a":' * 100_000]
)
def test_what_is_no_json_table(text: bytes) -> None:
    with pytest.raises(ScenarioError, match="not valid JSON"):
        json_data(text)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        (b"a = \nb = 1", "line 1"),
        (b"a = 1\nb = 2\nb = 3\n", "line 3"),
        (b"x = 1\n\xff\xfe", "line 2"),
        (b"\x00\x01", "line 1"),
        (b"a = " + b"9" * 5000, ""),
        (b"a = " + b"[" * 100_000, ""),
        (b"[a]\n[a]", "line 2"),
    ],
)
def test_toml_errors_are_one_line_with_a_line_number(text: bytes, where: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        toml_data(text)
    assert str(caught.value).startswith("not valid TOML: ")
    assert where in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_harmless() -> None:
    assert toml_data(b"\xef\xbb\xbfa = 1") == {"a": 1}


# -- scenarios made in Python, where constructors check nothing


def test_scenarios_from_python_are_checked_too(data: Data) -> None:
    scenario = scenario_of(data)
    assert type_problems(scenario) == []
    broken = msgspec.structs.replace(
        scenario,
        seed=-1,
        world=msgspec.structs.replace(
            scenario.world,
            obstacles=(Circle(centre=(math.nan, 0.0), radius_m=0.0), Wall(start=(0, 0), end=(1, 0))),
        ),
    )
    assert type_problems(broken) == [
        "seed = -1: must be a whole number >= 0 and <= 9007199254740992",
        "world.obstacles[0].centre[0] = nan: must be a finite number",
        "world.obstacles[0].radius_m = 0.0: must be a finite number > 0",
    ]


def test_nor_may_they_hold_other_things(data: Data) -> None:
    broken = msgspec.structs.replace(scenario_of(data), robots=(object(),))
    assert len(type_problems(broken)) == 1
