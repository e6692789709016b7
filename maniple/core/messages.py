"""Every message, as it is on the wire: a msgpack map, float arrays as little-endian float32 bytes.

SI units and radians throughout; times in ns of the sender's clock unless said otherwise. No message can
hold a cycle, so none is tracked by the garbage collector (`gc=False`).
"""

from typing import Annotated, Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from maniple.core.layers import Layer
from maniple.core.scenario.types import Crash, Fault, Formation, Freeze, Partition, Task

Mode: TypeAlias = Literal["waiting", "tracking", "holding", "emergency", "stopped", "fault"]
"""What a robot's agent is doing; "emergency" from an emergency stop until it is armed again."""

Phase: TypeAlias = Literal["waiting", "forming", "running", "holding", "done"]
"""What the controller is doing: waiting for robots, building the formation, running the task, standing
because it was told to or because too few robots are left, or past the task's end."""

Stage: TypeAlias = Literal["waiting", "forming", "running", "done"]
"""What there is to do: wait for robots, build the formation, run the task, nothing more."""

DriverState: TypeAlias = Literal["closed", "connected", "configured", "active", "fault"]
"""Where a driver is in its life cycle; see `robot_agent.drivers.interface`."""


def pack_floats(values: ArrayLike) -> bytes:
    """An array of any shape as the wire has it: float32, little-endian, C order."""
    return np.ascontiguousarray(values, dtype="<f4").tobytes()


def unpack_floats(data: bytes, columns: int | None = None) -> NDArray[np.float64]:
    """The inverse of `pack_floats`, as float64 of shape (k,), or (k, columns)."""
    flat = np.frombuffer(data, dtype="<f4").astype(np.float64)
    return flat if columns is None else flat.reshape(-1, columns)


Count = Annotated[int, msgspec.Meta(ge=0, lt=2**62)]
"""What is counted, times in ns among them: room to add two without an overflow."""


class Message(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """What every message carries. The host sets all four when it sends."""

    source: str = ""
    """Name of the node that sent it."""
    incarnation: Count = 0
    """Which life of that node: 1 for the first start, higher after every restart."""
    seq: Count = 0
    """Counts from 0 for each (source, incarnation, topic)."""
    stamp_ns: Count = 0
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
    v_mps: float = 0.0
    """Sideways to the left, of a robot that can."""
    applied: Stamp | None = None
    """The command that was last acted on."""
    held_ns: int = 0
    """How long ago that command arrived: what a round trip by way of it takes beyond the network."""
    ticks: tuple[int, ...] = ()
    """The encoder counts this pose belongs to: with them a restarted agent knows how far the robot rolled
    on while it was dead. Empty before the first."""
    motion_pose: tuple[float, float, float] | None = None
    """Instead of `ticks`: the pose (m, m, rad) that the driver reported, in the driver's own frame."""
    motion_origin: int | None = None
    """And `Motion.origin`."""
    motion_incarnation: int = 0
    """The life of the driver that counted them."""


class Scan(Message, frozen=True, kw_only=True, gc=False):
    """One sweep of a range finder, beams counter-clockwise, in the frame of the sensor."""

    first_angle_rad: float
    increment_rad: float
    range_min_m: float
    range_max_m: float
    mount: tuple[float, float, float]
    """Pose (m, m, rad) of the sensor in the robot's frame."""
    beams: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (beams, 3): x, y (m) and direction (rad) of each beam",
            extra={"columns": 3},
        ),
    ] = b""
    """Where each beam starts and points in the sensor's frame, where they are no even fan (an array of
    sonars); then `first_angle_rad` and `increment_rad` say nothing."""
    cone_rad: float = 0.0
    """Opening angle of a beam: what is seen may be anywhere across it."""
    ranges: Annotated[bytes, msgspec.Meta(description="float32 little-endian, shape (beams,), metres")]
    """Distances; `range_max_m` or more: nothing seen; below `range_min_m`: something too near to measure."""


