"""The controller is killed at any moment and started again: it goes on where it was, and nothing jumps."""

import random
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace

from maniple.cli.loading import completed
from maniple.cli.nodes import factories, time_limit_s
from maniple.control.limits import limits_of
from maniple.core import codec, topics
from maniple.core.envelope import Envelope
from maniple.core.messages import (
    Command,
    Drive,
    FormationState,
    Goal,
    Mission,
    Truth,
    unpack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.places import fastest_place_mps
from maniple.core.scenario.types import Crash, Formation, Line, Scenario, Shape
from maniple.core.time import SECOND, VIRTUAL_EPOCH, Duration, Time, from_seconds, to_seconds
from maniple.host.virtual import VirtualHost
from tests.cli.scenes import platoon


class Operator:
    """Wants something once."""

    name = "operator"
    subscriptions: frozenset[str] = frozenset()

    def __init__(self, goal: Goal, at_s: float) -> None:
        self._goal: Goal | None = goal
        self._at = VIRTUAL_EPOCH + from_seconds(at_s)
        self.timers: Mapping[str, Duration] = {"look": SECOND // 10}

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        if self._goal is None or now < self._at:
            return ()
        goal, self._goal = self._goal, None
        return (Outgoing(topics.FORMATION_GOAL, goal),)

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        return ()


class Said(NamedTuple):
    """What was said in a run, by type, in order."""

    states: list[FormationState]
    missions: list[Mission]
    commands: dict[str, list[Command]]
    drives: dict[str, list[Drive]]
    truths: list[Truth]


def run(scenario: Scenario, goal: tuple[Goal, float] | None = None) -> Said:
    """In virtual time, to the end of the task and 2 s beyond."""
    said = Said([], [], {}, {}, [])
    into: dict[type, Callable[[Any], None]] = {
        FormationState: said.states.append,
        Mission: said.missions.append,
        Truth: said.truths.append,
    }

    def tap(envelope: Envelope, arrival: Time) -> None:
        kind = topics.topic(envelope.topic).type
        if kind in (*into, Command, Drive):
            message: Any = codec.decode(envelope.topic, envelope.data)
            robot = envelope.topic.split("/")[1]
            if isinstance(message, Command):
                said.commands.setdefault(robot, []).append(message)
            elif isinstance(message, Drive):
                said.drives.setdefault(robot, []).append(message)
            else:
                into[kind](message)
                if isinstance(message, FormationState) and message.phase == "done":
                    host.halt()

    makers = factories(scenario)
    nodes: list[Any] = [make(1) for make in makers.values()]
    host = VirtualHost([*nodes, Operator(*goal)] if goal else nodes, scenario, tap, makers)
    host.start()
    host.run(host.now + from_seconds(time_limit_s(scenario, None)))
    host.run(host.now + 2 * SECOND)
    return said


AVOIDING = platoon(
    4,
    world={"obstacles": [{"kind": "circle", "centre": [2.0, 1.35], "radius_m": 0.15}]},
    compensation={"enabled": True},
    placement={"robot_from": "drive"},
    task={"kind": "line", "start": [0, 0], "end": [2, 0], "speed_mps": 0.1, "settle_s": 10.0},
)
EIGHT = platoon(
    3,
    task={"kind": "figure-eight", "centre": [0, 0], "size_m": 1.0, "speed_mps": 0.1, "settle_s": 5.0},
    formation={"points": [[0.5, 0], [-0.3, 0.6], [-0.3, -0.6]]},
    placement={"robot_from": "kinematics"},
)
TOUR = platoon(
    5,
    start={"scatter_m": 0.3, "scatter_rad": 1.0},
    planning={"method": "optimal", "build": "straight", "speed_mps": 0.15},
    task={
        "kind": "sequence",
        "tasks": [
            {"kind": "positioning", "target": [0.5, 0, 0], "tolerance_m": 0.05, "settle_s": 2.0},
            {"kind": "line", "start": [0.5, 0], "end": [1.5, 0], "speed_mps": 0.1, "settle_s": 8.0},
        ],
    },
    controller={"kappa": 0.5, "saturation": 0.2},
    placement={"robot_from": "kinematics"},
)
LOSING = platoon(
    5,
    controller={"lost_after_s": 2.0},
    crashes=[{"node": "r4", "at_s": 3.0, "restart_after_s": 12.0}],
    task={"kind": "line", "start": [0, 0], "end": [1.5, 0], "speed_mps": 0.1, "settle_s": 20.0},
)
GOAL = Goal(
    id="elsewhere",
    task=Line(start=(0.5, 0.5), end=(1.5, 0.5), speed_mps=0.1, settle_s=20.0),
    formation=Formation(shape=Shape(kind="vee", spacing_m=1.2)),
)
SCENES: dict[str, tuple[Scenario, tuple[Goal, float] | None]] = {
    "avoiding": (completed(AVOIDING), None),
    "eight": (completed(EIGHT), None),
    "tour": (completed(TOUR), None),
    "losing": (completed(LOSING), None),
    "goal": (completed(platoon(4, placement={"robot_from": "kinematics"})), (GOAL, 4.0)),
}
KILLS = [(scene, seed) for scene in SCENES for seed in range(8)]


def moments(scene: str, seed: int) -> tuple[float, float]:
    """When the controller is killed, and for how long."""
    source = random.Random(f"{scene} {seed}")
    return round(source.uniform(0.3, 32.0), 3), round(source.uniform(0.2, 5.0), 3)


def assert_it_goes_on(scenario: Scenario, said: Said) -> None:
    """Done; the reference never jumped; the first words of a life are the last ones of the life before; the
    drives never did what they can't."""
    assert said.states[-1].phase == "done"
    assert said.truths[-1].collisions == 0
    fastest = max(fastest_place_mps(scenario), scenario.planning.speed_mps, 0.1)
    for before, after in pairwise(said.states):
        way = np.hypot(*np.subtract(after.reference, before.reference)[:2])
        lasted_s = to_seconds(after.stamp_ns - before.stamp_ns)
        assert way <= 1.001 * fastest * min(lasted_s, 0.5) + 1e-9
        if after.incarnation > before.incarnation:
            assert_the_same(before, after)
    assert_within_limits(scenario, said)


def assert_the_same(before: FormationState, after: FormationState) -> None:
    assert after.reference == before.reference
    assert (after.leg, after.goal, after.goal_refused) == (before.leg, before.goal, before.goal_refused)
    assert (after.chain, after.points) == (before.chain, before.points)
    assert replace(after.progress, settled_ns=0) == replace(before.progress, settled_ns=0)
    for one, other in zip(after.roster, before.roster, strict=True):
        assert one.compensation == pytest.approx(other.compensation)
        assert (one.state == "lost") == (other.state == "lost")
        for layer, known in zip(one.memory, other.memory, strict=False):
            assert layer == pytest.approx(known)


def assert_within_limits(scenario: Scenario, said: Said) -> None:
    """What the drives were told changed no faster than the robots can."""
    for robot in scenario.robots:
        limits = limits_of(scenario, robot)
        most = max(limits.u_accel, limits.brake)
        for before, after in pairwise(said.drives[robot.id]):
            lasted_s = to_seconds(after.stamp_ns - before.stamp_ns)
            if after.incarnation == before.incarnation:
                assert abs(after.u_mps - before.u_mps) <= most * lasted_s + 1e-9
                assert abs(after.w_radps - before.w_radps) <= limits.w_accel * lasted_s + 1e-9


def check(scene: str, seed: int) -> None:
    scenario, goal = SCENES[scene]
    at_s, lasts_s = moments(scene, seed)
    crash = Crash(node="controller", at_s=at_s, restart_after_s=lasts_s)
    said = run(replace(scenario, crashes=(*scenario.crashes, crash)), goal)
    assert {state.incarnation for state in said.states} == {1, 2}, (at_s, lasts_s)
    assert_it_goes_on(scenario, said)


@pytest.mark.parametrize("scene", SCENES)
def test_a_controller_that_is_killed_goes_on(scene: str) -> None:
    check(scene, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "seed"), [kill for kill in KILLS if kill[1]])
def test_whenever_it_is_killed(scene: str, seed: int) -> None:
    check(scene, seed)


def test_a_new_life_commands_what_the_old_one_would_have() -> None:
    """With everything at rest in between: the robots are in their places before and after."""
    made = completed(platoon(3, task={"kind": "line", "start": [0, 0], "end": [3, 0], "speed_mps": 0.1}))
    whole = run(made)
    broken = run(replace(made, crashes=(Crash(node="controller", at_s=10.0, restart_after_s=0.2),)))
    for name, commands in broken.commands.items():
        values = np.array([command.values for command in commands])
        steps = np.abs(np.diff(values, axis=0)).max(axis=0)
        usual = np.abs(np.diff([command.values for command in whole.commands[name]], axis=0)).max(axis=0)
        lives = np.array([command.incarnation for command in commands])
        assert (steps <= 1.5 * usual + 0.02).all()
        assert set(lives) == {1, 2}


def test_killed_again_before_it_has_gathered_its_robots_it_still_knows() -> None:
    made = completed(platoon(3, placement={"robot_from": "kinematics"}))
    crashes = (
        Crash(node="controller", at_s=8.0, restart_after_s=1.0),
        Crash(node="controller", at_s=9.05, restart_after_s=0.5),
        Crash(node="controller", at_s=9.8, restart_after_s=0.5),
    )
    said = run(replace(made, crashes=crashes))
    assert max(state.incarnation for state in said.states) == 4
    assert_it_goes_on(made, said)


def test_the_mission_is_said_only_where_it_changes() -> None:
    said = run(SCENES["tour"][0])
    stages = ["waiting", "forming", "running", "done"]
    assert [(mission.stage, mission.number) for mission in said.missions] == list(
        zip(stages, range(1, 5), strict=True)
    )
    assert [bool(mission.built_from) for mission in said.missions] == [False, True, False, False]
    assert unpack_floats(said.states[-1].points, 2).shape == (5, 2)
