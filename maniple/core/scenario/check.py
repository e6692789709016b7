"""What types can't say: whether a resolved scenario makes sense as a whole."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

from maniple.core.edges import WORLD
from maniple.core.errors import ScenarioError
from maniple.core.scenario import outline
from maniple.core.scenario.check_faults import fault_problems, some
from maniple.core.scenario.check_fence import fence_problems
from maniple.core.scenario.check_hardware import hardware_problems
from maniple.core.scenario.check_task import FARTHEST_M, TOLERANCE_M, speed_limit, task_problems
from maniple.core.scenario.parse import type_problems
from maniple.core.scenario.places import Shape, desired_shapes
from maniple.core.scenario.types import Obstacle, Polygon, PoseXY, RangeFinder, RobotModel, Scenario, Wall

RESERVED = ("controller", "simulator", "recorder", "router")
"""Names of nodes that no robot may have."""

LEAST_GAIN, MOST_GAIN = 1e-6, 1e3
"""The law divides gains and saturations by each other."""

MOST_ERROR = 0.5
"""Of a robot's geometry, relative."""


def require_valid(scenario: Scenario) -> None:
    """Refuse a resolved scenario that can't be run.

    Raises:
        ScenarioError: a line for each problem.
    """
    if found := problems(scenario):
        raise ScenarioError("\n".join(found))


def problems(scenario: Scenario) -> list[str]:
    """What is wrong with a resolved scenario: path, value and what would be valid; empty if nothing is."""
    if found := type_problems(scenario):
        return found
    found = [*_platoon(scenario), *_unresolved(scenario)]
    if found:
        return found
    parts = (
        _triangles,
        _supervised,
        _places,
        task_problems,
        _phases,
        _obstacles,
        _bodies,
        _models,
        _sensors,
        _controller,
        _limits,
        _rates,
        fault_problems,
        _distances,
        hardware_problems,
        fence_problems,
    )
    return [text for part in parts for text in part(scenario)]


def _platoon(scenario: Scenario) -> Iterator[str]:
    robots = scenario.robots
    if len(robots) < 3:
        yield f"robots: there are {len(robots)}; must be at least 3, for one triangle"
    ids = [robot.id for robot in robots]
    for index, name in enumerate(ids):
        if name in RESERVED:
            yield f"robots[{index}].id = {name!r}: names a node; must be none of {', '.join(RESERVED)}"
        if name == WORLD:
            yield f"robots[{index}].id = {name!r}: names the world's frame; must be another"
        if (first := ids.index(name)) < index:
            yield f"robots[{index}].id = {name!r}: robots[{first}] has it already; must be unique"
    yield from _formation(scenario)


def _formation(scenario: Scenario) -> Iterator[str]:
    points, robots = len(scenario.formation.points), len(scenario.robots)
    if scenario.formation.shape is None:
        if points != robots:
            yield f"formation.points: has {points} points; must be {robots}, one for each robot"
    elif points:
        yield "formation: has points and a shape; must have one of them"
    else:
        yield "formation.points: missing; must be those of its shape in a resolved scenario"


def _unresolved(scenario: Scenario) -> Iterator[str]:
    for index, robot in enumerate(scenario.robots):
        if robot.model not in scenario.models:
            yield f"robots[{index}].model = {robot.model!r}: must be one of {_names(scenario.models)}"
        if robot.sensor not in scenario.sensors:
            yield f"robots[{index}].sensor = {robot.sensor!r}: must be one of {_names(scenario.sensors)}"
        if robot.pose is None:
            yield f"robots[{index}].pose: missing; must be [x, y, heading] in a resolved scenario"


def _triangles(scenario: Scenario) -> Iterator[str]:
    """Singular triangles, which the law can't hold: it divides by their lengths."""
    if scenario.planning.relabel:
        return
    for index, shape in enumerate(desired_shapes(scenario)):
        fault = _singularity(shape, scenario.controller.angle)
        if fault:
            a, b, c = shape.robots
            yield (
                f"formation.points[{index}:{index + 3}]: the desired triangle {a}, {b}, {c} is singular: "
                f"{fault}; must differ by more than {TOLERANCE_M} m"
            )


