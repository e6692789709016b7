import math
from typing import Any

import pytest
from msgspec.structs import replace

from maniple.core.errors import ScenarioError
from maniple.core.scenario.check import problems, require_valid
from maniple.core.scenario.parse import scenario_of, with_overrides
from maniple.core.scenario.resolve import resolve
from maniple.core.scenario.types import Scenario

Data = dict[str, Any]
SIX = [{"id": f"r{k}", "model": "cart", "sensor": "eye"} for k in range(1, 7)]


def checked(data: Data, *overrides: str) -> list[str]:
    return problems(resolve(scenario_of(with_overrides(data, overrides)), {}, {}))


def test_a_sound_scenario_has_no_problems(data: Data) -> None:
    assert checked(data) == []
    require_valid(resolve(scenario_of(data), {}, {}))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["robots.1.id=r1"], "robots[1].id = 'r1': robots[0] has it already; must be unique"),
        (
            ["robots.1.id=controller"],
            "robots[1].id = 'controller': names a node; must be none of controller, ",
        ),
        (["robots.1.id=router"], "robots[1].id = 'router': names a node"),
        (["robots.1.id=world"], "robots[1].id = 'world': names the world's frame"),
        (
            ["robots.1.pose=[0.6, 0.3, 0]"],
            "robots[1].pose = [0.6, 0.3, 0.0]: r2 touches r1 (robots[0], pose ",
        ),
        (["task.end=[0,0]"], "task.end = [0.0, 0.0]: is where task.start is"),
        (["task.speed_mps=0.75"], "task.speed_mps = 0.75: too fast for robots[0] (r1); must be < 0.75"),
        (["avoidance.d_min_m=0.95"], "avoidance.d_min_m = 0.95: must be < d_max_m = 0.95"),
        (["controller.kappa=0"], "controller.kappa = 0.0: must be >= 1e-06 and <= 1000"),
        (["controller.kappa=-0.1"], "controller.kappa = -0.1: must be >= 1e-06 and <= 1000"),
        (["controller.saturation=0"], "controller.saturation = 0.0: must be >= 1e-06 and <= 1000"),
        (["controller.kappa=1e300"], "controller.kappa = 1e+300: must be >= 1e-06 and <= 1000"),
        (
            ["controller.saturation=[1,1,1,1,5e-324,1]"],
            "controller.saturation[4] = 5e-324: must be >= 1e-06 and <= 1000",
        ),
        (
            ["task.speed_mps=1e-300"],
            "task.speed_mps = 1e-300: the way takes 3e+300 s; must be <= 1e+06 s",
        ),
        (
            ["guard.hold_after_s=2", "guard.stop_after_s=2"],
            "guard.hold_after_s = 2.0: must be < stop_after_s = 2.0",
        ),
        (["sensors.eye.range_min_m=8"], "sensors.eye.range_min_m = 8.0: must be < range_max_m = 8.0"),
        (["sensors.eye.increment_rad=0.04"], "must be <= 0.0349066 (360 degrees)"),
        (["models.cart.theta.0=0"], "models.cart.theta[0] = 0.0: must be > 0"),
        (["sensors.eye.cone_rad=0.5"], "sensors.eye.cone_rad = 0.5: must be left out for a fan"),
        (["sensors.eye.transducers=[[0, 0, 0]]"], "sensors.eye.transducers: are given, and so is a fan"),
        (
            ["sensors.eye.beams=0"],
            "sensors.eye: sees nothing; must have transducers, or a fan with beams >= 1",
        ),
        (["models.cart.theta.5=-1"], "models.cart.theta[5] = -1.0: must be > 0"),
        (["models.cart.drive='car'"], "models.cart.wheelbase_m: missing; must be given for drive = 'car'"),
        (
            ["models.cart.steer_max_rad=0.4"],
            "models.cart.steer_max_rad = 0.4: must be left out for drive = 'differential'",
        ),
        (["models.cart.drive='omnidirectional'"], "models.cart.v_max_mps: missing; must be given"),
        (["models.cart.wheel_error=[0.1]"], "models.cart.wheel_error = [0.1]: must have 2 numbers"),
        (
            ["models.cart.wheel_error=[0, -0.9]"],
            "models.cart.wheel_error[1] = -0.9: must be from -0.5 to 0.5",
        ),
        (["models.cart.track_error=2"], "models.cart.track_error = 2.0: must be from -0.5 to 0.5"),
        (
            ["models.cart.body_offset_m=0.3"],
            "models.cart.body_offset_m = 0.3: must be at most half of length_m",
        ),
        (
            ["models.cart.drive_timeout_s=0.05"],
            "drive_timeout_s = 0.05: the drive would brake between commands",
        ),
        (["rates.physics_hz=15"], "rates.motion_hz = 20.0: must be <= physics_hz = 15.0"),
        (["rates.scan_hz=101"], "rates.scan_hz = 101.0: must be <= physics_hz = 100.0"),
        (["rates.truth_hz=200"], "rates.truth_hz = 200.0: must be <= physics_hz = 100.0"),
        (["task.end=[20000,0]"], "task.end: reaches to [20000.0, 0.0]; must be within 10000 m"),
        (
            ["world.obstacles=[{kind='circle', centre=[1e300,0], radius_m=1}]"],
            "world.obstacles[0] (circle): reaches to [1e+300, -1.0]; must be within 10000 m",
        ),
        (
            ["world.obstacles=[{kind='box', centre=[9000,0], size=[3000,1]}]"],
            "world.obstacles[0] (box): reaches to [10500.0, 0.5]; must be within 10000 m",
        ),
        (
            [
                "world.obstacles=[{kind='wall', start=[9,9], end=[9,-1e4]}]",
                "world.obstacles.1={kind='wall', start=[9,9], end=[9,-2e4]}",
            ],
            "world.obstacles[1] (wall): reaches to [9.0, -20000.0]; must be within 10000 m",
        ),
        (["formation.points.0=[1e5,0]"], "formation.points[0] = [100000.0, 0.0]: must be within 10000 m"),
    ],
)
def test_what_makes_no_sense(data: Data, overrides: list[str], message: str) -> None:
    found = checked(data, *overrides)
    assert any(message in line for line in found), found


