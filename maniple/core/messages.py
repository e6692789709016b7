"""Every message, as it is on the wire: a msgpack map, float arrays as little-endian float32 bytes.

SI units and radians throughout; times in ns of the sender's clock unless said otherwise. No message can
hold a cycle, so none is tracked by the garbage collector (`gc=False`).
"""

from typing import Annotated, Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

Layer: TypeAlias = Literal["kinematics", "avoidance", "compensation", "drive"]
"""The layers of one robot, in the order of the pipeline."""

Mode: TypeAlias = Literal["waiting", "tracking", "holding", "stopped", "fault"]
"""What a robot's agent is doing."""

Phase: TypeAlias = Literal["waiting", "running", "done"]
"""What the controller is doing: waiting for robots, running the task, or past its end."""

DriverState: TypeAlias = Literal["closed", "connected", "configured", "active", "fault"]
"""Where a driver is in its life cycle; see `robot_agent.drivers.interface`."""


def pack_floats(values: ArrayLike) -> bytes:
    """An array of any shape as the wire has it: float32, little-endian, C order."""
    return np.ascontiguousarray(values, dtype="<f4").tobytes()


def unpack_floats(data: bytes, columns: int | None = None) -> NDArray[np.float64]:
    """The inverse of `pack_floats`, as float64 of shape (k,), or (k, columns)."""
    flat = np.frombuffer(data, dtype="<f4").astype(np.float64)
    return flat if columns is None else flat.reshape(-1, columns)


class Message(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """What every message carries. The host sets all four when it sends."""

    source: str = ""
    """Name of the node that sent it."""
    incarnation: int = 0
    """Which life of that node: 1 for the first start, higher after every restart."""
    seq: int = 0
    """Counts from 0 for each (source, incarnation, topic)."""
    stamp_ns: int = 0
    """When it was sent, on the sender's clock."""


class Stamp(msgspec.Struct, frozen=True, gc=False):
    """Points at one message of a known topic and sender."""

    incarnation: int
    seq: int
    stamp_ns: int


class Odometry(Message, frozen=True, kw_only=True, gc=False):
    """Pose and velocity of a robot by dead reckoning, in its own frame (which starts at the origin)."""

    frame_id: str
    x_m: float
    y_m: float
    psi_rad: float
    u_mps: float
    w_radps: float
    applied: Stamp | None = None
    """The command that was last acted on."""


class Scan(Message, frozen=True, kw_only=True, gc=False):
    """One sweep of a range finder, beams counter-clockwise, in the frame of the sensor."""

    first_angle_rad: float
    increment_rad: float
    range_min_m: float
    range_max_m: float
    mount: tuple[float, float, float]
    """Pose (m, m, rad) of the sensor in the robot's frame."""
    ranges: Annotated[bytes, msgspec.Meta(description="float32 little-endian, shape (beams,), metres")]
    """Distances; `range_max_m` or more: nothing seen; below `range_min_m`: something too near to measure."""


class Status(Message, frozen=True, kw_only=True, gc=False):
    """How a robot's agent is."""

    mode: Mode
    guard: str
    """Which limit the guard applied last: "none", "age", "speed", "acceleration", "clearance", "blind"."""
    command_age_s: float
    """Age of what the last command was computed from, by the robot's own clock; -1 before the first."""
    command_age_max_s: float
    """The largest such age since the status before; -1 before the first command."""
    driver: DriverState
    reason: str
    """Why the robot is not tracking; empty while it is."""
    counters: dict[str, int]


class Command(Message, frozen=True, kw_only=True, gc=False):
    """What a robot is to do."""

    layer: Layer
    """The first layer that is left for the robot to run."""
    values: tuple[float, float]
    """(u m/s, w rad/s); before "kinematics" the control point's velocity (m/s) in the odometry frame."""
    answers: Stamp
    """The odometry of this robot it was computed from."""
    inputs_age_ns: int
    """Age of the oldest input used, as far as the controller knows."""


class RobotReport(msgspec.Struct, frozen=True, gc=False):
    """What the controller knows of one robot."""

    id: str
    state: Literal["absent", "present", "silent", "unlocalised"]
    odometry_age_s: float
    """Since the last odometry arrived; -1 where none has."""
    mode: str


class FormationState(Message, frozen=True, kw_only=True, gc=False):
    """The formation as the controller sees it."""

    phase: Phase
    task_time_s: float
    """How far along the task the reference is."""
    task_duration_s: float
    reference: tuple[float, float, float]
    """Pose of the desired formation's frame in the formation frame."""
    reference_velocity: tuple[float, float, float]
    """(m/s, m/s, rad/s) of that frame."""
    chain: tuple[str, ...]
    """The robots in the order of the triangle chain: triangle j is robots j, j+1 and j+2."""
    errors: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (triangles, 6): x, y, psi_F, p, q, beta",
            extra={"columns": 6},
        ),
    ]
    """Desired minus estimated."""
    roster: tuple[RobotReport, ...]
    waits_for: tuple[str, ...] = ()
    """The robots that do not follow now: the reference stands until they do."""
    refused: int = 0
    """Inputs that were refused since the start."""


class Drive(Message, frozen=True, kw_only=True, gc=False):
    """What a robot's drive is to do."""

    u_mps: float
    w_radps: float
    active: bool
    """Whether the agent wants the driver active: false lets it brake and deactivate."""


class Motion(Message, frozen=True, kw_only=True, gc=False):
    """What a robot's drive reports."""

    ticks: tuple[int, int]
    """Left and right wheel encoder counts since power-up."""
    applied: tuple[float, float]
    """(u m/s, w rad/s) it is applying, after its own limits."""
    state: DriverState
    controllable: bool
    reason: str = ""
    """Why it is not controllable; empty while it is."""


class Truth(Message, frozen=True, kw_only=True, gc=False):
    """The world as it really is. Only the recorder, reports and tests may look."""

    robots: tuple[str, ...]
    poses: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (robots, 3): x, y, psi in the world frame",
            extra={"columns": 3},
        ),
    ]
    velocities: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (robots, 2): u m/s, w rad/s", extra={"columns": 2}
        ),
    ]
    clearances: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (robots,): smallest distance (m) from the outline to "
            "anything since the Truth before"
        ),
    ]
    collisions: int
    """Onsets of contact since the start."""
    contacts: tuple[str, ...] = ()
    """Who touches what now, as "r1|r2" or "r1|obstacle 3", with the index in `world.obstacles`, from 0."""


class Decided(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What a receiver's fault injection did to one message."""

    source: str
    topic: str
    incarnation: int
    seq: int
    dropped: bool
    delay_ns: int


class Decisions(Message, frozen=True, kw_only=True, gc=False):
    """What a receiver's fault injection did since the last of these; links without faults are not listed."""

    decided: tuple[Decided, ...]


class Call(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One call into a node."""

    kind: Literal["start", "message", "timer", "stop"]
    now_ns: int
    name: str = ""
    """The topic of a message, or the timer."""
    source: str = ""
    incarnation: int = 0
    seq: int = 0
    crc32: int = 0
    """Of the bytes as delivered."""
    data: bytes | None = None
    """Those bytes, where they are not what the source sent."""


class Journal(Message, frozen=True, kw_only=True, gc=False):
    """The calls into one node since the last of these, in order."""

    calls: tuple[Call, ...]


class Alive(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host: a node came to life, or its life ended as far as the network tells."""

    node: str
    node_incarnation: int
    alive: bool


class Refused(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host: an input that did not reach the node."""

    topic: str
    sender: str
    reason: str


class Counters(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host once a second: what it counted since the start."""

    counters: dict[str, int]