def _supervised(scenario: Scenario) -> Iterator[str]:
    """Triangles that the supervisor would keep from their own shape."""
    margin = scenario.supervisor.margin_m
    if not scenario.supervisor.enabled or scenario.planning.relabel:
        return
    for index, shape in enumerate(desired_shapes(scenario)):
        watched = {"p": shape.p, "q": shape.q, "median": shape.median}
        if scenario.controller.angle == "unsigned":
            watched["height"] = shape.height
        kind = min(watched, key=watched.__getitem__)
        if TOLERANCE_M <= watched[kind] <= margin:
            yield (
                f"supervisor.margin_m = {margin}: the desired triangle {', '.join(shape.robots)} "
                f"(formation.points[{index}:{index + 3}]) is nearer than that to singular; "
                f"must be < {watched[kind]:.3g}, its {kind}"
            )
            return


def _singularity(shape: Shape, angle: str) -> str | None:
    a, b, c = shape.robots
    if shape.p < TOLERANCE_M:
        return f"{a} and {b} are at the same place (p = {shape.p:.3g} m)"
    if shape.q < TOLERANCE_M:
        return f"{a} and {c} are at the same place (q = {shape.q:.3g} m)"
    if shape.median < TOLERANCE_M:
        return f"{a} is midway between {b} and {c}, so that it has no heading"
    if angle == "unsigned" and shape.height < TOLERANCE_M:
        return "all three are in a line, where controller.angle = 'unsigned' breaks down ('signed' does not)"
    return None


def _places(scenario: Scenario) -> Iterator[str]:
    for (i, a), (j, b) in combinations(enumerate(scenario.formation.points), 2):
        near = j - i <= 2 and not scenario.planning.relabel  # of one triangle: told with its names
        if not near and math.dist(a, b) < TOLERANCE_M:
            yield (
                f"formation.points[{j}] = {list(b)}: is where formation.points[{i}] is; "
                f"must be more than {TOLERANCE_M} m away"
            )


def _phases(scenario: Scenario) -> Iterator[str]:
    """Who guides, and when it waits."""
    ids = [robot.id for robot in scenario.robots]
    host, wait, planning = scenario.controller.host, scenario.waiting, scenario.planning
    if host is not None and host not in ids:
        yield f"controller.host = {host!r}: is not a robot; must be one of {some(ids)}"
    if wait.free_m >= wait.stop_m:
        yield f"waiting.free_m = {wait.free_m}: must be < stop_m = {wait.stop_m}"
    for index, robot in enumerate(scenario.robots):
        limit, where = speed_limit(scenario, robot)
        if planning.build == "straight" and planning.speed_mps >= limit:
            yield (
                f"planning.speed_mps = {planning.speed_mps}: too fast for robots[{index}] ({robot.id}); "
                f"must be < {limit}, the {where}"
            )
            break


def _obstacles(scenario: Scenario) -> Iterator[str]:
    for index, obstacle in enumerate(scenario.world.obstacles):
        path = f"world.obstacles[{index}]"
        if isinstance(obstacle, Wall) and obstacle.start == obstacle.end:
            yield f"{path}.end = {list(obstacle.end)}: is its start; must be another point"
        if not isinstance(obstacle, Polygon):
            continue
        if (edges := outline.self_contact(obstacle.points)) is not None:
            i, j = edges
            what = f"edge {i} has no length" if i == j else f"edges {i} and {j} meet"
            yield f"{path}.points: {what}; must be the corners of a simple polygon, in order"
        elif abs(outline.area(obstacle.points)) < 1e-9:
            yield f"{path}.points: enclose no area; must be a polygon with an inside"