LINE = "{kind='line', start=[0,0], end=[3,0], speed_mps=0.1}"
STAND = "{kind='positioning', target=[3,0,0]}"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            "kind='waypoints', points=[[0,0],[1,0],[1,0],[2,0]], speed_mps=0.1",
            "points[2] = [1.0, 0.0]: is where the point before it is; must be more than 0.01 m away",
        ),
        (
            "kind='waypoints', points=[[0,0],[5,0],[1,0.1]], speed_mps=0.1",
            "points[1] = [5.0, 0.0]: the way turns back there, by 179 degrees; must be at most 170",
        ),
        (
            "kind='waypoints', points=[[0,0],[20000,0]], speed_mps=0.1",
            "points[1]: reaches to [20000.0, 0.0]; must be within 10000 m",
        ),
        ("kind='circle', centre=[0,0], radius_m=1e-9, speed_mps=0.1", "radius_m = 1e-09: must be >= 0.01"),
        (
            "kind='circle', centre=[9000,0], radius_m=2000, speed_mps=0.1",
            "radius_m: reaches to [11000.0, 2000.0]; must be within 10000 m",
        ),
        (
            "kind='circle', centre=[0,0], radius_m=5, speed_mps=0.1, turns=1e300",
            "speed_mps = 0.1: the way takes 3.14159e+302 s; must be <= 1e+06 s",
        ),
        (
            "kind='circle', centre=[0,0], radius_m=5, speed_mps=0.7",
            "speed_mps = 0.7: too fast for robots[2] (r3), whose place moves at up to 0.812 m/s on the "
            "outside of a turn; must be < 0.75, the u_max_mps of models.cart",
        ),
        (
            "kind='circle', centre=[0,0], radius_m=0.05, speed_mps=0.1",
            "speed_mps = 0.1: too fast for robots[0] (r1), whose place moves at up to 2 m/s",
        ),
        ("kind='figure-eight', centre=[0,0], size_m=1e-5, speed_mps=0.1", "size_m = 1e-05: must be >= 0.01"),
        (
            "kind='figure-eight', centre=[0,0], size_m=5, speed_mps=0.1, laps=1e300",
            "speed_mps = 0.1: the way takes ",
        ),
        ("kind='csv', file='a.csv'", "file = 'a.csv': has not been loaded"),
        (
            "kind='samples', times_s=[0,1,2], poses=[[0,0,0],[1,0,0]]",
            "poses: there are 2; must be 3, one for each of times_s",
        ),
        ("kind='samples', times_s=[1,2], poses=[[0,0,0],[1,0,0]]", "times_s[0] = 1.0: must be 0"),
        (
            "kind='samples', times_s=[0,2,2], poses=[[0,0,0],[1,0,0],[2,0,0]]",
            "times_s[2] = 2.0: must be at least 0.001 s after the one before, 2.0",
        ),
        (
            "kind='samples', times_s=[0,1], poses=[[0,0,0],[1,0,0]]",
            "times_s: too fast for robots[0] (r1); must be < 0.75, the u_max_mps of models.cart",
        ),
        (
            "kind='samples', times_s=[0,2e6], poses=[[0,0,0],[1,0,0]]",
            "times_s: the way takes 2e+06 s; must be <= 1e+06 s",
        ),
        (
            "kind='samples', times_s=[0,9], poses=[[0,0,0],[1e5,0,0]]",
            "poses[1]: reaches to [100000.0, 0.0]; must be",
        ),
        (
            "kind='positioning', target=[1e5,0,0]",
            "target: reaches to [100000.0, 0.0]; must be within 10000 m",
        ),
    ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_tasks_that_make_no_sense(data: Data, task: str, message: str, nested: bool) -> None:
    """Alone, and as the second part of a sequence; robots are placed, so that the start plays no part."""
    poses = [f"robots.{k}.pose=[{3 * k}, 5, 0]" for k in range(3)]
    if nested:
        data["task"] = {"kind": "sequence", "tasks": [data["task"]]}
    key, path = ("task.tasks.1", "task.tasks[1]") if nested else ("task", "task")
    if "csv" in task and not nested:
        with pytest.raises(ScenarioError, match="has not been loaded"):
            checked(data, *poses, f"{key}={{{task}}}")
        return
    (found,) = checked(data, *poses, f"{key}={{{task}}}")
    assert found.startswith(f"{path}.{message}")


