"""Messages in, what viewers draw out."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log

from maniple.core import topics
from maniple.core.errors import MessageError
from maniple.core.faults import plan_of
from maniple.core.geometry import Pose
from maniple.core.happenings import Weight
from maniple.core.messages import (
    Drive,
    EmergencyStop,
    FaultPlan,
    FormationState,
    Goal,
    Message,
    Mission,
    Odometry,
    Scan,
    Status,
    Truth,
    unpack_floats,
)
from maniple.core.scenario.types import Point, Scenario
from maniple.core.time import MILLISECOND, SECOND, Duration, Time, from_seconds
from maniple.recording.viz import scene
from maniple.recording.viz.basics import timestamp, wire
from maniple.recording.viz.channels import (
    FORMATION,
    FORMATION_SCALARS,
    LOG,
    OBSTACLES,
    ROBOTS,
    TF,
    Channel,
    Drawn,
    channels_of,
    triangle_scalars_key,
)
from maniple.recording.viz.narrator import Line, Narrator
from maniple.recording.viz.robot_view import RobotView
from maniple.recording.viz.scalars import FormationScalars, TriangleScalars, encode, largest
from maniple.recording.viz.sensed import laser_scan, point_cloud

TICK: Duration = 100 * MILLISECOND
"""Frames and the robots' numbers are told this often, whatever the rate of odometry."""

SCAN_GAP: Duration = 150 * MILLISECOND
"""Scans of one robot are at least this far apart: every other one of the usual 10 Hz."""

STATE_GAP: Duration = 75 * MILLISECOND
"""And states of the formation this far: each of the usual 10 Hz."""

TRAIL_PERIOD: Duration = 2 * SECOND

AGAIN: Duration = 5 * SECOND
"""What does not change is told again this often, for viewers that come late."""

_LEVELS: Mapping[Weight, Log.Level.ValueType] = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}

_WANTED = (
    Drive,
    EmergencyStop,
    FaultPlan,
    FormationState,
    Goal,
    Mission,
    Odometry,
    Scan,
    Status,
    Truth,
)


