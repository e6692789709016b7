"""Every parameter type. Each field's docstring is what `docs/scenario.md` says of it.

SI units, radians, counter-clockwise, x forward/east, y left/north. Poses are (x m, y m, heading rad).
"""

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from maniple.core.layers import Layer

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Seconds = Annotated[float, Meta(ge=0, le=1_000_000)]
PositiveSeconds = Annotated[float, Meta(gt=0, le=1_000_000)]
Probability = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(ge=0.001, le=1000, description="Hz")]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
Point: TypeAlias = tuple[float, float]
PoseXY: TypeAlias = tuple[float, float, float]
Six: TypeAlias = tuple[Positive, Positive, Positive, Positive, Positive, Positive]


class Parameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all parameter types: frozen, by keyword, unknown fields refused."""


class Shape(Parameters, frozen=True, kw_only=True):
    """A named shape of the formation, for any number of robots."""

    kind: Literal["line-abreast", "vee", "wedge", "polygon", "column"]
    """Triangles side by side, a vee (one robot at the back and two arms forward), a wedge (the other way
    round), a regular polygon, or triangles in a column."""
    spacing_m: Positive
    """Distance between neighbours."""


class Formation(Parameters, frozen=True, kw_only=True):
    """The desired shape: where each robot's control point is to be, in the formation's own frame."""

    points: tuple[Point, ...] = ()
    """One (x forward, y left) for each robot, in the order of the robots."""
    shape: Shape | None = None
    """Instead of `points`."""


class Line(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="line"):
    """Task: the formation's frame travels along a straight line at constant speed, facing along it."""

    start: Point
    """Where the formation's origin starts."""
    end: Point
    """Where it ends."""
    speed_mps: Positive
    """Speed of the reference; less than any robot's `u_max_mps`."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class Waypoints(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="waypoints"):
    """Task: straight lines between points, joined by arcs, at constant speed."""

    points: Annotated[tuple[Point, ...], Meta(min_length=2)]
    """Where the formation's origin goes, in order."""
    speed_mps: Positive
    """Speed of the reference along its way; less than any robot's `u_max_mps`."""
    radius_m: Positive = 1.0
    """Of the arcs at the corners; smaller where neighbouring corners leave no room for it."""
    facing: Literal["along", "fixed"] = "along"
    """Whether the formation turns with its way, or keeps the direction it starts in."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class Orbit(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="circle"):
    """Task: the formation's origin goes round a circle at constant speed."""

    centre: Point
    """Its middle."""
    radius_m: Positive
    """Its radius."""
    speed_mps: Positive
    """Speed of the reference along its way; less than any robot's `u_max_mps`."""
    turns: Positive = 1.0
    """How many times round."""
    clockwise: bool = False
    """Which way round."""
    start_rad: float = 0.0
    """Where it starts, as the direction from the centre."""
    facing: Literal["along", "fixed"] = "along"
    """Whether the formation turns with its way, or keeps the direction it starts in."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class FigureEight(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="figure-eight"):
    """Task: the formation's origin follows a figure eight at constant speed."""

    centre: Point
    """Where the two loops meet, and where it starts and ends."""
    size_m: Positive
    """From the centre to the far end of a loop."""
    speed_mps: Positive
    """Speed of the reference along its way; less than any robot's `u_max_mps`."""
    laps: Positive = 1.0
    """How many times through both loops."""
    angle_rad: float = 0.0
    """Direction from the centre to the far end of the first loop."""
    facing: Literal["along", "fixed"] = "along"
    """Whether the formation turns with its way, or keeps the direction it starts in."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class Csv(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="csv"):
    """Task: a way from a file with the columns t_s, x_m, y_m and, if it turns, psi_rad. Becomes `samples`
    when the scenario is loaded."""

    file: str
    """Path, relative to the scenario file."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class Samples(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="samples"):
    """Task: the formation's frame goes through given poses at given times, smoothly."""

    times_s: Annotated[tuple[float, ...], Meta(min_length=2)]
    """Rising, from 0."""
    poses: Annotated[tuple[PoseXY, ...], Meta(min_length=2)]
    """Of the formation's frame, one for each time; headings are unwrapped along the shorter way."""
    settle_s: Seconds = 0.0
    """How long the reference rests at the end before the task counts as completed."""