def _bodies(scenario: Scenario) -> Iterator[str]:
    """Robots that touch each other or an obstacle at the start, or each other in the desired formation, by
    their true outlines."""
    ids = [robot.id for robot in scenario.robots]
    poses = [robot.pose for robot in scenario.robots if robot.pose is not None]
    at_start = list(_touching(scenario, poses))
    for i, j in at_start:
        yield (
            f"robots[{j}].pose = {_rounded(poses[j])}: {ids[j]} touches {ids[i]} "
            f"(robots[{i}], pose {_rounded(poses[i])}) at the start; must be clear of it"
        )
    for index, obstacle in enumerate(scenario.world.obstacles):
        for i, (robot, pose) in enumerate(zip(scenario.robots, poses, strict=True)):
            if outline.gap_to(outline.body(pose, scenario.model_of(robot)), obstacle) == 0.0:
                yield (
                    f"robots[{i}].pose = {_rounded(pose)}: {ids[i]} touches world.obstacles[{index}] "
                    f"({_kind(obstacle)}) at the start; must be clear of it"
                )
    points = scenario.formation.points
    places = [
        (x - robot.control_point_m, y, 0.0) for robot, (x, y) in zip(scenario.robots, points, strict=True)
    ]
    told = set()
    for i, j in _touching(scenario, places):
        if j not in told and (i, j) not in at_start and math.dist(points[i], points[j]) >= TOLERANCE_M:
            told.add(j)
            yield (
                f"formation.points[{j}] = {_rounded(points[j])}: {ids[j]} would touch {ids[i]} there "
                f"(formation.points[{i}] = {_rounded(points[i])}); must be farther away"
            )


def _touching(scenario: Scenario, poses: Sequence[PoseXY]) -> Iterator[tuple[int, int]]:
    """Pairs of robots whose bodies would meet at these poses."""
    models = [scenario.model_of(robot) for robot in scenario.robots]
    reach = [outline.radius(model) for model in models]
    bodies = [outline.body(pose, model) for pose, model in zip(poses, models, strict=True)]
    for i, j in combinations(range(len(poses)), 2):
        near = math.dist(poses[i][:2], poses[j][:2]) <= reach[i] + reach[j]
        if near and outline.gap(bodies[i], bodies[j]) == 0.0:
            yield i, j


def _models(scenario: Scenario) -> Iterator[str]:
    for name, model in scenario.models.items():
        yield from _model(f"models.{name}", model)
        longest = 1.0 / scenario.rates.drive_hz
        if model.drive_timeout_s <= longest:
            yield (
                f"models.{name}.drive_timeout_s = {model.drive_timeout_s}: the drive would brake between "
                f"commands; must be > {longest:g}, the period of rates.drive_hz"
            )


def _model(path: str, model: RobotModel) -> Iterator[str]:
    for index in (0, 1, 3, 5):
        if model.theta[index] <= 0.0:
            yield f"{path}.theta[{index}] = {model.theta[index]}: must be > 0, or the drive is unstable"
    for field, drive in (
        ("wheelbase_m", "car"),
        ("steer_max_rad", "car"),
        ("v_max_mps", "omnidirectional"),
    ):
        value = getattr(model, field)
        if drive == model.drive and value is None:
            yield f"{path}.{field}: missing; must be given for drive = {drive!r}"
        elif drive != model.drive and value is not None:
            yield f"{path}.{field} = {value}: must be left out for drive = {model.drive!r}"
    wheels = 3 if model.drive == "omnidirectional" else 2
    if len(model.wheel_error) not in (0, wheels):
        yield f"{path}.wheel_error = {list(model.wheel_error)}: must have {wheels} numbers or none"
    for index, share in enumerate(model.wheel_error):
        if not abs(share) <= MOST_ERROR:
            yield f"{path}.wheel_error[{index}] = {share}: must be from -{MOST_ERROR} to {MOST_ERROR}"
    if not abs(model.track_error) <= MOST_ERROR:
        yield f"{path}.track_error = {model.track_error}: must be from -{MOST_ERROR} to {MOST_ERROR}"
    if abs(model.body_offset_m) > 0.5 * model.length_m:
        yield (
            f"{path}.body_offset_m = {model.body_offset_m}: must be at most half of length_m = "
            f"{model.length_m}: the axle is under the body"
        )


