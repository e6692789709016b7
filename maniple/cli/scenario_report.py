"""What a scenario would run, for people and for machines."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from central_controller.reference import Course
from maniple.cli import fault_text
from maniple.control.limits import age_limits
from maniple.control.pipeline import central_layers, onboard_layers
from maniple.core import edges, topics
from maniple.core.faults import matches
from maniple.core.layers import Layer
from maniple.core.scenario import fields
from maniple.core.scenario.places import (
    desired_shapes,
    end_pose,
    fastest_mps,
    fastest_place_mps,
    legs_of,
    start_pose,
)
from maniple.core.scenario.types import (
    Fault,
    FigureEight,
    Leg,
    Orbit,
    Point,
    Positioning,
    Robot,
    Samples,
    Scenario,
    Waypoints,
)
from maniple.core.scenario.ways import way_of

GAP_M = 0.01
"""Parts of a task that are farther apart than this are told."""


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


class LegPlan(msgspec.Struct, frozen=True):
    """One part of the task."""

    kind: str
    what: str
    start: tuple[float, float, float]
    """Pose of the formation's frame, m, m, rad."""
    end: tuple[float, float, float]
    length_m: float
    fastest_mps: float
    """Of the formation's frame."""
    duration_s: float
    """With the rest at its end."""
    estimated: bool
    """Whether the duration is: positioning takes as long as it takes."""


class LinkPlan(msgspec.Struct, frozen=True):
    """What faults do to the messages of one topic on their way between two nodes."""

    source: str
    destination: str
    topic: str
    latency_s: float
    jitter_s: float
    loss: float
    """These are what is always on."""
    also: tuple[str, ...] = ()
    """What else is, in words: bursts, copies, windows, ..."""


class Plan(msgspec.Struct, frozen=True):
    """What a scenario would run; what `maniple scenario check --json` prints."""

    scenario: str
    valid: bool
    seed: int
    task: str
    length_m: float
    duration_s: float
    legs: tuple[LegPlan, ...]
    """The parts of a sequence, or the whole task."""
    fastest_place_mps: float
    """Of all places of the formation, on the outside of turns too."""
    robot_from: Layer
    laws: tuple[str, ...]
    """Each layer that has gains, with these."""
    notes: tuple[str, ...]
    """What else is not as by default: planning, waiting, deaths, partitions, clocks, where the controller
    runs."""
    obstacles: int
    robots: tuple[RobotPlan, ...]
    triangles: tuple[TrianglePlan, ...]
    links: tuple[LinkPlan, ...]
    """The links that faults apply to."""


def plan_of(scenario: Scenario) -> Plan:
    """What a resolved, valid scenario would run."""
    task = scenario.task
    legs = _leg_plans(scenario)
    return Plan(
        scenario=scenario.name,
        valid=True,
        seed=scenario.seed,
        task=str(fields.type_of(type(task)).tag),
        length_m=math.fsum(leg.length_m for leg in legs),
        duration_s=math.fsum(leg.duration_s for leg in legs),
        legs=legs,
        fastest_place_mps=fastest_place_mps(scenario),
        laws=tuple(_laws(scenario)),
        notes=tuple(_notes(scenario)),
        robot_from=scenario.placement.robot_from,
        obstacles=len(scenario.world.obstacles),
        robots=tuple(_robot_plan(scenario, index) for index in range(len(scenario.robots))),
        triangles=tuple(
            TrianglePlan(shape.robots, shape.p, shape.q, shape.beta) for shape in desired_shapes(scenario)
        ),
        links=tuple(plan for link in fleet_links(scenario) for plan in _link_plan(scenario.faults, *link)),
    )


def fleet_links(scenario: Scenario) -> Iterator[tuple[str, str, str]]:
    """Source, destination and topic of every link between the controller and a robot of another computer."""
    ranges = "avoidance" in central_layers(scenario.placement.robot_from) and scenario.avoidance.enabled
    for robot in scenario.robots:
        if robot.id == scenario.controller.host:
            continue
        yield "controller", robot.id, topics.command(robot.id)
        yield robot.id, "controller", topics.odometry(robot.id)
        yield robot.id, "controller", topics.status(robot.id)
        if ranges:
            yield robot.id, "controller", topics.ranges(robot.id)


def picture(plan: Plan) -> Group:
    """The plan as text and tables."""
    onboard = ", ".join(onboard_layers(plan.robot_from)) or "only the guard"
    head = (
        f"{plan.scenario}: {len(plan.robots)} robots, {_count(len(plan.triangles), 'triangle')}, "
        f"{_count(plan.obstacles, 'obstacle')}, seed {plan.seed}\n"
        f"task: {_task_text(plan)}\n"
        f"on the robots: {onboard}\n" + "".join(f"{note}\n" for note in (*plan.laws, *plan.notes))
    )
    faults = _links_table(plan.links) if plan.links else Text("no faults on any link")
    parts: list[RenderableType] = [Text(head), _robots_table(plan.robots), Text()]
    if len(plan.legs) > 1:
        parts[1:1] = [_legs_table(plan.legs), Text()]
    return Group(*parts, _triangles_table(plan.triangles), Text(), faults)


