"""Two small real nodes: a robot-like one that reports on a timer, and one that answers every report."""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from maniple.core import topics
from maniple.core.messages import Command, Message, Odometry, Stamp
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, Duration, Time


class Reporter:
    """Sends odometry ten times a second and remembers what it is told."""

    def __init__(self, name: str = "r1") -> None:
        self.name = name
        self.subscriptions = frozenset({topics.command(name), topics.HOST_REFUSED, topics.HOST_ALIVE})
        self.timers: Mapping[str, Duration] = {"report": SECOND // 10}
        self.heard: list[tuple[Time, Message]] = []
        self.stopped = False

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        self.heard.append((now, message.message))
        return ()

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        return (Outgoing(topics.odometry(self.name), odometry(self.name, x_m=float(len(self.heard)))),)

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        self.stopped = True
        return (Outgoing(topics.odometry(self.name), odometry(self.name, x_m=-1.0)),)


class Answerer:
    """Answers every odometry with a command."""

    name = "controller"
    timers: Mapping[str, Duration] = {}

    def __init__(self, robots: Sequence[str] = ("r1",)) -> None:
        self.subscriptions = frozenset(topics.odometry(robot) for robot in robots)

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        heard = message.message
        stamp = Stamp(heard.incarnation, heard.seq, heard.stamp_ns)
        return (Outgoing(topics.command(heard.source), command(answers=stamp)),)

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        return ()

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        return ()


def odometry(frame: str, **changes: Any) -> Odometry:
    values: dict[str, Any] = {
        "frame_id": frame,
        "x_m": 0.0,
        "y_m": 0.0,
        "psi_rad": 0.0,
        "u_mps": 0.0,
        "w_radps": 0.0,
    }
    return Odometry(**values | changes)


def command(**changes: Any) -> Command:
    values: dict[str, Any] = {
        "layer": "drive",
        "values": (0.1, 0.0),
        "answers": Stamp(1, 0, 0),
        "inputs_age_ns": 0,
    }
    return Command(**values | changes)


def scenario_with(**changes: Any) -> Scenario:
    """A scenario of one robot, as far as a host looks at it."""
    table: dict[str, Any] = {
        "name": "hosts",
        "robots": [{"id": "r1", "pose": [0, 0, 0]}],
        "formation": {"points": [[0, 0]]},
        "task": {"kind": "line", "start": [0, 0], "end": [1, 0], "speed_mps": 0.1},
    }
    return msgspec.convert(table | changes, Scenario)