class Viewer:
    """Makes of the messages of a run, in order of their log times, what viewers draw. The same messages make
    the same bytes.

    Poses are in the world: dead reckoning from the initial poses of the scenario, as in reports; ground truth
    beside them where there is any. Every time in what it makes is a log time. `epoch_ns` is the start of a
    run in which nobody says the fault plan: in virtual time that of the scenario holds.
    """

    def __init__(self, scenario: Scenario, epoch_ns: Time | None = None) -> None:
        self._scenario = scenario
        self._robots = {robot.id: RobotView(robot, scenario.model_of(robot)) for robot in scenario.robots}
        self._narrator = Narrator(None if epoch_ns is None else plan_of(scenario, epoch_ns))
        self._lifetime = from_seconds(topics.topic(topics.FORMATION_STATE).stale_after_s)
        self._tick_due: Time | None = None
        self._state_due: Time = 0
        self._again_due: Time = 0
        self._shown: object = None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All channels that it may draw on."""
        return channels_of(self._scenario)

    def wants(self, topic: str) -> bool:
        """Whether messages of a topic matter. Scans do as the agents pass them on, not as the drivers give
        them; orders as they are given to drives, not as vehicles of the simulator carry them out."""
        try:
            row = topics.topic(topic)
        except MessageError:
            return False
        about = topic.split("/")[1] if "{id}" in row.pattern else ""
        known = about in self._robots or not about
        inner = row.pattern.startswith("sim/{id}/") or (row.type is Scan and row.network != "fleet")
        return row.type in _WANTED and known and not inner

    def frame_of(self, odometry: Odometry) -> Pose | None:
        """Where the frame of an odometry that was seen is in the world; None where nobody knows."""
        return self._robots[odometry.source].frame_of(odometry)

    def reference_of(self, state: FormationState) -> Pose:
        """Where the desired formation's frame is in the world."""
        origin = self._robots[state.frame].origin if state.frame in self._robots else Pose(0.0, 0.0, 0.0)
        return origin.compose(Pose(*state.reference))

    def begin(self) -> None:
        """Tell all anew that has not changed: whoever looks, looks from here on."""
        self._tick_due, self._again_due = None, 0
        for robot in self._robots.values():
            robot.trail_grown, robot.trail_due = robot.believed is not None, 0

    def see(self, topic: str, message: Message, log_time_ns: Time) -> Sequence[Drawn]:
        """What a message of a topic that it `wants` gives to draw; nothing where another node sent it than
        may send on that topic."""
        if not topics.may_send(topic, message.source):
            return ()
        drawn = [*self._take(message, log_time_ns)]
        drawn += self._told(self._narrator.hear(message), log_time_ns)
        if self._tick_due is None or log_time_ns >= self._tick_due:
            self._tick_due = log_time_ns + TICK
            drawn += self._tick(log_time_ns)
        return drawn

    def _take(self, message: Message, time: Time) -> Iterable[Drawn]:
        """Remember what a message says; what it gives to draw at once."""
        match message:
            case Odometry():
                self._robots[message.source].on_odometry(message, time)
            case Drive():
                self._robots[message.source].on_drive(message, time)
            case Scan():
                return self._on_scan(message, self._robots[message.source], time)
            case Status():
                self._robots[message.source].on_status(message, time)
            case FormationState():
                return self._on_state(message, time)
            case Truth():
                self._on_truth(message, time)
            case Mission():
                self._on_mission(message)
        return ()

    def _on_mission(self, mission: Mission) -> None:
        for seat in mission.seats:
            if seat.id in self._robots:
                self._robots[seat.id].trust(seat.frame_id)

    def _on_truth(self, truth: Truth, time: Time) -> None:
        poses, clearances = unpack_floats(truth.poses, 3), unpack_floats(truth.clearances)
        for robot, pose, clearance in zip(truth.robots, poses.tolist(), clearances.tolist(), strict=False):
            if robot in self._robots:
                self._robots[robot].on_truth(Pose(*pose), clearance, time)

    def _on_scan(self, scan: Scan, robot: RobotView, time: Time) -> Iterator[Drawn]:
        robot.on_scan(scan)
        if time < robot.scan_due:
            return
        robot.scan_due = time + SCAN_GAP
        if (fan := laser_scan(robot.name, scan, time)) is not None:
            yield Drawn(robot.scan, fan, time)
        yield Drawn(robot.points, point_cloud(robot.name, scan, time), time)

    def _on_state(self, state: FormationState, time: Time) -> Iterator[Drawn]:
        for report in state.roster:
            if report.id in self._robots:
                self._robots[report.id].on_report(report, time)
        if time < self._state_due:
            return
        self._state_due = time + STATE_GAP
        desired, actual = self._desired(state), self._actual(state)
        if desired or actual:
            yield Drawn(FORMATION, scene.formation(desired, actual, self._lifetime, time), time)
        yield from self._errors(state, time)

    def _errors(self, state: FormationState, time: Time) -> Iterator[Drawn]:
        """The numbers of a state."""
        numbers = FormationScalars(
            phase=state.phase,
            rate=state.rate,
            task_time_s=state.task_time_s,
            robots=len(state.chain),
            waited_for=len(state.waits_for),
        )
        if state.errors:
            errors = unpack_floats(state.errors, 6)
            numbers.position_m, numbers.orientation_rad, numbers.distance_m, numbers.angle_rad = largest(
                errors
            )
            for j, row in enumerate(errors.tolist()[: len(self._robots) - 2]):
                triangle = TriangleScalars(" ".join(state.chain[j : j + 3]), *row)
                yield Drawn(triangle_scalars_key(j + 1), encode(triangle), time)
        yield Drawn(FORMATION_SCALARS, encode(numbers), time)

    def _desired(self, state: FormationState) -> list[Point]:
        """Where the control points of the chain are to be, in the world; nothing where nobody says."""
        places = unpack_floats(state.points, 2).tolist() if state.points else self._scenario.formation.points
        if len(places) != len(state.chain) or len(places) < 3:
            return []
        frame = self.reference_of(state)
        turned = (frame.rotate(*place) for place in places)
        return [(frame.x + x, frame.y + y) for x, y in turned]

    def _actual(self, state: FormationState) -> list[Point]:
        """Where they are believed to be; nothing where one is not known."""
        robots = [self._robots[name] for name in state.chain if name in self._robots]
        points = [point for robot in robots if (point := robot.control_point) is not None]
        return points if len(points) == len(state.chain) >= 3 else []

    def _tick(self, time: Time) -> Iterator[Drawn]:
        """What has its own pace."""
        yield from self._told(self._narrator.due(time), time)
        robots = self._robots.values()
        transforms = [one for robot in robots for one in robot.transforms(time)]
        if transforms:
            yield Drawn(TF, wire(FrameTransforms(transforms=transforms)), time)
        yield from self._scenes(time)
        for robot in robots:
            if robot.news:
                robot.news = False
                yield Drawn(robot.numbers, encode(robot.scalars(time)), time)
            if robot.trail_grown and time >= robot.trail_due:
                robot.trail_grown, robot.trail_due = False, time + TRAIL_PERIOD
                yield Drawn(robot.trajectory, robot.trail.message(time), time)

    def _scenes(self, time: Time) -> Iterator[Drawn]:
        """Bodies where something about them has changed, and all that stands now and then."""
        bearings = {
            robot.name: robot.bearing for robot in self._robots.values() if robot.believed is not None
        }
        ghosts = [robot.name for robot in self._robots.values() if robot.true is not None]
        shown = [(name, bearing.words, bearing.halo) for name, bearing in bearings.items()], ghosts
        again = time >= self._again_due
        if again or shown != self._shown:
            self._shown = shown
            yield Drawn(ROBOTS, scene.robots(self._scenario, bearings, ghosts, time), time)
        if again:
            self._again_due = time + AGAIN
            stands = scene.obstacles(self._scenario.world.obstacles, self._scenario.guard.fence, time)
            yield Drawn(OBSTACLES, stands, time)

    def _told(self, lines: Iterable[Line], time: Time) -> Iterator[Drawn]:
        for name, (what, weight) in lines:
            line = Log(timestamp=timestamp(time), level=_LEVELS[weight], message=what, name=name)
            yield Drawn(LOG, wire(line), time)