@pytest.mark.parametrize(
    "task",
    [
        LINE,
        STAND,
        "{kind='waypoints', points=[[0,0],[5,0],[5,5],[0,9]], speed_mps=0.3, radius_m=2}",
        "{kind='circle', centre=[0,0], radius_m=5, speed_mps=0.5, turns=3}",
        "{kind='circle', centre=[0,0], radius_m=0.5, speed_mps=0.7, facing='fixed'}",
        "{kind='figure-eight', centre=[0,0], size_m=5, speed_mps=0.4}",
        "{kind='samples', times_s=[0,9,20], poses=[[0,0,0],[1,0,0.5],[2,2,1]]}",
        f"{{kind='sequence', tasks=[{LINE}, {STAND}, {LINE}]}}",
    ],
)
def test_tasks_that_make_sense(data: Data, task: str) -> None:
    del data["task"]
    assert checked(data, f"task={task}") == []


def test_one_too_fast_turn_of_the_whole_formation(data: Data) -> None:
    """Places near the origin are slow enough, but nobody turns that fast."""
    data["formation"]["points"] = [[0.05, 0], [0, 0.04], [0, -0.04]]
    data["supervisor"] = {"enabled": False}
    data["models"]["cart"] |= {"length_m": 0.03, "width_m": 0.03}
    poses = [f"robots.{k}.pose=[{3 * k}, 5, 0]" for k in range(3)]
    turn = "task={kind='samples', times_s=[0,1], poses=[[0,0,0],[0,0,2]]}"
    (found,) = checked(data, *poses, turn)
    assert found == (
        "task.times_s: the formation turns at up to 2 rad/s, too fast for robots[0] (r1); must be < 1.7, "
        "the w_max_radps of models.cart"
    )


