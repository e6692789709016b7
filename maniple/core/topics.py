"""The one table of topics. A key on the network is `PREFIX/NAME`; a name has its `{id}` filled in."""

from functools import lru_cache
from typing import Literal, TypeAlias

import msgspec

from maniple.core import messages
from maniple.core.errors import MessageError
from maniple.core.scenario.types import Rates

Network: TypeAlias = Literal["fleet", "hardware", "host"]
"""Which network a topic lives on: "fleet" may fail, "hardware" is a robot's own wiring, "host" is local."""


class Topic(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the table."""

    pattern: str
    """Name with `{id}` for the robot or node."""
    type: type[messages.Message]
    rate_hz: float
    """Nominal; 0 for messages sent on an occasion."""
    paced_by: str = ""
    """The field of the scenario's rates that says how often instead."""
    stale_after_s: float = 0.0
    """Older than this, the last value says nothing about now; 0 for never."""
    senders: tuple[str, ...] = ()
    """Who may send it, as node names with "{id}" for the robot; empty for anybody. Of several it is one for
    each robot, as its scenario says."""
    network: Network = "fleet"
    priority: Literal["commands", "state", "sensors", "background"] = "state"
    congestion: Literal["drop", "block"] = "drop"
    reliability: Literal["reliable", "best_effort"] = "reliable"
    latched: bool = False
    """Whether the router keeps the last value for late joiners."""
    recorded: bool = True
    faults: bool = False
    """Whether network faults apply."""


TOPICS: tuple[Topic, ...] = (
    Topic(
        pattern="robot/{id}/odometry",
        type=messages.Odometry,
        rate_hz=20,
        paced_by="motion_hz",
        stale_after_s=0.5,
        senders=("{id}",),
        latched=True,
        faults=True,
    ),
    Topic(
        pattern="robot/{id}/ranges",
        type=messages.Scan,
        rate_hz=10,
        paced_by="scan_hz",
        stale_after_s=0.5,
        senders=("{id}",),
        priority="sensors",
        faults=True,
    ),
    Topic(
        pattern="robot/{id}/status",
        type=messages.Status,
        rate_hz=2,
        paced_by="status_hz",
        stale_after_s=2.0,
        senders=("{id}",),
        priority="background",
        faults=True,
    ),
    Topic(
        pattern="robot/{id}/command",
        type=messages.Command,
        rate_hz=10,
        paced_by="control_hz",
        stale_after_s=0.5,
        senders=("controller",),
        priority="commands",
        faults=True,
    ),
    Topic(
        pattern="formation/state",
        type=messages.FormationState,
        rate_hz=10,
        paced_by="control_hz",
        stale_after_s=1.0,
        senders=("controller",),
        latched=True,
        faults=True,
    ),
    Topic(
        pattern="formation/mission",
        type=messages.Mission,
        rate_hz=0,
        senders=("controller",),
        latched=True,
        faults=True,
    ),
    Topic(
        pattern="formation/goal",
        type=messages.Goal,
        rate_hz=0,
        latched=True,
        faults=True,
        priority="commands",
    ),
    Topic(pattern="platoon/stop", type=messages.EmergencyStop, rate_hz=0, latched=True, priority="commands"),
    Topic(pattern="faults/plan", type=messages.FaultPlan, rate_hz=0, latched=True, priority="commands"),
    Topic(pattern="faults/decisions", type=messages.Decisions, rate_hz=5, priority="background"),
    Topic(
        pattern="hw/{id}/drive",
        type=messages.Drive,
        rate_hz=20,
        paced_by="drive_hz",
        stale_after_s=0.5,
        senders=("{id}",),
        network="hardware",
        priority="commands",
    ),
    Topic(
        pattern="hw/{id}/motion",
        type=messages.Motion,
        rate_hz=20,
        paced_by="motion_hz",
        stale_after_s=0.5,
        senders=("simulator", "{id}-driver"),
        network="hardware",
    ),
    Topic(
        pattern="hw/{id}/scan",
        type=messages.Scan,
        rate_hz=10,
        paced_by="scan_hz",
        stale_after_s=0.5,
        senders=("simulator", "{id}-driver", "{id}-scanner"),
        network="hardware",
        priority="sensors",
    ),
    Topic(
        pattern="hw/{id}/pose",
        type=messages.ExternalPose,
        rate_hz=10,
        stale_after_s=0.5,
        network="hardware",
    ),
    Topic(
        pattern="sim/{id}/drive",
        type=messages.Drive,
        rate_hz=20,
        paced_by="drive_hz",
        stale_after_s=0.5,
        senders=("{id}-vehicle",),
        network="hardware",
        priority="commands",
    ),
    Topic(
        pattern="sim/{id}/motion",
        type=messages.Motion,
        rate_hz=20,
        paced_by="motion_hz",
        stale_after_s=0.5,
        senders=("simulator",),
        network="hardware",
    ),
    Topic(
        pattern="sim/{id}/scan",
        type=messages.Scan,
        rate_hz=10,
        paced_by="scan_hz",
        stale_after_s=0.5,
        senders=("simulator",),
        network="hardware",
        priority="sensors",
    ),
    Topic(
        pattern="sim/truth",
        type=messages.Truth,
        rate_hz=10,
        paced_by="truth_hz",
        senders=("simulator",),
        network="hardware",
    ),
    Topic(
        pattern="journal/{id}",
        type=messages.Journal,
        rate_hz=5,
        senders=("{id}",),
        priority="background",
        congestion="block",
    ),
    Topic(
        pattern="links/{id}",
        type=messages.LinkReports,
        rate_hz=1,
        stale_after_s=5.0,
        senders=("{id}",),
        priority="background",
    ),
    Topic(pattern="host/alive", type=messages.Alive, rate_hz=0, network="host", recorded=False),
    Topic(pattern="host/refused", type=messages.Refused, rate_hz=0, network="host", recorded=False),
    Topic(pattern="host/counters", type=messages.Counters, rate_hz=1, network="host", recorded=False),
)

HOST_ALIVE = "host/alive"
HOST_REFUSED = "host/refused"
HOST_COUNTERS = "host/counters"
DECISIONS = "faults/decisions"
PLAN = "faults/plan"
STOP = "platoon/stop"
FORMATION_STATE = "formation/state"
FORMATION_GOAL = "formation/goal"
FORMATION_MISSION = "formation/mission"
TRUTH = "sim/truth"


@lru_cache(4096)  # names may be forged
def topic(name: str) -> Topic:
    """The row of a topic name.

    Raises:
        MessageError: no row has this name.
    """
    parts = name.split("/")
    for row in TOPICS:
        pattern = row.pattern.split("/")
        if len(pattern) == len(parts) and all(
            p in ("{id}", q) and q for p, q in zip(pattern, parts, strict=True)
        ):
            return row
    known = ", ".join(row.pattern for row in TOPICS)
    raise MessageError(f"topic {name!r} is not in the table; topics are {known}")


@lru_cache(4096)  # names may be forged
def senders_of(name: str) -> tuple[str, ...]:
    """The nodes that alone may send on a topic; none where anybody may."""
    row = topic(name)
    robot = name.split("/")[1] if "{id}" in row.pattern else ""
    return tuple(sender.replace("{id}", robot) for sender in row.senders)


def sender_of(name: str) -> str:
    """The one node that may send on a topic; empty where several or all may."""
    senders = senders_of(name)
    return senders[0] if len(senders) == 1 else ""


def may_send(name: str, source: str) -> bool:
    """Whether a node may send on a topic."""
    senders = senders_of(name)
    return not senders or source in senders


def has_known_senders(name: str) -> bool:
    """Whether a name is that of a topic on which not everybody may send."""
    try:
        return bool(senders_of(name))
    except MessageError:
        return False


def rate_hz(name: str, rates: Rates) -> float:
    """How often there is news on a topic, at the rates of a scenario; 0 for what is sent on an occasion."""
    row = topic(name)
    return float(getattr(rates, row.paced_by)) if row.paced_by else row.rate_hz


def odometry(robot: str) -> str:
    """Topic of a robot's odometry."""
    return f"robot/{robot}/odometry"


def ranges(robot: str) -> str:
    """Topic of what a robot senses, as its agent passes it on."""
    return f"robot/{robot}/ranges"


def status(robot: str) -> str:
    """Topic of a robot's status."""
    return f"robot/{robot}/status"


def command(robot: str) -> str:
    """Topic of the commands to a robot."""
    return f"robot/{robot}/command"


def drive(robot: str) -> str:
    """Topic of the commands to a robot's drive."""
    return f"hw/{robot}/drive"


def motion(robot: str) -> str:
    """Topic of what a robot's drive reports."""
    return f"hw/{robot}/motion"


def scan(robot: str) -> str:
    """Topic of a robot's range finder."""
    return f"hw/{robot}/scan"


def external_pose(robot: str) -> str:
    """Topic of where others see a robot."""
    return f"hw/{robot}/pose"


def simulated_drive(robot: str) -> str:
    """Topic of the commands to the simulated body of a robot that is presented as a vehicle."""
    return f"sim/{robot}/drive"


def simulated_motion(robot: str) -> str:
    """Topic of how that body moves."""
    return f"sim/{robot}/motion"


def simulated_scan(robot: str) -> str:
    """Topic of what that body's range finder sees."""
    return f"sim/{robot}/scan"


def links(node: str) -> str:
    """Topic of what a node's host counted of the links into it."""
    return f"links/{node}"


def journal(node: str) -> str:
    """Topic of a node's journal."""
    return f"journal/{node}"