def _sensors(scenario: Scenario) -> Iterator[str]:
    for name, sensor in scenario.sensors.items():
        yield from _sensor(f"sensors.{name}", sensor)


def _sensor(path: str, sensor: RangeFinder) -> Iterator[str]:
    if sensor.range_min_m >= sensor.range_max_m:
        yield f"{path}.range_min_m = {sensor.range_min_m}: must be < range_max_m = {sensor.range_max_m}"
    if sensor.transducers:
        if sensor.beams or sensor.increment_rad:
            yield f"{path}.transducers: are given, and so is a fan; must be one of them (leave out beams)"
        return
    if sensor.cone_rad:
        yield f"{path}.cone_rad = {sensor.cone_rad}: must be left out for a fan; transducers have cones"
    if sensor.beams < 1 or sensor.increment_rad <= 0.0:
        yield (
            f"{path}: sees nothing; must have transducers, or a fan with beams >= 1 and increment_rad > 0 "
            f"(they are {sensor.beams} and {sensor.increment_rad})"
        )
        return
    fan = (sensor.beams - 1) * sensor.increment_rad
    if fan > 2.0 * math.pi + 1e-9:
        most = 2.0 * math.pi / (sensor.beams - 1)
        yield (
            f"{path}.increment_rad = {sensor.increment_rad}: {sensor.beams} beams make a fan of "
            f"{math.degrees(fan):.0f} degrees; must be <= {most:.6g} (360 degrees)"
        )


def _controller(scenario: Scenario) -> Iterator[str]:
    gains = scenario.controller
    for name, gain in (("kappa", gains.kappa), ("saturation", gains.saturation)):
        entries = enumerate(gain) if isinstance(gain, tuple) else [(None, gain)]
        for index, value in entries:
            if not LEAST_GAIN <= value <= MOST_GAIN:
                path = f"controller.{name}" if index is None else f"controller.{name}[{index}]"
                yield f"{path} = {value}: must be >= {LEAST_GAIN:g} and <= {MOST_GAIN:g}"


def _limits(scenario: Scenario) -> Iterator[str]:
    shell, guard = scenario.avoidance, scenario.guard
    if shell.d_min_m >= shell.d_max_m:
        yield f"avoidance.d_min_m = {shell.d_min_m}: must be < d_max_m = {shell.d_max_m}"
    hold, stop = guard.hold_after_s, guard.stop_after_s
    if hold is not None and stop is not None and hold >= stop:
        yield f"guard.hold_after_s = {hold}: must be < stop_after_s = {stop}"


def _rates(scenario: Scenario) -> Iterator[str]:
    rates = scenario.rates
    for name in ("motion_hz", "scan_hz", "truth_hz"):
        value = getattr(rates, name)
        if value > rates.physics_hz:
            yield f"rates.{name} = {value}: must be <= physics_hz = {rates.physics_hz}"


def _distances(scenario: Scenario) -> Iterator[str]:
    places = [(f"formation.points[{i}]", point) for i, point in enumerate(scenario.formation.points)]
    places += [(f"robots[{i}].pose", robot.pose[:2]) for i, robot in enumerate(scenario.robots) if robot.pose]
    for path, point in places:
        if max(map(abs, point)) > FARTHEST_M:
            yield f"{path} = {list(point)}: must be within {FARTHEST_M:g} m"
    for i, obstacle in enumerate(scenario.world.obstacles):
        corner = max(outline.box_around(obstacle), key=lambda corner: max(map(abs, corner)))
        if max(map(abs, corner)) > FARTHEST_M:
            what = f"world.obstacles[{i}] ({_kind(obstacle)})"
            yield f"{what}: reaches to {_rounded(corner)}; must be within {FARTHEST_M:g} m"


def _names(entries: Mapping[str, object]) -> str:
    return ", ".join(sorted(entries)) or "(none are defined)"


def _kind(obstacle: Obstacle) -> str:
    return type(obstacle).__name__.lower()


def _rounded(pose: Sequence[float]) -> list[float]:
    return [round(value, 3) for value in pose]
