"""The central controller: n odometries (and scans) in, n commands and the state of the formation out."""

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np

from central_controller import formation
from central_controller.chain import Chain
from central_controller.formation import Correction, Gains
from central_controller.reference import REST, Reference, duration_s, reference
from central_controller.roster import Member, Roster, View
from maniple.control.pipeline import Pipeline, central_layers
from maniple.core import topics
from maniple.core.messages import Alive, Command, FormationState, Phase, Refused, pack_floats
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Duration, Time, from_seconds, period, to_seconds

Event: TypeAlias = Literal["ready", "ended"]
"""Every robot has been heard; the task time has come to its end."""

PHASES: Mapping[tuple[Phase, Event], Phase] = {
    ("waiting", "ready"): "running",
    ("running", "ended"): "done",
}
"""The phase after an event; an event that is not listed for a phase changes nothing."""

CONTROL = "control"

_LONGEST_STEP: Duration = SECOND // 2
"""After a freeze the reference and the layers of the robots are advanced by no more than this."""


class CentralController:
    """Guides the platoon of a resolved scenario.

    It waits until it has heard every robot, then runs the task, and from its end on holds the formation where
    the reference ends. While any robot does not follow, the reference stands and the others hold their places
    around it. Robots that have gone silent are still commanded: each command says how old what it was
    computed from is, and the robot's own guard acts on that.
    """

    def __init__(self, scenario: Scenario) -> None:
        layers = central_layers(scenario.placement.robot_from)
        self._layer = scenario.placement.robot_from
        self._with_ranges = "avoidance" in layers and scenario.avoidance.enabled
        self._task = scenario.task
        self._duration = from_seconds(duration_s(scenario.task))
        self._chain = Chain(scenario.formation.points, signed=scenario.controller.angle == "signed")
        self._gains = Gains.of(scenario.controller)
        self._roster = Roster(scenario.robots)
        self._pipelines = tuple(
            Pipeline(layers, robot.control_point_m, scenario.avoidance) for robot in scenario.robots
        )
        self._timers = {CONTROL: period(scenario.rates.control_hz)}
        self._topics = _inputs(self._roster.members, self._with_ranges)
        self._members = {member.id: member for member in self._roster.members}
        self._phase: Phase = "waiting"
        self._task_time: Duration = 0
        self._waits_for: tuple[str, ...] = ()
        self._refused = 0
        self._ticked: Time | None = None

    @property
    def name(self) -> str:
        """Of the node."""
        return "controller"

    @property
    def subscriptions(self) -> frozenset[str]:
        """Topics the node receives."""
        return frozenset(self._topics) | {topics.HOST_ALIVE, topics.HOST_REFUSED}

    @property
    def timers(self) -> Mapping[str, Duration]:
        """Formation control."""
        return self._timers

    def on_start(self, now: Time) -> list[Outgoing]:
        """Say that the platoon is waited for."""
        return [self._state(self._reference(), b"", now)]

    def on_message(self, message: Received, now: Time) -> list[Outgoing]:
        """Take in what a robot said, or who is alive."""
        body = message.message
        if isinstance(body, Refused):
            self._refused += 1
            return []
        member = self._members.get(body.node) if isinstance(body, Alive) else self._topics[message.topic]
        if member is not None:
            member.heard(body, now)
        return []

    def on_timer(self, timer: str, now: Time) -> list[Outgoing]:
        """One tick of the formation law: a command to every robot while running and after, and the state."""
        if timer != CONTROL:
            return []
        elapsed = 0 if self._ticked is None else min(now - self._ticked, _LONGEST_STEP)
        self._ticked = now
        self._advance(elapsed, now)
        target = self._reference()
        views = self._roster.views(now)
        if views is None:
            return [self._state(target, b"", now)]
        positions = np.array([view.point for view in views])
        desired = self._chain.desired(target.pose, target.velocity)
        correction = formation.step(self._chain, self._gains, positions, desired)
        state = self._state(target, pack_floats(correction.errors), now)
        if self._phase == "waiting":
            return [state]
        return [*self._commands(views, correction, to_seconds(elapsed), now), state]

    def on_stop(self, now: Time) -> list[Outgoing]:
        """Tell every robot that was commanded to stand still."""
        views = self._roster.views(now)
        if views is None or self._phase == "waiting":
            return []
        oldest = max(view.age for view in views)
        return [
            self._command(member, view, (0.0, 0.0), oldest)
            for member, view in zip(self._roster.members, views, strict=True)
        ]

    def _advance(self, elapsed: Duration, now: Time) -> None:
        """Let the phase and the task time follow what has happened."""
        self._waits_for = self._roster.waited_for(now)
        if self._phase == "running" and not self._waits_for:
            self._task_time = min(self._task_time + elapsed, self._duration)
        event = self._event(now)
        if event == "ready" and self._phase == "waiting":
            self._roster.locate()
        if event is not None:
            self._phase = PHASES.get((self._phase, event), self._phase)

    def _event(self, now: Time) -> Event | None:
        if self._phase == "waiting":
            return "ready" if self._roster.ready(now, self._with_ranges) else None
        return "ended" if self._task_time >= self._duration else None

    def _reference(self) -> Reference:
        """Where the desired formation is; it moves only while the task runs and everybody follows."""
        target = reference(self._task, to_seconds(self._task_time))
        moves = self._phase == "running" and not self._waits_for
        return target if moves else target._replace(velocity=REST)

    def _commands(self, views: list[View], correction: Correction, dt_s: float, now: Time) -> list[Outgoing]:
        """What the central layers make of the velocities of the control points."""
        oldest = max(view.age for view in views)
        out = []
        for member, pipeline, view, (vx, vy) in zip(
            self._roster.members, self._pipelines, views, correction.velocities.tolist(), strict=True
        ):
            wanted = member.mounting.velocity_in_own(vx, vy)
            values = pipeline.step(wanted, view.heading, member.returns, dt_s)
            age = max(oldest, member.returns_age(now)) if self._with_ranges else oldest
            out.append(self._command(member, view, values, age))
        return out

    def _command(self, member: Member, view: View, values: tuple[float, float], age: Duration) -> Outgoing:
        command = Command(layer=self._layer, values=values, answers=view.answers, inputs_age_ns=age)
        return Outgoing(topics.command(member.id), command)

    def _state(self, target: Reference, errors: bytes, now: Time) -> Outgoing:
        state = FormationState(
            phase=self._phase,
            task_time_s=to_seconds(self._task_time),
            task_duration_s=to_seconds(self._duration),
            reference=(target.pose.x, target.pose.y, target.pose.psi),
            reference_velocity=target.velocity,
            chain=self._roster.ids,
            errors=errors,
            roster=self._roster.reports(now),
            waits_for=self._waits_for,
            refused=self._refused,
        )
        return Outgoing(topics.FORMATION_STATE, state)


def _inputs(members: Sequence[Member], with_ranges: bool) -> dict[str, Member]:
    """Which robot a topic is about, for every topic a robot may be heard on."""
    names = (topics.odometry, topics.status, *((topics.ranges,) if with_ranges else ()))
    return {name(member.id): member for member in members for name in names}