class Status(Message, frozen=True, kw_only=True, gc=False):
    """How a robot's agent is."""

    mode: Mode
    guard: str
    """Which limit the guard applied last: "none", "age", "speed", "acceleration", "clearance", "blind",
    "fence"."""
    command_age_s: float
    """Age of what the last command was computed from, by the robot's own clock; -1 before the first."""
    command_age_max_s: float
    """The largest such age since the status before; -1 before the first command."""
    driver: DriverState
    reason: str
    """Why the robot is not tracking; while it is: that it does not move though it is told to, or empty."""
    counters: dict[str, int]
    compensation: tuple[float, ...] = ()
    """The adapted parameters, where the robot compensates its dynamics itself."""
    localised: bool = True
    """Whether it knows where its frame lies: false for one that was restarted and has not heard its own last
    odometry."""
    controllable: bool = False
    """Whether its drive is heard, and lets itself be controlled."""
    estop_tested: bool = False
    """Whether this life of the agent has stood by an emergency stop and was armed again."""
    scenario: str = ""
    """Digest of the scenario it runs, the first 16 digits; empty where no pre-flight check asks for it."""
    sees: bool = True
    """Whether it has the ranges that its layers or its guard go by; true for one that goes by none."""
    limits: tuple[float, float, float] | None = None
    """The most that it can do with its driver: (u m/s, w rad/s, v m/s)."""
    drive_scenario: str = ""
    """The same digits of the scenario that the process of its driver runs; empty where it has none, or that
    does not say."""


class Command(Message, frozen=True, kw_only=True, gc=False):
    """What a robot is to do."""

    layer: Layer
    """The first layer that is left for the robot to run."""
    values: tuple[float, float]
    """(u m/s, w rad/s); before "kinematics" the control point's velocity (m/s) in the odometry frame."""
    third: float = 0.0
    """Sideways speed v to the left (m/s); before "kinematics" the turning rate (rad/s) of the formation. Only
    for robots whose heading is free."""
    answers: Stamp
    """The odometry of this robot it was computed from."""
    inputs_age_ns: int
    """Age of the oldest input used, as far as the controller knows."""
    stop_after_s: float = 0.0
    """At this age of what it was computed from the robot stands, if its own limit is not smaller, and slows
    down from as much earlier in proportion: what a goal that is faster than the scenario's task bears. 0:
    the robot's own limit."""


class RobotReport(msgspec.Struct, frozen=True, gc=False):
    """What the controller knows of one robot."""

    id: str
    state: Literal["absent", "present", "silent", "unlocalised", "lost"]
    odometry_age_s: float
    """Since the last odometry was sent, as far as the controller can tell; -1 where none has arrived."""
    mode: str
    compensation: tuple[float, ...] = ()
    """The adapted parameters, where the controller compensates the robot's dynamics."""
    incarnation: int = 0
    """The last life of its agent that was heard of; 0 before the first."""
    reason: str = ""
    """Why it is not tracking, by its own account."""
    round_trip_s: float = -1.0
    """What the network takes for a command and an odometry back, last measured; -1 before that."""
    memory: tuple[tuple[float, ...], ...] = ()
    """The state of its layers here: kinematics and avoidance. Empty where they have none."""