class Positioning(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="positioning"):
    """Task: the formation is to stand at a pose; ended when every triangle is where it is to be."""

    target: PoseXY
    """Of the formation's frame."""
    start: PoseXY = (0.0, 0.0, 0.0)
    """Where the formation's frame is when robots without a `pose` are placed."""
    tolerance_m: Positive = 0.02
    """The most any x, y, p or q of a triangle may be off, as the controller sees it."""
    tolerance_rad: Positive = 0.02
    """The most any psi_F or beta may be off."""
    settle_s: Seconds = 0.0
    """For how long all errors must stay within the tolerances."""


Leg: TypeAlias = Line | Waypoints | Orbit | FigureEight | Csv | Samples | Positioning
"""One part of a task; `kind` chooses."""


class Sequence(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="sequence"):
    """Task: several, one after the other. Each starts where its own parameters say."""

    tasks: Annotated[tuple[Leg, ...], Meta(min_length=1)]
    """In order; each as `[task]` would be, of any other kind."""


Task: TypeAlias = Line | Waypoints | Orbit | FigureEight | Csv | Samples | Positioning | Sequence
"""What the platoon is to do; `kind` chooses."""


class Circle(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="circle"):
    """Obstacle: a disc."""

    centre: Point
    """Its middle."""
    radius_m: Positive
    """Its radius."""


class Box(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="box"):
    """Obstacle: a rectangle."""

    centre: Point
    """Its middle."""
    size: tuple[Positive, Positive]
    """Length along its own x and y."""
    angle_rad: float = 0.0
    """Of its own x axis."""


class Polygon(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="polygon"):
    """Obstacle: a simple polygon, convex or not."""

    points: Annotated[tuple[Point, ...], Meta(min_length=3)]
    """Corners in order; edges may not cross or touch."""


class Wall(Parameters, frozen=True, kw_only=True, tag_field="kind", tag="wall"):
    """Obstacle: a line without thickness."""

    start: Point
    """One end."""
    end: Point
    """The other."""


Obstacle: TypeAlias = Circle | Box | Polygon | Wall
"""What stands in the way; `kind` chooses."""


class World(Parameters, frozen=True, kw_only=True):
    """What is around the robots."""

    obstacles: tuple[Obstacle, ...] = ()
    """Circles, boxes, polygons and walls."""