# -- who guides and waits


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("controller.host=r9", "controller.host = 'r9': is not a robot; must be one of r1, r2, r3"),
        ("waiting={free_m=0.5, stop_m=0.5}", "waiting.free_m = 0.5: must be < stop_m = 0.5"),
        (
            "planning={build='straight', speed_mps=0.8}",
            "planning.speed_mps = 0.8: too fast for robots[0] (r1); must be < 0.75, the u_max_mps of "
            "models.cart",
        ),
        (
            "formation={points=[[0,0],[0,1],[0,-2]], shape={kind='vee', spacing_m=1}}",
            "formation: has points and a shape; must have one of them",
        ),
    ],
)
def test_what_else_makes_no_sense(data: Data, override: str, message: str) -> None:
    assert checked(data, override) == [message]


def test_a_shape_is_resolved_first(data: Data) -> None:
    data["formation"] = {"shape": {"kind": "vee", "spacing_m": 1.0}}
    assert checked(data) == []
    unresolved = replace(resolve(scenario_of(data), {}, {}), formation=scenario_of(data).formation)
    assert problems(unresolved) == [
        "formation.points: missing; must be those of its shape in a resolved scenario"
    ]


def test_places_of_different_triangles_may_not_coincide_either(data: Data) -> None:
    data["robots"] = SIX
    data["formation"]["points"] = [[0, 0], [1, 1], [2, 0], [3, 1], [4, 0], [1, 1]]
    poses = [f"robots.{k}.pose=[{3 * k}, 5, 0]" for k in range(6)]
    (found,) = checked(data, *poses)
    assert found.startswith("formation.points[5] = [1.0, 1.0]: is where formation.points[1] is")


def test_places_that_are_numbered_anew_may_come_in_any_order(data: Data) -> None:
    """Singular as they are written, but not as `relabel` chains them."""
    data["robots"] = [{**robot, "pose": [3.0 * k, 5, 0]} for k, robot in enumerate([*SIX[:4]])]
    data["formation"]["points"] = [[1, 0], [0, 0], [2, 0], [1, 1]]
    assert len(checked(data)) == 1
    assert checked(data, "planning.relabel=true") == []
    data["formation"]["points"][1] = [2, 0]
    (found,) = checked(data, "planning.relabel=true")
    assert found.startswith("formation.points[2] = [2.0, 0.0]: is where formation.points[1] is")


def test_fewer_than_three_robots(data: Data) -> None:
    data["robots"].pop()
    data["formation"]["points"].pop()
    assert checked(data) == ["robots: there are 2; must be at least 3, for one triangle"]


def test_the_number_of_places(data: Data) -> None:
    for robot in data["robots"]:
        robot["pose"] = [len(robot["id"]), 0, 0]
    data["formation"]["points"].append([3, 3])
    assert checked(data) == ["formation.points: has 4 points; must be 3, one for each robot"]


def test_an_unresolved_scenario_is_refused(data: Data) -> None:
    found = problems(replace(scenario_of(data), models={}, sensors={}))
    assert "robots[0].model = 'cart': must be one of (none are defined)" in found
    assert "robots[0].sensor = 'eye': must be one of (none are defined)" in found
    assert "robots[2].pose: missing; must be [x, y, heading] in a resolved scenario" in found


# -- triangles