class Progress(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """How far the platoon is with what there is to do."""

    leg: int = 0
    """Which part of a sequence of tasks."""
    leg_ns: int = 0
    """Task time since the beginning of that leg."""
    settled_ns: int = 0
    """For how long the robots have been where the leg, or the building of the formation, wants them."""
    built_ns: int = 0
    """For how long the formation, or a new shape, has been being built."""


class Led(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One robot of the chain that the supervisor leads round a singular point."""

    kind: str
    triangle: int
    robot: int
    way: float
    """1 counter-clockwise, -1 clockwise."""


class Check(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One line of the pre-flight check: something that has to hold before a robot moves."""

    robot: str
    item: str
    """What is looked at; one of `central_controller.preflight.ITEMS`."""
    holds: bool | None
    """None: that can't be known yet."""
    why: str = ""
    """Why it does not hold; empty where it does."""


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
    frame: str = "world"
    """What `reference` is given in: "world", or the robot whose odometry frame the controller works in."""
    points: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (robots in the chain, 2), metres", extra={"columns": 2}
        ),
    ] = b""
    """Where the control points of the chain are to be, in the desired formation's frame."""
    leg: int = 0
    """Which part of a sequence of tasks, from 0."""
    rate: float = 1.0
    """How fast the reference moves along the task: 1 as planned, 0 it stands."""
    reason: str = ""
    """Why the platoon holds, or for whom the reference waits and why; empty while neither is so."""
    goal: str = ""
    """The `id` of the last goal that was decided on."""
    goal_refused: str = ""
    """Why that goal was refused; empty where it was not."""
    supervisor: tuple[str, ...] = ()
    """What the supervisor does now, a line for each triangle it keeps from becoming singular."""
    mission: int = 0
    """The number of the `Mission` this belongs to."""
    progress: Progress = Progress()
    led: tuple[Led, ...] = ()
    """What the supervisor remembers."""
    preflight: tuple[Check, ...] = ()
    """Of a platoon that is looked at before it moves: every line for all robots until it has passed, then
    those of the robots that have yet to pass it to be taken in again."""


class Seat(msgspec.Struct, frozen=True, gc=False):
    """One robot in the formation, whether it is there or not."""

    id: str
    place: int
    """The index of its place among the points of the formation."""
    incarnation: int = 0
    """The life of its agent that is believed; 0 before the task has begun."""
    frame_id: str = ""
    """Of its odometry: the frame whose origin is the robot's initial pose."""
    lost: bool = False
    """Whether the others go on without it."""
    passed: int = 0
    """The last life of its agent that passed the pre-flight check; 0 for none, or where there is none."""


class Mission(Message, frozen=True, kw_only=True):
    """What the platoon has to do, and who does what: all that a controller which is started again has to know
    and that changes seldom. The rest is in `FormationState`."""

    number: int
    """Counts these within one life of the controller."""
    stage: Stage
    seats: tuple[Seat, ...]
    task: Task | None = None
    """The task, where it is not that of the scenario."""
    course: Task | None = None
    """The task with the way to its start, where there is one."""
    points: tuple[tuple[float, float], ...] | None = None
    """The places (m) of the formation, where they are not those of the scenario."""
    built_from: tuple[tuple[float, float], ...] = ()
    """While the formation is being built: where the control points of the chain began, in its frame (m)."""
    hold: bool = False
    """Whether an operator wants the platoon to stand."""
    goal: str = ""
    goal_refused: str = ""
    """As in `FormationState`."""
    progress: Progress = Progress()
    """When this was sent. A `FormationState` with the same number in `mission` knows more."""


class Goal(Message, frozen=True, kw_only=True):
    """What an operator wants from here on; what is None stays as it is."""

    id: str
    """The operator's own mark, given back in `formation/state`."""
    task: Task | None = None
    """A new task; it begins at once."""
    formation: Formation | None = None
    """A new shape for all robots of the scenario, built on the way."""
    hold: bool | None = None
    """True: stand; false: go on."""


class EmergencyStop(Message, frozen=True, kw_only=True, gc=False):
    """An operator's emergency stop, or its release: above goals, and no fault is injected into it."""

    stopped: bool
    """True: every robot stands; false: armed again."""
    reason: str = ""
    """For people."""


class Drive(Message, frozen=True, kw_only=True, gc=False):
    """What a robot's drive is to do."""

    u_mps: float
    w_radps: float
    active: bool
    """Whether the agent wants the driver active: false lets it brake and deactivate."""
    controller_alive: bool = False
    """Whether the controller is there, as far as the agent knows: a vehicle's own failsafe hangs on it."""
    v_mps: float = 0.0
    """Sideways to the left, for a robot that can."""


