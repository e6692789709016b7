"""What a scenario would run, for people and for machines."""

import math
from collections.abc import Iterator, Sequence

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from central_controller.reference import duration_s
from maniple.control.limits import age_limits
from maniple.control.pipeline import central_layers, onboard_layers
from maniple.core import topics
from maniple.core.faults import matches
from maniple.core.layers import Layer
from maniple.core.scenario.places import desired_shapes
from maniple.core.scenario.types import Fault, Point, Scenario


class RobotPlan(msgspec.Struct, frozen=True):
    """One robot."""

    id: str
    model: str
    sensor: str
    control_point_m: float
    place: Point
    """Of its control point in the formation, m."""
    pose: tuple[float, float, float]
    """Where the middle of its axle starts, m, m, rad."""
    hold_after_s: float
    stop_after_s: float


class TrianglePlan(msgspec.Struct, frozen=True):
    """One triangle of the chain with its desired shape, m and rad."""

    robots: tuple[str, str, str]
    p_m: float
    q_m: float
    beta_rad: float


class LinkPlan(msgspec.Struct, frozen=True):
    """What faults do to the messages of one topic on their way between two nodes."""

    source: str
    destination: str
    topic: str
    latency_s: float
    jitter_s: float
    loss: float


class Plan(msgspec.Struct, frozen=True):
    """What a scenario would run; what `maniple scenario check --json` prints."""

    scenario: str
    valid: bool
    seed: int
    task: str
    length_m: float
    duration_s: float
    robot_from: Layer
    obstacles: int
    robots: tuple[RobotPlan, ...]
    triangles: tuple[TrianglePlan, ...]
    links: tuple[LinkPlan, ...]
    """The links that faults apply to."""


def plan_of(scenario: Scenario) -> Plan:
    """What a resolved, valid scenario would run."""
    task = scenario.task
    return Plan(
        scenario=scenario.name,
        valid=True,
        seed=scenario.seed,
        task="line",
        length_m=math.dist(task.start, task.end),
        duration_s=duration_s(task),
        robot_from=scenario.placement.robot_from,
        obstacles=len(scenario.world.obstacles),
        robots=tuple(_robot_plan(scenario, index) for index in range(len(scenario.robots))),
        triangles=tuple(
            TrianglePlan(shape.robots, shape.p, shape.q, shape.beta) for shape in desired_shapes(scenario)
        ),
        links=tuple(plan for link in fleet_links(scenario) for plan in _link_plan(scenario.faults, *link)),
    )


def fleet_links(scenario: Scenario) -> Iterator[tuple[str, str, str]]:
    """Source, destination and topic of every link between the controller and the robots."""
    ranges = "avoidance" in central_layers(scenario.placement.robot_from) and scenario.avoidance.enabled
    for robot in scenario.robots:
        yield "controller", robot.id, topics.command(robot.id)
        yield robot.id, "controller", topics.odometry(robot.id)
        yield robot.id, "controller", topics.status(robot.id)
        if ranges:
            yield robot.id, "controller", topics.ranges(robot.id)


def picture(plan: Plan) -> Group:
    """The plan as text and tables."""
    onboard = ", ".join(onboard_layers(plan.robot_from)) or "only the guard"
    head = (
        f"{plan.scenario}: {len(plan.robots)} robots, {len(plan.triangles)} triangles, "
        f"{plan.obstacles} obstacles, seed {plan.seed}\n"
        f"task: {plan.task} of {plan.length_m:g} m in {plan.duration_s:g} s\n"
        f"on the robots: {onboard}\n"
    )
    faults = _links_table(plan.links) if plan.links else Text("no faults on any link")
    parts: list[RenderableType] = [Text(head), _robots_table(plan.robots), Text()]
    return Group(*parts, _triangles_table(plan.triangles), Text(), faults)


def _robot_plan(scenario: Scenario, index: int) -> RobotPlan:
    robot = scenario.robots[index]
    assert robot.pose is not None, "the scenario is resolved"
    hold_s, stop_s = age_limits(scenario, robot)
    return RobotPlan(
        id=robot.id,
        model=robot.model,
        sensor=robot.sensor,
        control_point_m=robot.control_point_m,
        place=scenario.formation.points[index],
        pose=robot.pose,
        hold_after_s=hold_s,
        stop_after_s=stop_s,
    )


def _link_plan(faults: Sequence[Fault], source: str, destination: str, topic: str) -> Iterator[LinkPlan]:
    """The rules that match a link, as one: delays add up, losses are independent; nothing without rules."""
    rules = [rule for rule in faults if matches(rule, source, destination, topic)]
    if rules:
        yield LinkPlan(
            source=source,
            destination=destination,
            topic=topic,
            latency_s=math.fsum(rule.latency_s for rule in rules),
            jitter_s=math.fsum(rule.jitter_s for rule in rules),
            loss=1.0 - math.prod(1.0 - rule.loss for rule in rules),
        )


def _table(left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in left:
        table.add_column(name, no_wrap=True)
    for name in right:
        table.add_column(name, no_wrap=True, justify="right")
    return table


def _robots_table(robots: Sequence[RobotPlan]) -> Table:
    numbers = ("a (m)", "place (m)", "start (m, m, rad)", "hold, stop after (s)")
    table = _table(("robot", "model", "sensor"), numbers)
    for robot in robots:
        table.add_row(
            robot.id,
            robot.model,
            robot.sensor,
            f"{robot.control_point_m:.2f}",
            ", ".join(f"{value:.2f}" for value in robot.place),
            ", ".join(f"{value:.3f}" for value in robot.pose),
            f"{robot.hold_after_s:.2f}, {robot.stop_after_s:.2f}",
        )
    return table


def _triangles_table(triangles: Sequence[TrianglePlan]) -> Table:
    table = _table(("triangle",), ("p (m)", "q (m)", "beta (rad)"))
    for one in triangles:
        table.add_row(" ".join(one.robots), f"{one.p_m:.3f}", f"{one.q_m:.3f}", f"{one.beta_rad:.3f}")
    return table


def _links_table(links: Sequence[LinkPlan]) -> Table:
    """Links that suffer the same in one row."""
    alike: dict[tuple[bool, str, float, float, float], list[str]] = {}
    for link in links:
        down = link.source == "controller"
        what = link.topic.rpartition("/")[2]
        robot = link.destination if down else link.source
        alike.setdefault((down, what, link.latency_s, link.jitter_s, link.loss), []).append(robot)
    table = _table(("faults on", "robots"), ("latency (ms)", "jitter (ms)", "loss (%)"))
    for (down, what, latency_s, jitter_s, loss), robots in alike.items():
        way = f"{what} to" if down else f"{what} from"
        numbers = (f"{1000 * latency_s:.0f}", f"{1000 * jitter_s:.0f}", f"{100 * loss:.1f}")
        table.add_row(way, " ".join(robots), *numbers)
    return table