def _leg_plans(scenario: Scenario) -> tuple[LegPlan, ...]:
    course = Course(scenario.task, scenario.controller)
    plans = []
    for index, leg in enumerate(legs_of(scenario.task)):
        way = way_of(leg)
        plans.append(
            LegPlan(
                kind=str(fields.type_of(type(leg)).tag),
                what=_leg_text(leg),
                start=start_pose(leg),
                end=end_pose(leg),
                length_m=way.length_m,
                fastest_mps=fastest_mps(leg),
                duration_s=course.duration_s(index),
                estimated=isinstance(leg, Positioning),
            )
        )
    return tuple(plans)


def _leg_text(leg: Leg) -> str:
    match leg:
        case Waypoints(points=points, facing=facing):
            return f"way through {len(points)} points{_facing(facing)}"
        case Orbit(turns=turns, radius_m=radius, facing=facing):
            side = "clockwise, " if leg.clockwise else ""
            return f"{side}{turns:g} x round a circle of radius {radius:g} m{_facing(facing)}"
        case FigureEight(laps=laps, size_m=size, facing=facing):
            return f"{laps:g} x through a figure eight of loops of {size:g} m{_facing(facing)}"
        case Samples(times_s=times):
            return f"way through {len(times)} samples"
        case Positioning(target=target):
            return f"positioning at {', '.join(f'{value:g}' for value in target)}"
        case _:
            return "line"


def _facing(facing: str) -> str:
    return ", not turning" if facing == "fixed" else ""


def _task_text(plan: Plan) -> str:
    """The task in one line."""
    about = "about " if any(leg.estimated for leg in plan.legs) else ""
    lasts = f"{about}{plan.duration_s:.4g} s"
    if len(plan.legs) > 1:
        return f"{len(plan.legs)} in sequence, {plan.length_m:.4g} m in {lasts}"
    (leg,) = plan.legs
    if leg.estimated:
        return f"{leg.what}, in {lasts}"
    faster = plan.fastest_place_mps > 1.001 * leg.fastest_mps
    places = f", places at up to {plan.fastest_place_mps:.3g} m/s" if faster else ""
    return f"{leg.what}, {leg.length_m:.4g} m in {lasts}, at up to {leg.fastest_mps:.3g} m/s{places}"


def _notes(scenario: Scenario) -> Iterator[str]:
    planning, waiting = scenario.planning, scenario.waiting
    for index, (before, after) in enumerate(pairwise(legs_of(scenario.task))):
        gap = math.dist(end_pose(before)[:2], start_pose(after)[:2])
        if gap > GAP_M and not isinstance(after, Positioning):
            yield f"task {index + 1} starts {gap:.3g} m from where task {index} ends"
    if planning.method != "given":
        yield f"who takes which place: {planning.method}"
    if planning.relabel:
        yield "places are numbered anew"
    if planning.build != "off":
        how = (
            f"straight, at up to {planning.speed_mps:g} m/s" if planning.build == "straight" else "by the law"
        )
        yield f"the formation is built first: {how}"
    if waiting.enabled:
        yield f"the reference slows from {waiting.free_m:g} m of error on, and stands at {waiting.stop_m:g} m"
    if scenario.controller.host is not None:
        yield f"the controller runs on {scenario.controller.host}, in its odometry frame"
    if edges.is_wired(scenario):
        yield from (note for robot in scenario.robots for note in _hardware(robot))
    if edges.preflight_asked(scenario):
        estop = ", with a test of the emergency stop" if scenario.preflight.estop else ""
        yield f"nothing moves before every robot has passed the pre-flight check{estop}"
    for crash in scenario.crashes:
        back = "" if crash.restart_after_s is None else f", and is back {crash.restart_after_s:g} s later"
        yield f"{crash.node} dies at {crash.at_s:g} s{back}"
    for freeze in scenario.freezes:
        yield f"{freeze.node} is frozen from {freeze.at_s:g} s for {freeze.for_s:g} s"
    for partition in scenario.partitions:
        lasts = "to the end" if partition.for_s is None else f"for {partition.for_s:g} s"
        yield f"from {partition.at_s:g} s {lasts} apart: {fault_text.groups(partition)}"
    for clock in scenario.clocks:
        yield f"the clock of {clock.node} is {clock.offset_s:+g} s off and {clock.skew_ppm:+g} ppm fast"


def _hardware(robot: Robot) -> Iterator[str]:
    """What drives a robot, and brings its scans, where that is not the simulator."""
    mavlink, ros2 = robot.mavlink, robot.ros2
    frame = "its own frame" if mavlink.origin is None else "the world frame"
    router = ros2.router or "the router of the hardware network"
    where = {
        "mavlink": f"{mavlink.connection}, system {mavlink.system_id}, in {frame}, "
        + ("armed by the driver" if mavlink.arm else "armed by a pilot"),
        "ros2": f"{ros2.layout} on {router}, domain {ros2.domain_id}, namespace {ros2.namespace or robot.id}",
    }
    if edges.has_driver(robot):
        shown = "; the simulator presents it" if edges.has_vehicle(robot) else ""
        at = f" ({where[robot.driver]})" if robot.driver in where else ""
        yield f"{robot.id} is driven by {robot.driver}{at}{shown}"
    if robot.scans:
        at = f" ({where[robot.scans]})" if robot.scans == "ros2" != robot.driver else ""
        yield f"the scans of {robot.id} come from {robot.scans}{at}"