class RobotModel(Parameters, frozen=True, kw_only=True):
    """A type of robot: what it can do, how it answers, and how well it knows itself."""

    drive: Literal["differential", "omnidirectional", "car"] = "differential"
    """How it moves: two driven wheels (or two sides, skid steering); three omni wheels at 60, 180 and 300
    degrees around its middle; or a driven rear axle and steered front wheels."""
    kinematics: str = ""
    """How it is steered by its control point: the name of an installed class (see docs/extending.md), by
    default the inverse kinematics of `drive`."""
    length_m: Positive
    """Of the body, along x; the body is a rectangle."""
    width_m: Positive
    """Of the body, along y."""
    body_offset_m: float = 0.0
    """How far ahead of the middle of the (rear) axle the middle of the body is."""
    wheel_radius_m: Positive
    """Of the driven wheels."""
    track_m: Positive
    """Distance between the left and the right wheel (the effective one for skid steering); of an
    omnidirectional robot the diameter of the circle its wheels touch the ground on."""
    wheelbase_m: Positive | None = None
    """Distance between the axles; for a car only, and required there."""
    steer_max_rad: Annotated[float, Meta(gt=0, lt=1.5)] | None = None
    """Largest steering angle of a single front wheel in the middle; for a car only, and required there."""
    ticks_per_revolution: Positive
    """Encoder counts in one turn of a wheel."""
    u_max_mps: Positive
    """Largest forward and backward speed."""
    v_max_mps: Positive | None = None
    """Largest sideways speed; for an omnidirectional robot only, and required there."""
    w_max_radps: Positive
    """Largest turning rate."""
    u_accel_mps2: Positive
    """Largest acceleration that is commanded."""
    w_accel_radps2: Positive
    """Largest angular acceleration that is commanded."""
    brake_mps2: Positive
    """Deceleration the robot can be trusted to brake with."""
    theta: tuple[float, float, float, float, float, float]
    """Velocity dynamics, th1 .. th6: th1 u' = th3 w^2 - th4 u + u_ref; th2 w' = -th5 u w - th6 w + w_ref
    (Martins et al. 2008, doi 10.1016/j.conengprac.2008.03.004); sideways th1 v' = -th4 v + v_ref; th1, th2,
    th4 and th6 are positive."""
    drive_timeout_s: PositiveSeconds = 0.5
    """A drive that hears nothing for this long brakes by itself; longer than the period of `drive_hz`."""
    sensor_mount: PoseXY = (0.0, 0.0, 0.0)
    """Where a range finder sits on the body, from the middle of the axle."""
    wheel_error: tuple[float, ...] = ()
    """How much larger each wheel really is than `wheel_radius_m`, as a share: one number a wheel (left and
    right; of an omnidirectional robot all three), or none."""
    track_error: float = 0.0
    """How much larger the track really is than `track_m`, as a share."""
    slip_sigma: NotNegative = 0.0
    """Wheel slip: how much more or less than it rolls a wheel turns, as a share; standard deviation of what
    is drawn anew for each wheel every `slip_length_m`."""
    slip_length_m: Positive = 0.1
    """Rolled distance over which the slip of a wheel stays the same."""


class RangeFinder(Parameters, frozen=True, kw_only=True):
    """A type of range finder: a fan of beams, or transducers that look in directions of their own."""

    beams: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """Number of beams of a fan."""
    first_angle_rad: float = 0.0
    """Direction of the first beam in the sensor's frame; the others follow counter-clockwise."""
    increment_rad: NotNegative = 0.0
    """Angle between neighbouring beams; the fan covers at most a full turn."""
    transducers: tuple[PoseXY, ...] = ()
    """Instead of a fan: (x, y, direction) of each, in the robot's frame; the model's `sensor_mount` does not
    count."""
    cone_rad: Annotated[float, Meta(ge=0, lt=3.1)] = 0.0
    """Opening angle of a transducer: it reads the distance of the nearest thing within its cone."""
    range_min_m: NotNegative = 0.0
    """Nearer than this it can't measure; less than `range_max_m`."""
    range_max_m: Positive
    """Farther than this it sees nothing."""
    sigma_m: NotNegative = 0.0
    """Standard deviation of the error."""
    resolution_m: NotNegative = 0.0
    """Step of the readings; 0 for none."""

    @property
    def readings(self) -> int:
        """Distances in one scan."""
        return len(self.transducers) or self.beams


class Mavlink(Parameters, frozen=True, kw_only=True):
    """The vehicle of a robot with `driver = "mavlink"`: an ArduPilot Rover (see docs/hardware.md)."""

    connection: str = ""
    """Where it is: "serial:/dev/ttyUSB0:57600", "udpin:0.0.0.0:14550" (it sends here), "udpout:HOST:PORT",
    "tcp:HOST:PORT" or "tcpin:0.0.0.0:PORT" (it connects here). Of a presented robot by default a TCP port of
    this machine."""
    system_id: Annotated[int, Meta(ge=1, le=255)] = 1
    """Its own; what others say on the same connection is not heard."""
    component_id: Annotated[int, Meta(ge=1, le=255)] = 1
    """Of its autopilot."""
    gcs_system_id: Annotated[int, Meta(ge=1, le=255)] = 255
    """Under which it is commanded; its MAV_GCS_SYSID."""
    arm: bool = False
    """Whether the driver arms it. By default a pilot does, and the driver waits for that."""
    disarm: bool = True
    """Whether it is disarmed on the way out, once it stands."""
    origin: tuple[float, float, float] | None = None
    """(latitude, longitude, degrees; altitude, m) of the world's (0, 0), with x east and y north: the same
    for all vehicles. Their poses are in the world frame then; without it in a frame that begins where each
    stands."""
    external_pose: bool = False
    """Whether it has no position of its own and is fed with what comes on `hw/ID/pose`."""


