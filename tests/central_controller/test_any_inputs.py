"""Whatever the platoon hears, and in whatever order: the controller goes on, and says nothing absurd."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from central_controller.node import CONTROL, LEAST, CentralController
from maniple.core import codec, topics
from maniple.core.layers import Layer
from maniple.core.messages import (
    Alive,
    Command,
    FormationState,
    Goal,
    Mode,
    Odometry,
    Scan,
    Status,
    pack_floats,
    unpack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.check import problems
from maniple.core.scenario.types import (
    Controller,
    Formation,
    Line,
    Placement,
    Planning,
    Positioning,
    Robot,
    Samples,
    Scenario,
    Sequence,
    Shape,
    Supervisor,
    Waiting,
)
from maniple.core.time import MILLISECOND, SECOND
from tests.pioneer import PIONEER, SICK

IDS = ("r1", "r2", "r3", "r4", "r5")
BEARINGS = np.linspace(-math.pi / 2, math.pi / 2, 181)

TASKS = (
    None,
    Line(start=(0.0, 0.0), end=(0.5, 0.0), speed_mps=0.1),
    Line(start=(2.0, 1.0), end=(2.0, 1.0), speed_mps=0.1),
    Positioning(target=(1.0, -1.0, 2.0), tolerance_m=0.5, tolerance_rad=0.5),
    Sequence(
        tasks=(
            Positioning(target=(0.0, 0.0, 0.0), tolerance_m=5.0, tolerance_rad=4.0),
            Samples(times_s=(0.0, 2.0), poses=((1.0, 0.0, 3.0), (1.1, 0.0, -3.0))),
        )
    ),
)
FORMATIONS = (
    None,
    Formation(shape=Shape(kind="vee", spacing_m=0.8)),
    Formation(shape=Shape(kind="polygon", spacing_m=1.2)),
    Formation(points=((0.0, 0.0), (1.0, 0.0), (0.5, 1.0))),
    Formation(points=((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0), (2.0, 0.0))),
)

robots = st.sampled_from(IDS)
metres = st.floats(-3.0, 3.0, width=32) | st.sampled_from((0.0, 1e6, -1e6))
speeds = st.floats(-1.0, 1.0, width=32)

odometries = st.tuples(
    st.just("odometry"), robots, st.integers(1, 3), metres, metres, st.floats(-4.0, 4.0), speeds, speeds
)
scans = st.tuples(st.just("scan"), robots, st.floats(0.0, 8.0), st.floats(-1.5, 1.5))
statuses = st.tuples(
    st.just("status"),
    robots,
    st.integers(1, 3),
    st.sampled_from(("waiting", "tracking", "holding", "stopped", "fault")),
    st.booleans(),
)
lives = st.tuples(st.just("life"), robots, st.integers(1, 3), st.booleans())
goals = st.tuples(
    st.just("goal"),
    st.integers(0, 9),
    st.sampled_from(TASKS),
    st.sampled_from(FORMATIONS),
    st.sampled_from((None, True, False)),
)
everybody = st.tuples(st.just("everybody"), metres, st.floats(-4.0, 4.0))
some = st.tuples(st.just("some"), st.sets(robots, min_size=1) | st.just(set(IDS)), st.integers(1, 40))
ticks = st.tuples(st.just("tick"), st.sampled_from((0, 1, 100, 100, 100, 700, 4000)))
restarts = st.tuples(
    st.just("restart"), st.sets(st.sampled_from((topics.FORMATION_STATE, topics.FORMATION_MISSION)))
)
events = st.one_of(odometries, scans, statuses, lives, goals, everybody, some, some, some, ticks, restarts)


def scenario(draw: st.DrawFn) -> Scenario:
    """Five robots, scattered, under any of the ways to guide them."""
    points = ((1.0, 0.0), (0.0, 0.8), (0.0, -0.8), (-1.4, 0.8), (-1.4, -0.8))
    scatter = draw(st.permutations(range(5)))
    made = Scenario(
        name="any",
        robots=tuple(
            Robot(id=name, pose=(points[k][0] + 0.1, points[k][1] - 0.2, 0.5 * k))
            for name, k in zip(IDS, scatter, strict=True)
        ),
        formation=Formation(points=points),
        task=draw(st.sampled_from([task for task in TASKS if task is not None and task is not TASKS[2]])),
        controller=Controller(
            angle=draw(st.sampled_from(("signed", "unsigned"))),
            reference=draw(st.sampled_from(("formation", "neighbours"))),
            host=draw(st.sampled_from((None, "r2"))),
            lost_after_s=draw(st.sampled_from((0.05, 1.0))),
        ),
        planning=Planning(
            method=draw(st.sampled_from(("given", "final-reorganization", "proximity", "optimal"))),
            relabel=draw(st.booleans()),
            build=draw(st.sampled_from(("straight", "law", "off"))),
            tolerance_m=5.0,
            tolerance_rad=4.0,
            patience_s=2.0,
        ),
        supervisor=Supervisor(exchange=draw(st.booleans())),
        waiting=Waiting(enabled=draw(st.booleans())),
        placement=Placement(robot_from=draw(st.sampled_from(("drive", "kinematics")))),
        models={"pioneer-3dx": PIONEER},
        sensors={"sick-lms200": SICK},
    )
    assert problems(made) == []
    return made


def odometry(incarnation: int, x: float, y: float, psi: float, u: float, w: float) -> Odometry:
    return Odometry(incarnation=incarnation, frame_id="own", x_m=x, y_m=y, psi_rad=psi, u_mps=u, w_radps=w)


def scan(nearest_m: float = 8.0, bearing_rad: float = 0.0) -> Scan:
    return Scan(
        first_angle_rad=-math.pi / 2,
        increment_rad=math.radians(1.0),
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.0, 0.0, 0.0),
        ranges=pack_floats(np.where(np.abs(BEARINGS - bearing_rad) < 0.2, nearest_m, 8.0)),
    )


def status(incarnation: int, mode: Mode, localised: bool) -> Status:
    return Status(
        incarnation=incarnation,
        mode=mode,
        guard="none",
        command_age_s=0.0,
        command_age_max_s=0.0,
        driver="active",
        reason="",
        counters={},
        localised=localised,
    )


class Platoon:
    """Feeds a controller, and looks at everything it says."""

    def __init__(self, made: Scenario) -> None:
        self.made = made
        self.life = 1
        self.last: dict[str, Any] = {}
        self.node = CentralController(made)
        self.layer: Layer = made.placement.robot_from
        self.now = 1000 * SECOND
        self.state = self.check(self.node.on_start(self.now))

    def say(self, topic: str, message: Any) -> None:
        if topic in self.node.subscriptions:
            if isinstance(message, Odometry | Scan):
                message = replace(message, stamp_ns=self.now)
            heard = codec.decode(topic, codec.encode(message))
            assert self.node.on_message(Received(topic, heard), self.now) == []

    def tick(self, after_ms: int) -> None:
        self.now += after_ms * MILLISECOND
        before = self.state
        self.state = self.check(self.node.on_timer(CONTROL, self.now))
        if self.state.goal == before.goal:
            assert self.state.task_time_s >= before.task_time_s - 1e-9
        if (self.state.phase, self.state.goal) == ("holding", before.goal):
            assert self.state.rate == 0.0
            assert self.state.reference_velocity == (0.0, 0.0, 0.0)

    def check(self, sent: list[Outgoing]) -> FormationState:
        *rest, (topic, state) = sent
        commands = [said for said in rest if said.topic != topics.FORMATION_MISSION]
        for _, mission in rest[len(commands) :]:
            assert codec.decode(topics.FORMATION_MISSION, codec.encode(mission)) == mission
            self.last[topics.FORMATION_MISSION] = replace(mission, incarnation=self.life)
        self.last[topics.FORMATION_STATE] = replace(state, incarnation=self.life)
        assert topic == topics.FORMATION_STATE
        assert isinstance(state, FormationState)
        assert codec.decode(topic, codec.encode(state)) == state
        lost = {report.id for report in state.roster if report.state == "lost"}
        assert set(state.chain) == set(IDS) - lost
        assert len(unpack_floats(state.points, 2)) == len(state.chain)
        assert len(unpack_floats(state.errors, 6)) in (0, len(state.chain) - 2)
        assert (len(state.chain) < LEAST) <= (state.phase in ("holding", "done"))
        assert state.reason or state.phase != "holding"
        assert (
            bool(state.reason) == bool(state.waits_for or state.phase == "holding")
            or len(state.chain) < LEAST
        )
        told = [topic.split("/")[1] for topic, _ in commands]
        assert len(set(told)) == len(told)
        nobody = state.phase == "waiting" or state.reason.startswith("the controller was started again")
        assert set(told) == (set() if nobody else set(state.chain))
        for topic, command in commands:
            assert isinstance(command, Command)
            assert codec.decode(topic, codec.encode(command)) == command
            assert np.isfinite([*command.values, command.third]).all()
            assert command.inputs_age_ns >= 0
            assert command.layer == self.layer
        return state

    def happens(self, event: tuple[Any, ...]) -> None:
        match event:
            case "odometry", robot, *values:
                self.say(topics.odometry(robot), odometry(*values))
            case "scan", robot, *values:
                self.say(topics.ranges(robot), scan(*values))
            case "status", robot, *values:
                self.say(topics.status(robot), status(*values))
            case "life", robot, incarnation, lives:
                message = Alive(node=robot, node_incarnation=incarnation, alive=lives)
                self.say(topics.HOST_ALIVE, message)
            case "goal", mark, task, shape, hold:
                self.say(topics.FORMATION_GOAL, Goal(id=f"g{mark}", task=task, formation=shape, hold=hold))
                self.tick(0)
            case "restart", kept:
                self.restart(kept)
            case "everybody", x, psi:
                self.everybody(IDS, x, psi)
            case "some", names, count:
                for _ in range(count):
                    self.everybody(tuple(sorted(names)))
                    self.tick(200)
            case "tick", after_ms:
                self.tick(after_ms)

    def restart(self, kept: set[str]) -> None:
        """The next life is told what is `kept` of the last words."""
        self.life += 1
        self.node = CentralController(self.made, incarnation=self.life)
        assert self.node.on_start(self.now) == []
        for name in kept & self.last.keys():
            self.say(name, self.last[name])
        self.now += SECOND
        sent = self.node.on_timer(CONTROL, self.now)
        self.state = self.check(sent)

    def everybody(self, names: tuple[str, ...], x: float = 0.0, psi: float = 0.0) -> None:
        for name in names:
            self.say(topics.HOST_ALIVE, Alive(node=name, node_incarnation=3, alive=True))
            self.say(topics.status(name), status(3, "tracking", True))
            self.say(topics.odometry(name), odometry(3, x, 0.0, psi, 0.1, 0.0))
            self.say(topics.ranges(name), scan())


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.data())
def test_whatever_is_heard_it_goes_on(data: st.DataObject) -> None:
    """And once all robots are there and told to go on, nothing holds the platoon any more."""
    platoon = Platoon(data.draw(st.composite(scenario)()))
    for event in data.draw(st.lists(events, max_size=60)):
        platoon.happens(event)
    platoon.say(topics.FORMATION_GOAL, Goal(id="last", hold=False))
    for _ in range(170):
        platoon.everybody(IDS)
        platoon.tick(100)
    state = platoon.state
    assert {report.state for report in state.roster} == {"present"}
    assert state.phase in ("forming", "running", "done")
    assert (state.waits_for, state.reason) == ((), "")
