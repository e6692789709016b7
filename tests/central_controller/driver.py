"""Four robots and what they say to a controller, without any."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from central_controller.node import CONTROL, CentralController
from maniple.control.builtin import BUILTIN
from maniple.control.parts import Parts
from maniple.core import codec, topics
from maniple.core.geometry import Pose
from maniple.core.layers import Layer
from maniple.core.messages import (
    Alive,
    Command,
    FormationState,
    Mission,
    Mode,
    Odometry,
    Scan,
    Status,
    pack_floats,
)
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import (
    Controller,
    Formation,
    Guard,
    Line,
    Placement,
    Robot,
    Scenario,
)
from maniple.core.time import MILLISECOND, SECOND, Time
from tests.pioneer import PIONEER, SICK

T0 = 1000 * SECOND
AHEAD = 900 * SECOND
"""The controller's clock, of those of the robots."""
A = 0.3
PLACES = ((1.0, 0.0), (0.0, 0.8), (0.0, -0.8), (-1.4, 0.8))
HEADINGS = (0.0, 0.5, -2.0, 3.0)
"""Of the robots at the start."""
ORIGIN = Pose(0.0, 0.0, 0.0)


def scenario(robot_from: Layer = "kinematics", **changes: Any) -> Scenario:
    """Four robots whose control points stand at their places, each with a heading of its own."""
    robots = tuple(
        Robot(
            id=f"r{k + 1}",
            control_point_m=A,
            pose=(x - A * math.cos(psi), y - A * math.sin(psi), psi),
        )
        for k, ((x, y), psi) in enumerate(zip(PLACES, HEADINGS, strict=True))
    )
    made = Scenario(
        name="test",
        robots=robots,
        formation=Formation(points=PLACES),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1, settle_s=2.0),
        placement=Placement(robot_from=robot_from),
        controller=Controller(lost_after_s=3.0),
        guard=Guard(hold_after_s=0.25, stop_after_s=0.5),
        models={"pioneer-3dx": PIONEER},
        sensors={"sick-lms200": SICK},
    )
    return replace(made, **changes)


def odometry(own: Pose = ORIGIN, seq: int = 0, **velocity: float) -> Odometry:
    return Odometry(
        incarnation=1,
        seq=seq,
        frame_id="own",
        x_m=own.x,
        y_m=own.y,
        psi_rad=own.psi,
        u_mps=velocity.get("u", 0.0),
        w_radps=velocity.get("w", 0.0),
    )


def scan(nearest_m: float = 8.0, bearing_rad: float = 0.0) -> Scan:
    bearings = np.linspace(-math.pi / 2, math.pi / 2, 181)
    ranges = np.where(np.abs(bearings - bearing_rad) < 0.2, nearest_m, 8.0)
    return Scan(
        incarnation=1,
        first_angle_rad=-math.pi / 2,
        increment_rad=math.radians(1.0),
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.0, 0.0, 0.0),
        ranges=pack_floats(ranges),
    )


class Driver:
    """Speaks for all robots and listens to the controller."""

    def __init__(self, made: Scenario, now: Time = T0, parts: Parts = BUILTIN, incarnation: int = 1) -> None:
        self.node = CentralController(made, parts, incarnation)
        self.ids = tuple(robot.id for robot in made.robots)
        self.now = now
        self.missions: list[Mission] = []
        for robot in self.ids:
            self.say(topics.HOST_ALIVE, Alive(node=robot, node_incarnation=1, alive=True))
            self.mode(robot, "tracking")

    def odometries(self, poses: Mapping[str, Odometry] | None = None) -> None:
        for robot in self.ids:
            self.say(topics.odometry(robot), (poses or {}).get(robot, odometry()))

    def scans(self, **scans: Scan) -> None:
        for robot in self.ids:
            self.say(topics.ranges(robot), scans.get(robot, scan()))

    def mode(self, robot: str, mode: Mode, guard: str = "none", incarnation: int = 1) -> None:
        status = Status(
            incarnation=incarnation,
            mode=mode,
            guard=guard,
            command_age_s=-1.0,
            command_age_max_s=-1.0,
            driver="active",
            reason="",
            counters={},
        )
        self.say(topics.status(robot), status)

    def say(self, topic: str, message: Any) -> None:
        """Sent now; the robots' clocks are elsewhere."""
        if isinstance(message, Odometry | Scan):
            message = replace(message, stamp_ns=self.now - AHEAD)
        assert self.node.on_message(Received(topic, message), self.now) == []

    def tick(self, after_ms: float = 0.0) -> tuple[dict[str, Command], FormationState]:
        self.now += round(after_ms * MILLISECOND)
        return self.hears(self.node.on_timer(CONTROL, self.now))

    def hears(self, sent: list[Outgoing]) -> tuple[dict[str, Command], FormationState]:
        """Commands by robot and the state."""
        self.missions += [message for _, message in sent if isinstance(message, Mission)]
        return heard(sent)


def heard(sent: list[Outgoing]) -> tuple[dict[str, Command], FormationState]:
    """Commands by robot and the state, each a valid message of its topic."""
    commands = {}
    for topic, message in sent[:-1]:
        if topic == topics.FORMATION_MISSION:
            assert codec.decode(topic, codec.encode(message)) == message
            continue
        assert isinstance(message, Command)
        assert codec.decode(topic, codec.encode(message)) == message
        commands[topic.split("/")[1]] = message
    topic, state = sent[-1]
    assert topic == topics.FORMATION_STATE
    assert isinstance(state, FormationState)
    assert codec.decode(topic, codec.encode(state)) == state
    return commands, state
