"""The central controller: n odometries (and scans) in, n commands and the state of the formation out."""

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np
from msgspec.structs import replace

from central_controller import formation
from central_controller.formation import Gains
from central_controller.former import FormerLife, Record
from central_controller.lineup import Lineup, fitted
from central_controller.mission import Mission, from_here
from central_controller.planning import follow
from central_controller.preflight import Preflight
from central_controller.reference import Reference, within
from central_controller.roster import Roster, View, bearable, waiting_for
from central_controller.supervisor import Supervisor
from central_controller.waiting import rate
from central_controller.watched import WatchedLaw, WatchedPlanner
from maniple.control.builtin import BUILTIN
from maniple.control.limits import Velocity
from maniple.control.parts import Parts
from maniple.control.pipeline import Pipeline, central_layers
from maniple.core import messages, topics
from maniple.core.geometry import Floats, Pose
from maniple.core.messages import (
    Alive,
    Command,
    FormationState,
    Goal,
    Phase,
    Progress,
    Refused,
    Stage,
    pack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.check import problems
from maniple.core.scenario.shapes import pointed
from maniple.core.scenario.types import Formation, Point, Scenario
from maniple.core.time import SECOND, Duration, Time, from_seconds, period, to_seconds

Event: TypeAlias = Literal["ready", "built", "ended", "new task"]
"""Every robot has been heard; the formation is built; the task has come to its end; it gets another."""

STAGES: Mapping[tuple[Stage, Event], Stage] = {
    ("waiting", "ready"): "forming",
    ("forming", "built"): "running",
    ("running", "ended"): "done",
    ("done", "new task"): "running",
}
"""The stage after an event; an event that is not listed for a stage changes nothing."""

CONTROL = "control"

STANDING = Velocity()

LEAST = 3
"""Robots that make a triangle."""

PATIENCE: Duration = SECOND
"""How long a controller that is started again waits for what the one before it left."""

_LONGEST_STEP: Duration = SECOND // 2
"""After a freeze the reference and the layers of the robots are advanced by no more than this."""


class CentralController:
    """Guides the platoon of a resolved scenario.

    It waits until it has heard every robot, lets them build the formation, runs the task, and from its end on
    holds the formation where the reference ends. While a robot does not follow, the reference stands and the
    others hold their places around it; one that stays away is lost, and the others go on in a new chain of
    triangles until it is back. Robots that have gone silent are still commanded until they are lost: each
    command says how old what it was computed from is, and the robot's own guard acts on that.

    `incarnation` is the life of this controller. A later one than the first goes on where the one before it
    ended, by the `Mission` and the `FormationState` that the network still has of it, once it has heard the
    robots that were not lost. Where these are missing it holds until a goal sets the platoon going, from
    where it is.

    Where the scenario asks for a pre-flight check, nothing begins before every robot has passed it, and a
    robot that has yet to pass it is not commanded. The robots have to run the scenario with this `digest`, by
    default that of `scenario`.
    """

    def __init__(
        self, scenario: Scenario, parts: Parts = BUILTIN, incarnation: int = 1, digest: str = ""
    ) -> None:
        layers = central_layers(scenario.placement.robot_from)
        self._given = self._scenario = scenario
        self._incarnation = incarnation
        self._robots = {robot.id: robot for robot in scenario.robots}
        self._parts = parts
        self._layers = layers
        self._layer = scenario.placement.robot_from
        self._with_ranges = "avoidance" in layers and scenario.avoidance.enabled
        self._law = WatchedLaw(scenario.controller, parts)
        self._gains = Gains.of(scenario.controller)
        self._planner = WatchedPlanner(scenario.planning, parts)
        own = bearable(scenario)
        self._limits = own
        self._roster = Roster(scenario.robots, scenario.controller.host, own, incarnation)
        self._preflight = Preflight(scenario, self._roster.members, self._with_ranges, digest)
        self._lineup = Lineup(scenario, self._planner)
        self._supervisor = self._supervise()
        self._mission = Mission(scenario.task, scenario.controller)
        self._lost_after = from_seconds(scenario.controller.lost_after_s)
        self._pipelines = {robot.id: self._pipeline(robot.id) for robot in scenario.robots}
        self._timers = {CONTROL: period(scenario.rates.control_hz)}
        self._topics = self._roster.by_topic(self._with_ranges)
        former = {topics.FORMATION_STATE, topics.FORMATION_MISSION} if incarnation > 1 else set()
        self._asked = frozenset(former)
        self._members = {member.id: member for member in self._roster.members}
        self._stage: Stage = "waiting"
        self._told_to_hold = False
        self._rate = 0.0
        self._settling: Duration = 0
        self._errors: Floats | None = None
        self._notes: tuple[str, ...] = ()
        self._waits_for: Mapping[str, str] = {}
        self._stops: Mapping[str, float] = {}
        self._former = FormerLife(incarnation, tuple(self._robots)) if incarnation > 1 else None
        self._started: Time = 0
        self._unknown = ""
        self._anew = False
        self._gathering = False
        self._meanwhile: Goal | None = None
        self._number = 0
        self._told: messages.Mission | None = None
        self._goal = self._goal_refused = ""
        self._refused = 0
        self._ticked: Time | None = None

    @property
    def name(self) -> str:
        """Of the node."""
        return "controller"

    @property
    def subscriptions(self) -> frozenset[str]:
        """Topics the node receives."""
        always = {topics.FORMATION_GOAL, topics.HOST_ALIVE, topics.HOST_REFUSED}
        return frozenset(self._topics) | always | self._asked

    @property
    def timers(self) -> Mapping[str, Duration]:
        """Formation control."""
        return self._timers

    def on_start(self, now: Time) -> list[Outgoing]:
        """Say that the platoon is waited for; a later life first hears what there is to say."""
        self._started = now
        if self._former is not None:
            return []
        self._preflight.review(self._scenario, now, begun=False)
        return self._said(now)

    def on_message(self, message: Received, now: Time) -> list[Outgoing]:
        """Take in what a robot said, what an operator wants, or who is alive."""
        body = message.message
        if isinstance(body, Refused):
            self._refused += body.count
        elif isinstance(body, messages.Mission | FormationState):
            if self._former is not None:
                self._former.heard(body)
        elif isinstance(body, Goal):
            self._take(body, now)
        else:
            member = self._members.get(body.node) if isinstance(body, Alive) else self._topics[message.topic]
            if member is not None:
                member.heard(body, now)
        return []

    def on_timer(self, timer: str, now: Time) -> list[Outgoing]:
        """One tick: a command to every robot of the chain once the task has begun, and the state."""
        if timer != CONTROL or not self._informed(now):
            return []
        elapsed = 0 if self._ticked is None else min(now - self._ticked, _LONGEST_STEP)
        self._ticked = now
        begun = self._stage != "waiting"
        passed = self._preflight.review(self._scenario, now, begun=begun, anywhere=self._anew)
        if not begun:
            if not self._unknown and self._roster.ready(now, self._with_ranges) and passed:
                self._begin(now)
        elif self._roster.review(self._lost_after, now) and not self._gathering:
            self._reorganise(now)
        if self._gathering:
            self._gather(now)
        self._waits_for = self._roster.waited_for(now, lacking=not (begun or passed))
        views = self._views(now)
        if self._stage == "waiting" or self._gathering or not self._enough or self._faults:
            self._errors, self._notes, self._rate = None, (), 0.0
            self._ticked = None
            return [*self._stand(views), *self._said(now)]
        return self._guide(views, elapsed, now)

    def on_stop(self, now: Time) -> list[Outgoing]:
        """Tell every robot that was commanded to stand still."""
        return [] if self._stage == "waiting" else self._stand(self._views(now))

    @property
    def _enough(self) -> bool:
        return len(self._roster.active) >= LEAST

    @property
    def _phase(self) -> Phase:
        held = self._unknown or (self._stage in ("forming", "running") and self._reason)
        return "holding" if held else self._stage

    @property
    def _reason(self) -> str:
        """Why the platoon holds; empty while it does not."""
        if self._unknown:
            return self._unknown
        if self._gathering:
            return "the controller was started again"
        if (left := len(self._roster.active)) < LEAST:
            return "; ".join((f"{left} robots are left; a formation needs {LEAST}", *self._roster.kept_out()))
        if faults := self._faults:
            return "; ".join(faults)
        return "told to hold" if self._told_to_hold else ""

    @property
    def _faults(self) -> list[str]:
        """What has failed of the formation law, the planner, and the layers of each robot."""
        own = [part.fault for part in (self._law, self._planner) if part.fault]
        return own + [f"{name}: {line.fault}" for name, line in self._pipelines.items() if line.fault]

    def _begin(self, now: Time) -> None:
        """Everybody is there: say who goes where."""
        self._preflight.accept()
        self._roster.locate()
        planning = self._scenario.planning
        if self._anew:
            self._from_here(now)
        points = self._own_points(now)
        self._plan(points)
        self._happened("ready")
        if planning.build == "straight" or self._anew:
            self._lineup.build(points, planning.speed_mps)
        elif planning.build == "off":
            self._happened("built")

    def _from_here(self, now: Time) -> None:
        """Let the task begin where the robots are, as nobody knows where the reference was."""
        members = self._roster.active
        views = [view for member in members if (view := member.view(now)) is not None]
        places = self._lineup.places[[self._lineup.robots.index(member.id) for member in members]]
        here = self._roster.frame.compose(fitted(np.array([view.point for view in views]), places))
        self._undertake(here)

    def _plan(self, points: Mapping[str, Point]) -> None:
        """Decide who of the robots at `points`, in the formation's own frame, goes where."""
        self._lineup.plan(points)
        if self._lineup.exchanges:
            self._lineup.sort_out(points)
        self._supervisor = self._supervise()

    def _reorganise(self, now: Time) -> None:
        """Robots were lost or came back: a new chain over those that are there. What was being built is built
        on by straight ways from where they are."""
        there = [member.id for member in self._roster.active]
        for name in there:
            if name not in self._lineup.robots:
                self._pipelines[name] = self._pipeline(name)
        building = self._lineup.building
        self._lineup.chain_up(there)
        if building and self._enough:
            self._lineup.build(self._own_points(now), self._scenario.planning.speed_mps)
        self._supervisor = self._supervise()

    def _guide(self, views: Mapping[str, View], elapsed: Duration, now: Time) -> list[Outgoing]:
        """The formation law, and what the central layers make of it."""
        lineup = self._lineup
        if lineup.exchanges and not lineup.building and lineup.sort_out(self._own_points(now)):
            self._supervisor = self._supervise()
        robots = lineup.robots
        positions = np.array([views[name].point for name in robots])
        self._advance(elapsed, positions)
        target = self._reference()
        velocities = self._wanted(positions, target, elapsed)
        out = []
        oldest = max(views[name].age for name in robots)
        for name, (vx, vy) in zip(robots, velocities.tolist(), strict=True):
            member, view = self._members[name], views[name]
            if member.lacks:
                continue
            wanted = (*member.mounting.velocity_in_own(vx, vy), target.velocity[2])
            free = name not in self._waits_for and member.free(now)
            told = self._pipelines[name].step(
                wanted, view.heading, member.returns, view.velocity, to_seconds(elapsed), free
            )
            age = max(oldest, member.returns_age(now)) if self._with_ranges else oldest
            out.append(self._command(name, view, told, age))
        return [*out, *self._said(now)]

    def _wanted(self, positions: Floats, target: Reference, elapsed: Duration) -> Floats:
        """The velocities of the control points of the chain, (k, 2) in m/s."""
        chain = self._lineup.chain
        if self._lineup.building:
            points, ways = self._lineup.ways_at(target)
            desired, actual = (chain.triangles(places).variables() for places in (points, positions))
            self._errors, self._notes = formation.errors(desired, actual), ()
            return follow(points, ways, positions, self._gains)
        aim = chain.desired(target.pose, target.velocity, positions)
        correction = self._law.step(chain, positions, aim, to_seconds(elapsed))
        self._errors = correction.errors
        places = self._lineup.places_at(target.pose)
        velocities, self._notes = self._supervisor.step(positions, places, correction.velocities)
        return velocities

    def _advance(self, elapsed: Duration, positions: Floats) -> None:
        """Let the build-up or the task go on by a tick, if everybody follows."""
        goes = not (self._waits_for or self._told_to_hold)
        self._rate = 0.0
        if goes:
            self._lineup.advance(to_seconds(elapsed))
        if self._stage == "forming":
            self._settling = 0 if self._lineup.building or not goes else self._settling + elapsed
            if not self._lineup.building and self._built():
                self._happened("built")
        elif self._stage == "running" and goes:
            self._rate = rate(self._scenario.waiting, self._farthest(positions))
            self._mission.advance(elapsed, self._rate, self._errors)
            if self._mission.ended:
                self._rate = 0.0
                self._happened("ended")

    def _built(self) -> bool:
        planning = self._scenario.planning
        if self._errors is not None and within(self._errors, planning.tolerance_m, planning.tolerance_rad):
            return True
        return (self._anew or planning.build != "law") and self._settling >= from_seconds(planning.patience_s)

    def _happened(self, event: Event) -> None:
        self._stage = STAGES.get((self._stage, event), self._stage)

    def _farthest(self, positions: Floats) -> float:
        """How far the robot is from its place that is the farthest, m."""
        places = self._lineup.places_at(self._reference().pose)
        return float(np.hypot(*(positions - places).T).max())

    def _reference(self) -> Reference:
        """Where the desired formation is, in the platoon's frame; it moves only while the task goes on."""
        pose, (vx, vy, turning) = self._mission.reference(self._rate)
        frame = self._roster.frame.inverse()
        return Reference(frame.compose(pose), (*frame.rotate(vx, vy), turning))

    def _own_points(self, now: Time) -> dict[str, Point]:
        """The control points of all robots that are there, in the desired formation's own frame."""
        frame = self._reference().pose.inverse()
        points = {}
        for member in self._roster.active:
            view = member.view(now)
            assert view is not None, "nobody plans before everybody was heard"
            x, y, _ = frame.compose(Pose(*view.point, 0.0))
            points[member.id] = (x, y)
        return points

    def _take(self, goal: Goal, now: Time) -> None:
        """Do what the operator wants, or say why not. The latched goal comes again to whoever asks. The last
        that comes while the robots are gathered is done once they are: a new shape needs all of them."""
        if self._former is not None and not self._unknown:
            self._former.heard(goal)
            return
        if self._gathering:
            self._meanwhile = goal
            return
        if goal.id == self._goal:
            return
        self._goal, self._goal_refused = goal.id, ""
        scenario = self._scenario
        if goal.task is not None:
            scenario = replace(scenario, task=goal.task)
        if goal.formation is not None:
            scenario = replace(scenario, formation=pointed(goal.formation, len(scenario.robots)))
        if found := problems(scenario):
            self._goal_refused = "; ".join(found)
            return
        if goal.hold is not None:
            self._told_to_hold = goal.hold
        if goal.formation is not None:
            self._reshape(scenario.formation.points, now)
        if goal.task is not None:
            self._retask(scenario)
        self._scenario = scenario
        self._limit()
        if self._unknown and (goal.task is not None or goal.hold is False):
            self._unknown, self._former, self._anew = "", None, True

    def _reshape(self, points: Sequence[Point], now: Time) -> None:
        """Take a new shape on, on the way."""
        self._lineup.set_points(points)
        if self._stage == "waiting":
            return
        here = self._own_points(now)
        self._plan(here)
        if self._enough:
            self._lineup.build(here, self._scenario.planning.speed_mps)

    def _retask(self, scenario: Scenario) -> None:
        """Begin another task, from where the reference is."""
        self._scenario = scenario
        self._undertake(self._mission.reference(0.0).pose)
        self._happened("new task")

    def _undertake(self, here: Pose) -> None:
        """Begin the task with the reference at `here`."""
        scenario = self._scenario
        task = from_here(scenario.task, here, scenario.planning.speed_mps, self._lineup.reach_m)
        self._mission = Mission(task, scenario.controller)

    def _limit(self) -> None:
        """How old commands may be follows the task and the shape; robots are told where they may not be as
        old as by the scenario they know."""
        limits = bearable(replace(self._scenario, task=self._mission.task))
        for name, member in self._members.items():
            member.limit(limits[name])
        self._stops = {
            name: now.stop_s for name, now in limits.items() if now.stop_s < self._limits[name].stop_s
        }

    def _informed(self, now: Time) -> bool:
        """Whether it is known what there is to do, or known that it is not. A later life than the first
        listens for what the one before it left."""
        former = self._former
        if former is None:
            return True
        if (record := former.record()) is not None:
            self._former, self._unknown = None, ""
            self._resume(record)
            if former.goal is not None:
                self._take(former.goal, now)
        elif not self._unknown and now - self._started >= PATIENCE:
            self._unknown = f"the controller was started again and knows {former.missing}; waits for a goal"
            if former.goal is not None:  # it may have been reached long ago
                self._goal, self._goal_refused = former.goal.id, "the controller was started again"
        return self._former is None or bool(self._unknown)

    def _resume(self, record: Record) -> None:
        """Go on where the life before ended."""
        mission, state, progress = record
        scenario = self._scenario
        if mission.task is not None:
            scenario = replace(scenario, task=mission.task)
        if mission.points is not None:
            scenario = replace(scenario, formation=Formation(points=mission.points))
            self._lineup.set_points(mission.points)
        self._scenario = scenario
        self._roster.recall(mission.seats)
        self._lineup.recall(
            {seat.id: seat.place for seat in mission.seats},
            [member.id for member in self._roster.active],
            mission.built_from,
            to_seconds(progress.built_ns),
            scenario.planning.speed_mps,
        )
        self._mission = Mission(mission.course or scenario.task, scenario.controller)
        self._mission.recall(progress, mission.stage == "done")
        self._settling = progress.settled_ns
        self._stage, self._told_to_hold = mission.stage, mission.hold
        self._goal, self._goal_refused = mission.goal, mission.goal_refused
        self._number = mission.number
        for report in state.roster:
            if report.id in self._pipelines:
                self._pipelines[report.id].recall(report.memory, report.compensation)
        self._supervisor = self._supervise()
        if state.chain == self._lineup.robots:
            self._supervisor.recall(state.led)
        self._gathering = self._stage != "waiting"
        self._limit()

    def _gather(self, now: Time) -> None:
        """After a start in the middle of the task: go on once every robot that is not lost is heard."""
        if not self._roster.ready(now, self._with_ranges):
            return
        self._gathering = False
        if {member.id for member in self._roster.active} != set(self._lineup.robots):
            self._reorganise(now)
        if self._meanwhile is not None:
            self._take(self._meanwhile, now)

    def _views(self, now: Time) -> dict[str, View]:
        """Every robot that is there as the law sees it; those not heard yet are left out."""
        views = {member.id: member.view(now) for member in self._roster.active}
        return {name: view for name, view in views.items() if view is not None}

    def _stand(self, views: Mapping[str, View]) -> list[Outgoing]:
        """Tell the robots of the chain to stand, once they were told to go."""
        if self._stage == "waiting" or self._gathering:
            return []
        oldest = max((view.age for view in views.values()), default=0)
        fit = [name for name in views if not self._members[name].lacks]
        return [self._command(name, views[name], STANDING, oldest) for name in fit]

    def _command(self, name: str, view: View, told: Velocity, age: Duration) -> Outgoing:
        command = Command(
            layer=self._layer,
            values=told[:2],
            third=told[2],
            answers=view.answers,
            inputs_age_ns=age,
            stop_after_s=self._stops.get(name, 0.0),
        )
        return Outgoing(topics.command(name), command)

    def _supervise(self) -> Supervisor:
        """Of the chain as it is now."""
        signed = self._scenario.controller.angle == "signed"
        return Supervisor(self._scenario.supervisor, signed, self._lineup.robots)

    def _pipeline(self, name: str) -> Pipeline:
        return Pipeline(self._layers, self._scenario, self._robots[name], self._parts)

    def _said(self, now: Time) -> list[Outgoing]:
        """The state of the formation, and before it the mission where that has changed."""
        state = Outgoing(topics.FORMATION_STATE, self._state(self._reference(), now))
        if self._unknown:
            return [state]
        mission = self._record()
        if mission == self._told:
            return [state]
        self._told, self._number = mission, self._number + 1
        told = replace(mission, number=self._number, progress=self._progress())
        state = state._replace(message=replace(state.message, mission=self._number))
        return [Outgoing(topics.FORMATION_MISSION, told), state]

    def _record(self) -> messages.Mission:
        """What the next life has to know that changes seldom, without its number and how far things are."""
        scenario, given, mission, lineup = self._scenario, self._given, self._mission, self._lineup
        return messages.Mission(
            number=0,
            stage=self._stage,
            seats=tuple(member.seat(lineup.place_of(member.id)) for member in self._roster.members),
            task=None if scenario.task is given.task else scenario.task,
            course=None if mission.task is scenario.task else mission.task,
            points=None if scenario.formation is given.formation else scenario.formation.points,
            built_from=lineup.built_from,
            hold=self._told_to_hold,
            goal=self._goal,
            goal_refused=self._goal_refused,
        )

    def _progress(self) -> Progress:
        progress = self._mission.progress
        settled = self._settling if self._stage == "forming" else progress.settled_ns
        return replace(progress, settled_ns=settled, built_ns=from_seconds(self._lineup.built_s))

    def _state(self, target: Reference, now: Time) -> FormationState:
        lineup, mission = self._lineup, self._mission
        return FormationState(
            phase=self._phase,
            task_time_s=mission.time_s,
            task_duration_s=mission.course.total_s,
            reference=(target.pose.x, target.pose.y, target.pose.psi),
            reference_velocity=target.velocity,
            chain=lineup.robots,
            errors=b"" if self._errors is None else pack_floats(self._errors),
            roster=tuple(
                member.report(now, line.compensation, line.memory)
                for member, line in zip(self._roster.members, self._pipelines.values(), strict=True)
            ),
            waits_for=tuple(self._waits_for),
            refused=self._refused,
            frame=self._scenario.controller.host or "world",
            points=lineup.packed(),
            leg=mission.leg,
            rate=self._rate,
            reason="; ".join(filter(None, (self._reason, waiting_for(self._waits_for)))),
            goal=self._goal,
            goal_refused=self._goal_refused,
            supervisor=self._notes,
            mission=self._number,
            progress=self._progress(),
            led=self._supervisor.memory,
            preflight=self._preflight.checks,
        )