class Motion(Message, frozen=True, kw_only=True, gc=False):
    """What a robot's drive reports."""

    ticks: tuple[int, ...]
    """Wheel encoder counts since power-up: left and right, or as many as the robot has wheels that count."""
    applied: tuple[float, float]
    """(u m/s, w rad/s) it is applying, after its own limits."""
    state: DriverState
    controllable: bool
    reason: str = ""
    """Why it is not controllable; empty while it is."""
    applied_v_mps: float = 0.0
    """Sideways to the left, likewise."""
    pose: tuple[float, float, float] | None = None
    """Instead of `ticks`, from a drive that reckons itself: (m, m, rad) in the frame that the driver's
    capabilities name, of the same point as for the model."""
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """With `pose`: (u m/s, w rad/s, v m/s) as the drive measures them."""
    scenario: str = ""
    """From the process of a driver: digest of the scenario it runs, the first 16 digits."""
    origin: Count | None = None
    """With `pose`: how often its frame began anew in this life of the driver. While that stays the same,
    poses go on from those before, whatever state the driver was in meanwhile (a vehicle rolls on while its
    link is cut). None, where the driver can't tell: they begin anew whenever the hardware is configured anew.
    """


class ExternalPose(Message, frozen=True, kw_only=True, gc=False):
    """Where a robot is, by somebody who sees it: motion capture, GNSS, SLAM. For vehicles that have no
    position of their own."""

    pose: tuple[float, float, float]
    """(m, m, rad) in the world frame, of the same point as for the model."""
    sigma: tuple[float, float, float] = (0.02, 0.02, 0.02)
    """Standard deviation of each."""


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
    sideways: Annotated[
        bytes,
        msgspec.Meta(
            description="float32 little-endian, shape (robots,): v (m/s) to the left; empty where none can"
        ),
    ] = b""


class FaultPlan(Message, frozen=True, kw_only=True):
    """Everything that is injected from here on; it replaces the plan before."""

    since_ns: int
    """The start of the run in scenario time: what all times in it count from."""
    faults: tuple[Fault, ...] = ()
    partitions: tuple[Partition, ...] = ()
    crashes: tuple[Crash, ...] = ()
    freezes: tuple[Freeze, ...] = ()


Cause: TypeAlias = Literal["", "cut", "loss", "burst", "rate"]
"""Why fault injection lost a message: a partition, chance, a burst, a full queue; empty if it did not."""


class Decided(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What a receiver's fault injection did to one message."""

    source: str
    topic: str
    incarnation: int
    seq: int
    dropped: bool
    delay_ns: int
    corrupted: bool = False
    """Whether bits were flipped."""
    copy_delay_ns: int = -1
    """Delay of the second copy; -1 where there is none."""
    cause: Cause = ""
    """Why it was dropped."""


class Decisions(Message, frozen=True, kw_only=True, gc=False):
    """What a receiver's fault injection did since the last of these; links without faults are not listed."""

    decided: tuple[Decided, ...]


class Call(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One call into a node."""

    kind: Literal["start", "message", "timer", "stop"]
    now_ns: int
    name: str = ""
    """The topic of a message, the timer, or at the start the digest of the scenario that the host runs."""
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
    sent: dict[str, int] = {}
    """How many messages this life has sent so far on each topic on which it sent since the last of these; the
    journal itself is left out."""


class Alive(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host: a node came to life, or its life ended as far as the network tells."""

    node: str
    node_incarnation: int
    alive: bool


class Refused(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host: inputs that did not reach the node."""

    topic: str
    sender: str
    reason: str
    count: int = 1
    """How many of the same kind since the last that was told of."""


class Counters(Message, frozen=True, kw_only=True, gc=False):
    """Made by the host once a second: what it counted since the start."""

    counters: dict[str, int]


class LinkReport(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What one receiver has counted of one sender's topic since its own start."""

    source: str
    topic: str
    received: int
    """Taken in."""
    missing: int
    """By their sequence numbers, of those that a life of the sender sent since its first that arrived."""
    injected: int
    """Of these, what fault injection dropped here."""
    refused: int


class LinkReports(Message, frozen=True, kw_only=True, gc=False):
    """What a node's host has counted of every link into it, once a second."""

    links: tuple[LinkReport, ...]