@pytest.mark.parametrize(
    ("points", "angle", "what"),
    [
        ([[0, 0], [0, 0.001], [2, 0]], "signed", "r1 and r2 are at the same place"),
        ([[0, 0], [2, 0], [0.001, 0]], "signed", "r1 and r3 are at the same place"),
        ([[0, 0], [2, 0], [-2, 0.001]], "signed", "r1 is midway between r2 and r3"),
        ([[0, 0], [2, 0], [-2, 0.001]], "unsigned", "r1 is midway between r2 and r3"),
        ([[0, 0], [2, 0], [4, 0.001]], "unsigned", "all three are in a line"),
    ],
)
def test_singular_triangles(data: Data, points: list[list[float]], angle: str, what: str) -> None:
    data["formation"]["points"] = points
    data["controller"] = {"angle": angle}
    spread = [{**robot, "pose": [3.0 * k, 5, 0]} for k, robot in enumerate(data["robots"])]
    found = checked({**data, "robots": spread})
    assert len(found) == 1
    assert found[0].startswith(f"formation.points[0:3]: the desired triangle r1, r2, r3 is singular: {what}")


def test_a_line_of_robots_is_singular_only_for_the_unsigned_angle(data: Data) -> None:
    data["formation"]["points"] = [[0, 0], [1, 0], [2, 0]]
    assert checked(data) == []
    assert len(checked(data, "controller.angle=unsigned")) == 1


@pytest.mark.parametrize(
    ("points", "kind", "size"),
    [
        ([[0, 0], [0.6, 0], [0, 0.8]], "median", 0.5),
        ([[0, 0], [0.6, 0], [0.9, 0.8]], "p", 0.6),
        ([[0, 0], [0.9, 0.8], [0.6, 0]], "q", 0.6),
    ],
)
def test_the_supervisor_lets_the_desired_shape_be(
    data: Data, points: list[list[float]], kind: str, size: float
) -> None:
    data["formation"]["points"] = points
    assert checked(data, f"supervisor.margin_m={size - 0.001}") == []
    assert checked(data, f"supervisor.margin_m={size + 0.001}", "supervisor.enabled=false") == []
    (found,) = checked(data, f"supervisor.margin_m={size + 0.001}")
    assert found == (
        f"supervisor.margin_m = {size + 0.001}: the desired triangle r1, r2, r3 (formation.points[0:3]) "
        f"is nearer than that to singular; must be < {size}, its {kind}"
    )


def test_the_supervisor_watches_the_height_for_the_unsigned_angle_only(data: Data) -> None:
    data["formation"]["points"] = [[0, 0], [1, 0.3], [2, 0]]
    assert checked(data, "supervisor.margin_m=0.5") == []
    (found,) = checked(data, "supervisor.margin_m=0.5", "controller.angle=unsigned")
    assert found.endswith("must be < 0.3, its height")


def test_every_triangle_of_the_chain_is_looked_at(data: Data) -> None:
    data["robots"] = SIX
    data["formation"]["points"] = [[0, 0], [1, 1], [2, 0], [3, 1], [4, 0], [2, 2]]
    found = checked(data)
    assert [line.split(":")[0] + ":" + line.split(":")[1] for line in found] == ["formation.points[3:6]"]


# -- bodies and obstacles


def test_bodies_are_rectangles_not_discs(data: Data) -> None:
    """Side by side, 0.41 m apart: the circles around them overlap, the bodies (0.5 x 0.4 m) do not."""
    beside = [f"robots.{k}.pose=[0, {0.41 * k}, 0]" for k in range(3)]
    assert checked(data, *beside) == []
    turned = [f"robots.{k}.pose=[0, {0.41 * k}, {math.pi / 2}]" for k in range(3)]
    assert len(checked(data, *turned)) == 2


def test_bodies_touch_in_the_desired_formation(data: Data) -> None:
    """Facing along it, wherever they start."""
    spread = [f"robots.{k}.pose=[{3 * k}, 5, 0]" for k in range(3)]
    data["formation"]["points"] = [[0, 0.41], [0, 0], [0.51, 0]]
    assert checked(data, *spread) == []
    data["formation"]["points"] = [[0, 0.41], [0, 0], [0.49, 0]]
    assert checked(data, *spread) == [
        "formation.points[2] = [0.49, 0.0]: r3 would touch r2 there (formation.points[1] = [0.0, 0.0]); "
        "must be farther away"
    ]
    (found,) = checked(data)
    assert "at the start" in found