class Ros2(Parameters, frozen=True, kw_only=True):
    """The topics of a robot with `driver = "ros2"` (see docs/hardware.md)."""

    router: str = ""
    """Zenoh router of the ROS 2 side, as "tcp/192.168.1.12:7447"; by default that of the hardware network."""
    layout: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"
    """How ROS 2 topics are named there: by rmw_zenoh, or by zenoh-bridge-ros2dds in front of a DDS robot."""
    domain_id: Annotated[int, Meta(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID."""
    namespace: str = ""
    """Of its topics, as "/r2"; by default the robot's id. "/" for none."""
    cmd_vel: str = "cmd_vel"
    """Where it takes velocities."""
    odom: str = "odom"
    """Where it says nav_msgs/Odometry."""
    scan: str = "scan"
    """Where it says sensor_msgs/LaserScan."""
    stamped: bool = False
    """Whether it takes geometry_msgs/TwistStamped instead of Twist, as diff_drive_controller does."""
    in_world: bool = False
    """Whether its odometry is in the world frame, as a localisation says it, not in a frame of its own."""
    unmeasured: Literal["near", "far"] = "near"
    """What a beam of a scan counts as that says neither a distance nor infinity (NaN, 0, or outside of the
    limits): something too near to measure, or nothing. "far" only for a range finder that says so where it
    sees nothing."""


class Robot(Parameters, frozen=True, kw_only=True):
    """One robot of the platoon."""

    id: Name
    """Its name in topics, commands and reports; unique, and not that of another node ("controller",
    "simulator", "recorder", "router", or a robot's with "-driver", "-scanner" or "-vehicle")."""
    model: str = "pioneer-3dx"
    """A type of robot: one of `models`, or of the catalogue."""
    sensor: str = "sick-lms200"
    """A type of range finder: one of `sensors`, or of the catalogue."""
    driver: Name = "simulator"
    """What its drive and sensors really are: "simulator", "mavlink", "ros2", or the name of an installed
    driver (see docs/extending.md)."""
    scans: Annotated[str, Meta(pattern=r"^([A-Za-z0-9][A-Za-z0-9_-]{0,63})?$")] = ""
    """Where its scans come from if not from its driver: another one, as a laser on ROS 2 beside a MAVLink
    drive."""
    presents: Literal["nothing", "mavlink", "ros2"] = "nothing"
    """Whether the simulator has a body for it that shows itself as such a vehicle, for its driver to connect
    to: everything but the hardware is as with a real one."""
    mavlink: Mavlink = Mavlink()
    """Of a MAVLink vehicle."""
    ros2: Ros2 = Ros2()
    """Of a ROS 2 robot."""
    options: dict[str, Any] = {}
    """Parameters of an installed driver; what is valid is the driver's own affair."""
    control_point_m: Positive = 0.2
    """Distance a from the middle of the axle forward to the point that is controlled."""
    pose: PoseXY | None = None
    """Initial pose of the middle of the axle; by default the control point starts at its place."""


class Start(Parameters, frozen=True, kw_only=True):
    """How far from their places robots without a `pose` start."""

    scatter_m: NotNegative = 0.0
    """Each starts at most this far from its place, in a random direction."""
    scatter_rad: NotNegative = 0.0
    """Each starts turned by at most this much."""


class Controller(Parameters, frozen=True, kw_only=True):
    """The formation law, eq. (7): q_ref' = q_des' + L tanh(L^-1 kappa (q_des - q))."""

    # Not `Positive | Six`: msgspec 0.22 crashes on a union of a constrained number and a tuple of such.
    # `check` knows their bounds.
    kappa: float | Six = 0.25
    """Gain, 1/s, from 1e-6 to 1000: one number for all, or one for each of x, y, psi_F, p, q, beta."""
    saturation: float | Six = 0.10
    """L, the most each of the six is corrected, m/s and rad/s, from 1e-6 to 1000: one number, or six."""
    angle: Literal["signed", "unsigned"] = "signed"
    """Shape angle: signed tells a triangle from its mirror image; unsigned is the paper's eq. (4)."""
    reference: Literal["formation", "neighbours"] = "formation"
    """Desired pose of the triangles after the first: the one in the desired formation, or built on where the
    two robots before are now."""
    law: str = "paper"
    """The formation law: "paper", or the name of an installed one (see docs/extending.md)."""
    options: dict[str, Any] = {}
    """Parameters of an installed law; what is valid is the law's own affair."""
    host: Name | None = None
    """The robot whose computer the controller runs on, as in the paper's experiments: its links to it are
    local, it ends with it, and works in its odometry frame. By default a computer of its own."""
    lost_after_s: PositiveSeconds = 5.0
    """A robot that has been gone, silent or out of control for this long is lost: the others go on without
    it. One that only holds, by its guard, is waited for as long as that lasts."""


class Waiting(Parameters, frozen=True, kw_only=True):
    """The reference slows down when the formation can't keep up."""

    enabled: bool = False
    """Whether it does."""
    free_m: NotNegative = 0.10
    """Up to this position error, the largest over the robots, the reference goes at full speed."""
    stop_m: Positive = 0.50
    """From this error on it stands; in between it slows evenly. More than `free_m`."""


class Supervisor(Parameters, frozen=True, kw_only=True):
    """Keeps every triangle away from where its Jacobian is singular."""

    enabled: bool = True
    """Whether it acts."""
    margin_m: Positive = 0.15
    """It acts when p, q or the median of a triangle gets smaller than this (with the unsigned angle also
    when the robots are this near to a line)."""
    exchange: bool = False
    """Whether robots of one type may exchange their places instead of passing through each other."""


class Planning(Parameters, frozen=True, kw_only=True):
    """Who takes which place, and how the formation is built before the task begins."""

    method: str = "given"
    """Who takes which place: "given" (the order of the robots), "final-reorganization" and "proximity" (the
    two of section 5), "optimal" (least sum of the squared ways, see docs/planning.md; needs SciPy), or the
    name of an installed planner."""
    relabel: bool = False
    """Whether the places may be numbered anew so that the triangles of the chain overlap as little as
    possible."""
    build: Literal["straight", "law", "off"] = "off"
    """How scattered robots build the formation before the task starts: all along straight lines that end at
    the same moment, by the formation law alone, or not at all."""
    speed_mps: Positive = 0.10
    """Of the fastest robot on its straight line."""
    tolerance_m: Positive = 0.05
    """The formation counts as built when no x, y, p or q of a triangle is off by more."""
    tolerance_rad: Positive = 0.10
    """And no psi_F or beta by more."""
    patience_s: Seconds = 30.0
    """This long after the straight ways have ended the task begins all the same: a robot that went too far
    and can't see behind itself comes back to its place only on the way."""


class Impedance(Parameters, frozen=True, kw_only=True):
    """Mechanical impedance I x'' + B x' + K x = F, eqs. (13) and (14)."""

    inertia: Positive
    """I."""
    damping: Positive
    """B."""
    stiffness: Positive
    """K."""


class Avoidance(Parameters, frozen=True, kw_only=True):
    """Virtual forces and mechanical impedance, eqs. (9) to (14)."""

    enabled: bool = True
    """Whether the layer is there at all."""
    b: Positive = 1.0
    """Force per squared metre inside the shell, eq. (9)."""
    d_min_m: NotNegative = 0.30
    """Nearer than this the force stays at its largest; less than `d_max_m`."""
    d_max_m: Positive = 0.95
    """Radius of the virtual shell, from the robot's centre."""
    linear: Impedance = Impedance(inertia=0.4, damping=5.6, stiffness=10.0)
    """How the speed reacts, eq. (13)."""
    angular: Impedance = Impedance(inertia=0.2, damping=1.4, stiffness=0.65)
    """How the turning rate reacts, eq. (14)."""
    form: Literal["cos", "sin"] = "cos"
    """How a force slows the robot: F cos(beta) as the text says, or F sin(beta) as eq. (13) is printed."""
    split: Literal["objects", "returns"] = "objects"
    """Left and right: each object once, on the side of its nearest return, or return by return."""
    gap_m: Positive = 0.30
    """Neighbouring returns farther apart than this belong to different objects."""
    law: str = "impedance"
    """The law: "impedance", or the name of an installed one (see docs/extending.md)."""
    options: dict[str, Any] = {}
    """Parameters of an installed law; what is valid is the law's own affair."""


class Compensation(Parameters, frozen=True, kw_only=True):
    """Adaptive dynamic compensation (Martins et al. 2008, doi 10.1016/j.conengprac.2008.03.004)."""

    enabled: bool = False
    """Whether the layer is there at all."""
    law: str = "adaptive"
    """The law: "adaptive", or the name of an installed one (see docs/extending.md)."""
    options: dict[str, Any] = {}
    """Parameters of an installed law; what is valid is the law's own affair."""
    k_u: Positive = 4.0
    """Gain on the speed error."""
    k_w: Positive = 4.0
    """Gain on the turning rate error."""
    l_u: Positive = 1.0
    """Saturation of the speed correction."""
    l_w: Positive = 1.0
    """Saturation of the turning rate correction."""
    gamma: Six = (1.7, 1.1, 0.5, 0.3, 0.01, 0.5)
    """How fast each of the six parameters is adapted."""
    sigma: tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative] = (
        5e-4,
        1e-3,
        1e-3,
        6e-5,
        1e-3,
        1e-3,
    )
    """How fast each is forgotten."""
    adapt: bool = True
    """Whether they are adapted at all."""
    initial: Annotated[float, Meta(ge=0.625, le=1.6)] = 1.0
    """The parameters start at the model's `theta` times this; they never leave these limits."""
    filter_s: PositiveSeconds = 0.2
    """Time constant of the derivative of the desired velocities."""


class Placement(Parameters, frozen=True, kw_only=True):
    """Where the layers of each robot run."""

    robot_from: Layer = "kinematics"
    """The first layer that runs on the robot: "drive" (all central, as in the paper), "compensation",
    "avoidance" or "kinematics"."""


class Guard(Parameters, frozen=True, kw_only=True):
    """What a robot does to what it is told, last and on its own."""

    clearance: bool = True
    """Whether it refuses to drive into what it senses, or where its range finder does not look: backwards, or
    sideways unless that looks all round."""
    gamma_per_s: Positive = 1.0
    """It approaches a thing at distance d no faster than this times what is left of d."""
    margin_m: NotNegative = 0.05
    """Distance it keeps, beyond the circle around its body."""
    hold_after_s: PositiveSeconds | None = None
    """Commands computed from data older than this slow it down; less than `stop_after_s`, by default half
    of it."""
    stop_after_s: PositiveSeconds | None = None
    """At this age it stands; by default what the control loop tolerates (see docs/architecture.md)."""
    fence: tuple[Point, ...] = ()
    """Geofence: corners of a simple polygon in the world, in order, that the circle around no robot's body
    leaves, as far as the robot knows where it is; none by default."""


class Preflight(Parameters, frozen=True, kw_only=True):
    """What is looked at before the platoon moves."""

    enabled: bool | None = None
    """Whether anything is; by default where a robot's driver is not the simulator."""
    estop: bool = True
    """Whether every robot must have stood by an emergency stop, and been armed again, since its agent
    started. (`maniple run` and `maniple preflight` do that.)"""
    start_m: Positive = 1.0
    """How far from its `pose` a robot may start, by its own account."""
    start_rad: Positive = 0.5
    """And how far it may be turned from it."""


class Rates(Parameters, frozen=True, kw_only=True):
    """How often things happen, Hz."""

    physics_hz: Rate = 100.0
    """Steps of the simulated world."""
    motion_hz: Rate = 20.0
    """Encoders and odometry; at most `physics_hz`."""
    scan_hz: Rate = 10.0
    """Range finders; at most `physics_hz`."""
    control_hz: Rate = 10.0
    """Formation control."""
    drive_hz: Rate = 20.0
    """Commands to the drive."""
    status_hz: Rate = 2.0
    """Robot status."""
    truth_hz: Rate = 10.0
    """Ground truth; at most `physics_hz`."""


class Links(Parameters, frozen=True, kw_only=True):
    """The network as it is without faults."""

    prefix: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$")] = "maniple"
    """Of every key."""
    fleet_latency_s: PositiveSeconds = 0.001
    """Least latency between robots and controller in virtual time."""
    hardware_latency_s: PositiveSeconds = 0.0002
    """Least latency between an agent and its hardware in virtual time."""
    lease_s: Annotated[float, Meta(ge=0.1, le=3600)] = 2.0
    """A node that is cut off for this long counts as gone. For real sessions wall time, else scenario
    time."""


class Burst(Parameters, frozen=True, kw_only=True):
    """Losses that come in bursts: the two-state Markov chain of Gilbert and Elliott, a step for each message
    (Elliott 1963, doi 10.1002/j.1538-7305.1963.tb00955.x)."""

    enter: Probability
    """From the good state to the bad one, for each message."""
    leave: Annotated[float, Meta(gt=0, le=1)]
    """From the bad state to the good one; a burst lasts 1 / leave messages on average."""
    loss_good: Probability = 0.0
    """Share of the messages that are lost in the good state."""
    loss_bad: Probability = 1.0
    """And in the bad state."""


class Fault(Parameters, frozen=True, kw_only=True):
    """What the fleet network does to the messages of the links that match."""

    source: str = "*"
    """Sending node; `*`, `?` and `[...]` match as in file names."""
    destination: str = "*"
    """Receiving node, likewise."""
    topic: str = "*"
    """Topic, likewise: "robot/*/command"."""
    preset: str = ""
    """A measured network (see docs/faults.md): it gives every number below that is left out."""
    latency_s: Seconds = 0.0
    """Delay of every message, one way."""
    jitter_s: Seconds = 0.0
    """The delay is off by up to this much, evenly, either way."""
    loss: Probability = 0.0
    """Share of the messages that are lost, each on its own."""
    burst: Burst | None = None
    """Losses in bursts, beside those."""
    duplicate: Probability = 0.0
    """Share of the messages that arrive twice; the second copy has a delay of its own."""
    reorder: Probability = 0.0
    """Share of the messages that are held back by another `reorder_s`, so that later ones overtake them."""
    reorder_s: Seconds = 0.2
    """For how long."""
    corrupt: Probability = 0.0
    """Share of the messages of which bits are flipped on the way."""
    rate_kbps: PositiveSeconds | None = None
    """The link carries no more than this, kilobits a second; what comes faster queues up. Each pair of nodes
    has a link of its own."""
    queue_s: Seconds = 1.0
    """What would have to wait for longer in that queue is lost."""
    windows: tuple[tuple[Seconds, Seconds], ...] = ()
    """When the rule is on: [from, to) in seconds since the start of the run; by default always."""


class Partition(Parameters, frozen=True, kw_only=True):
    """Groups of nodes that do not hear each other for a while."""

    groups: tuple[tuple[str, ...], ...]
    """Node names, `*` and `?` as in file names; the nodes in none of the groups are another group."""
    at_s: Seconds = 0.0
    """When it begins, since the start of the run."""
    for_s: PositiveSeconds | None = None
    """How long it lasts; to the end by default."""


class Crash(Parameters, frozen=True, kw_only=True):
    """A node dies without a word, and may come back."""

    node: Name
    """A robot, "controller"; with real processes also "recorder" or "router"."""
    at_s: Seconds
    """When, since the start of the run."""
    restart_after_s: PositiveSeconds | None = None
    """How long it is gone; for ever by default."""


class Freeze(Parameters, frozen=True, kw_only=True):
    """A node stands still, as a stopped process does, and goes on later."""

    node: Name
    """A robot, "controller" or "simulator"; with real processes also "recorder" or "router"."""
    at_s: Seconds
    """When, since the start of the run."""
    for_s: PositiveSeconds
    """For how long."""


class ClockError(Parameters, frozen=True, kw_only=True):
    """The clock of a node is off. Nothing may depend on that: clocks of two machines are never compared."""

    node: Name
    """A robot, "controller" or "simulator"."""
    offset_s: Annotated[float, Meta(ge=-1_000_000, le=1_000_000)] = 0.0
    """How far it is ahead at the start of the run."""
    skew_ppm: Annotated[float, Meta(ge=-10_000, le=10_000)] = 0.0
    """How much faster it goes, parts per million."""


class Scenario(Parameters, frozen=True, kw_only=True):
    """A whole run: robots, formation, task, world, and every parameter of every part."""

    name: Name
    """What recordings and reports are called."""
    description: str = ""
    """For people."""
    seed: Annotated[int, Meta(ge=0, le=2**53)] = 1
    """Of every random stream."""
    robots: tuple[Robot, ...]
    """The platoon, in the order of the triangle chain: the first three are the leader triangle."""
    formation: Formation
    """The desired shape."""
    task: Task
    """What the platoon is to do."""
    start: Start = Start()
    """How the robots stand at first."""
    world: World = World()
    """What is around them."""
    controller: Controller = Controller()
    """The formation law."""
    planning: Planning = Planning()
    """Who takes which place, and how the formation is built."""
    waiting: Waiting = Waiting()
    """The reference waits for robots that can't keep up."""
    supervisor: Supervisor = Supervisor()
    """Singular triangles are avoided."""
    avoidance: Avoidance = Avoidance()
    """Obstacle avoidance of each robot."""
    compensation: Compensation = Compensation()
    """Dynamic compensation of each robot."""
    placement: Placement = Placement()
    """Where the layers run."""
    guard: Guard = Guard()
    """The robots' own last word."""
    preflight: Preflight = Preflight()
    """What is looked at before the platoon moves."""
    rates: Rates = Rates()
    """How often things happen."""
    network: Links = Links()
    """The network without faults."""
    faults: tuple[Fault, ...] = ()
    """What is wrong with it."""
    partitions: tuple[Partition, ...] = ()
    """Who does not hear whom, and when."""
    crashes: tuple[Crash, ...] = ()
    """Which nodes die, and when."""
    freezes: tuple[Freeze, ...] = ()
    """Which nodes stand still for a while, and when."""
    clocks: tuple[ClockError, ...] = ()
    """Whose clock is off."""
    models: dict[str, RobotModel] = {}
    """Types of robots, beside those of the catalogue."""
    sensors: dict[str, RangeFinder] = {}
    """Types of range finders, beside those of the catalogue."""

    def model_of(self, robot: Robot) -> RobotModel:
        """The type of a robot of a resolved scenario."""
        return self.models[robot.model]

    def sensor_of(self, robot: Robot) -> RangeFinder:
        """The range finder of a robot of a resolved scenario."""
        return self.sensors[robot.sensor]