def _laws(scenario: Scenario) -> Iterator[str]:
    """The layers that have gains, with these."""
    law, shell, drives = scenario.controller, scenario.avoidance, scenario.compensation
    kappa, limit = (_gains(gain) for gain in (law.kappa, law.saturation))
    yield f"formation law {law.law}: kappa {kappa}, L {limit}, {law.angle} angle"
    if shell.enabled:
        impedances = ", ".join(
            f"{name} {z.inertia:g} {z.damping:g} {z.stiffness:g}"
            for name, z in (("u", shell.linear), ("w", shell.angular))
        )
        yield (
            f"avoidance {shell.law}: b {shell.b:g}, d_min {shell.d_min_m:g} m, d_max {shell.d_max_m:g} m, "
            f"I B K of {impedances}"
        )
    else:
        yield "no avoidance"
    yield f"compensation {drives.law}" if drives.enabled else "no compensation"
    yield "the guard keeps clear of what it sees" if scenario.guard.clearance else "no clearance in the guard"
    if scenario.guard.fence:
        yield f"the guard keeps inside a fence of {len(scenario.guard.fence)} corners"


def _gains(gain: float | tuple[float, ...]) -> str:
    return " ".join(f"{one:g}" for one in (gain if isinstance(gain, tuple) else (gain,)))


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
    always = [rule for rule in rules if not rule.windows]
    if rules:
        yield LinkPlan(
            source=source,
            destination=destination,
            topic=topic,
            latency_s=math.fsum(rule.latency_s for rule in always),
            jitter_s=math.fsum(rule.jitter_s for rule in always),
            loss=1.0 - math.prod(1.0 - rule.loss for rule in always),
            also=tuple(text for rule in rules for text in _also(rule)),
        )


def _also(rule: Fault) -> Iterator[str]:
    """What a rule does besides being late and losing some, or does at times."""
    if rule.windows:
        when = ", ".join(f"{begin:g} to {end:g} s" for begin, end in rule.windows)
        yield f"from {when}: {fault_text.summary(rule)}"
        return
    rest = msgspec.structs.replace(rule, preset="", latency_s=0.0, jitter_s=0.0, loss=0.0)
    if rest.burst or rest.duplicate or rest.reorder or rest.corrupt or rest.rate_kbps:
        yield fault_text.summary(rest)


def _table(left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in left:
        table.add_column(name, no_wrap=True)
    for name in right:
        table.add_column(name, no_wrap=True, justify="right")
    return table


def _numbers(values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)  # no -0.00


def _legs_table(legs: Sequence[LegPlan]) -> Table:
    numbers = ("from (m, m, rad)", "to (m, m, rad)", "length (m)", "fastest (m/s)", "time (s)")
    table = _table(("", "task"), numbers)
    for index, leg in enumerate(legs):
        ends = (_numbers(pose, 2) for pose in (leg.start, leg.end))
        if leg.estimated:
            table.add_row(str(index), leg.what, *ends, "", "", f"about {leg.duration_s:.1f}")
        else:
            figures = (f"{leg.length_m:.2f}", f"{leg.fastest_mps:.3f}", f"{leg.duration_s:.1f}")
            table.add_row(str(index), leg.what, *ends, *figures)
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
            _numbers(robot.place, 2),
            _numbers(robot.pose, 3),
            f"{robot.hold_after_s:.2f}, {robot.stop_after_s:.2f}",
        )
    return table


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _triangles_table(triangles: Sequence[TrianglePlan]) -> Table:
    table = _table(("triangle",), ("p (m)", "q (m)", "beta (rad)"))
    for one in triangles:
        table.add_row(" ".join(one.robots), f"{one.p_m:.3f}", f"{one.q_m:.3f}", f"{one.beta_rad:.3f}")
    return table


def _links_table(links: Sequence[LinkPlan]) -> Table:
    """Links that suffer the same in one row."""
    alike: dict[tuple[bool, str, float, float, float, tuple[str, ...]], list[str]] = {}
    for link in links:
        down = link.source == "controller"
        what = link.topic.rpartition("/")[2]
        robot = link.destination if down else link.source
        suffers = (down, what, link.latency_s, link.jitter_s, link.loss, link.also)
        alike.setdefault(suffers, []).append(robot)
    table = _table(("faults on", "robots"), ("latency (ms)", "jitter (ms)", "loss (%)"))
    table.add_column("" if not any(link.also for link in links) else "also", overflow="fold")
    for (down, what, latency_s, jitter_s, loss, also), robots in alike.items():
        way = f"{what} to" if down else f"{what} from"
        numbers = (f"{1000 * latency_s:.0f}", f"{1000 * jitter_s:.0f}", f"{100 * loss:.1f}")
        table.add_row(way, " ".join(robots), *numbers, "; ".join(also))
    return table