def test_touching_is_overlapping(data: Data) -> None:
    assert len(checked(data, "robots.0.pose=[5, 0, 0]", "robots.1.pose=[5.5, 0, 0]")) == 1
    assert checked(data, "robots.0.pose=[5, 0, 0]", "robots.1.pose=[5.51, 0, 0]") == []


@pytest.mark.parametrize(
    ("obstacle", "kind"),
    [
        ("{kind='circle', centre=[5.3, 0], radius_m=0.1}", "circle"),
        ("{kind='circle', centre=[5, 0], radius_m=9}", "circle"),
        ("{kind='box', centre=[5.45, 0], size=[0.3, 0.3], angle_rad=0.785}", "box"),
        ("{kind='wall', start=[4, 0.15], end=[6, 0.15]}", "wall"),
        ("{kind='wall', start=[4.9, 0], end=[5.1, 0]}", "wall"),
        (
            "{kind='polygon', points=[[4,-1],[6,-1],[6,1],[5.2,1],[5.2,-0.1],[4.8,-0.1],[4.8,1],[4,1]]}",
            "polygon",
        ),
    ],
)
def test_robots_inside_or_touching_obstacles(data: Data, obstacle: str, kind: str) -> None:
    found = checked(data, "robots.1.pose=[5, 0, 0]", f"world.obstacles=[{obstacle}]")
    touching = f"robots[1].pose = [5.0, 0.0, 0.0]: r2 touches world.obstacles[0] ({kind}) at the start"
    assert f"{touching}; must be clear of it" in found


def test_robots_beside_obstacles(data: Data) -> None:
    beside = (
        "[{kind='circle', centre=[5.6, 0], radius_m=0.3}, {kind='wall', start=[4, 0.25], end=[6, 0.25]}, "
        "{kind='polygon', points=[[4,-1],[6,-1],[6,-0.3],[4,-0.3]]}]"
    )
    assert checked(data, "robots.1.pose=[5, 0, 0]", f"world.obstacles={beside}") == []


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ("{kind='wall', start=[9, 9], end=[9, 9]}", "world.obstacles[0].end = [9.0, 9.0]: is its start"),
        (
            "{kind='polygon', points=[[9,9],[10,10],[10,9],[9,10]]}",
            "world.obstacles[0].points: edges 0 and 2 meet",
        ),
        (
            "{kind='polygon', points=[[9,9],[10,9],[10,9.0000000001]]}",
            "world.obstacles[0].points: enclose no area",
        ),
        ("{kind='polygon', points=[[9,9],[9,9],[10,9]]}", "world.obstacles[0].points: edge 0 has no length"),
        ("{kind='polygon', points=[[8,8],[9,9],[10,10]]}", "world.obstacles[0].points: edges 0 and 2 meet"),
    ],
)
def test_obstacles_that_are_none(data: Data, obstacle: str, message: str) -> None:
    found = checked(data, f"world.obstacles=[{obstacle}]")
    assert len(found) == 1
    assert found[0].startswith(message)


# -- numbers


def test_scenarios_from_python_may_not_hold_other_numbers(data: Data) -> None:
    scenario: Scenario = resolve(scenario_of(data), {}, {})
    for bad in (math.nan, math.inf):
        broken = replace(scenario, guard=replace(scenario.guard, margin_m=bad))
        assert problems(broken) == [f"guard.margin_m = {bad}: must be a finite number >= 0"]
        with pytest.raises(ScenarioError, match=r"guard\.margin_m"):
            require_valid(broken)


def test_every_problem_has_a_line(data: Data) -> None:
    scenario = resolve(
        scenario_of(with_overrides(data, ["controller.kappa=0", "avoidance.d_min_m=3"])), {}, {}
    )
    with pytest.raises(ScenarioError) as caught:
        require_valid(scenario)
    assert len(str(caught.value).splitlines()) == 2


def test_a_full_turn_of_beams_is_allowed(data: Data) -> None:
    data["sensors"]["eye"] |= {"beams": 361, "increment_rad": math.pi / 180}
    assert checked(data) == []
    data["sensors"]["eye"]["beams"] = 362
    assert "362 beams make a fan of 361 degrees" in checked(data)[0]
