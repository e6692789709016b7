"""The simulator as a node: orders to drives in; encoder counts, scans and ground truth out."""

import math
from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np
from msgspec.structs import replace

from maniple.core import edges, topics
from maniple.core.geometry import Floats, wrap
from maniple.core.messages import Drive, ExternalPose, Motion, Scan, Truth, pack_floats
from maniple.core.node import Outgoing, Received
from maniple.core.scenario.types import PoseXY, RangeFinder, Robot, Scenario
from maniple.core.streams import stream
from maniple.core.time import Duration, Time, period
from simulator.noise import RangeNoise
from simulator.physics import Physics
from simulator.range_finder import Fan, sweep
from simulator.world import Complexes, Scene, outlines

_RAYS_RAD = math.radians(1.0)

_SIGHT = (0.02, 0.02, 0.02)
"""Standard deviation of what is seen of a robot's pose: m, m, rad."""


class Simulator:
    """Stands for the physical world of a resolved scenario, with those of its robots that have a body here.

    A robot that is presented as a vehicle takes its orders from that vehicle and reports to it, on the topics
    `sim/ID/*`, with its true pose and velocities: what a vehicle makes of them is its own affair.

    Raises:
        ScenarioError: a model's theta is no stable drive.
    """

    name = "simulator"

    def __init__(self, scenario: Scenario) -> None:
        scenario = replace(scenario, robots=edges.simulated(scenario))
        rates, robots = scenario.rates, scenario.robots
        self._robots = tuple(robot.id for robot in robots)
        self._presented = tuple(i for i, robot in enumerate(robots) if edges.has_vehicle(robot))
        self._watched = tuple(
            (i, topics.external_pose(robot.id), stream(scenario.seed, f"pose/{robot.id}"))
            for i, robot in enumerate(robots)
            if robot.presents == "mavlink" and robot.mavlink.external_pose
        )
        self.timers: Mapping[str, Duration] = {
            "motion": period(rates.motion_hz),
            "scan": period(rates.scan_hz),
            "truth": period(rates.truth_hz),
            **({"pose": period(topics.topic(self._watched[0][1]).rate_hz)} if self._watched else {}),
        }
        self._index = {
            (topics.simulated_drive if edges.has_vehicle(robot) else topics.drive)(robot.id): i
            for i, robot in enumerate(robots)
        }
        self.subscriptions = frozenset(self._index) | {topics.HOST_REFUSED}
        self._motion_topics = tuple(
            (topics.simulated_motion if edges.has_vehicle(robot) else topics.motion)(robot.id)
            for robot in robots
        )
        self._physics = Physics(scenario)
        models = [scenario.model_of(robot) for robot in robots]
        self._scene = Scene(scenario.world.obstacles, outlines(models))
        sensors = sorted({robot.sensor for robot in robots if _scan_topic(robot)})
        self._banks = tuple(_SensorBank(scenario, sensor) for sensor in sensors)

    def on_start(self, now: Time) -> Sequence[Outgoing]:
        """The physical world begins at `now`."""
        self._physics.start(now)
        return ()

    def on_message(self, message: Received, now: Time) -> Sequence[Outgoing]:
        """Pass an order to a drive."""
        order = message.message
        if isinstance(order, Drive):
            self._physics.command(self._index[message.topic], order, now)
        return ()

    def on_timer(self, timer: str, now: Time) -> Sequence[Outgoing]:
        """Read the encoders, sweep the range finders, look where robots are, or tell the truth."""
        self._physics.advance(now)
        if timer == "motion":
            return self._motions()
        if timer == "pose":
            return self._sightings()
        return self._scans() if timer == "scan" else (self._truth(),)

    def on_stop(self, now: Time) -> Sequence[Outgoing]:
        """The truth to the end."""
        self._physics.advance(now)
        return (self._truth(),)

    def _motions(self) -> list[Outgoing]:
        physics = self._physics
        motions = [
            Outgoing(
                topic,
                Motion(ticks=ticks, applied=(u, w), applied_v_mps=v, state=state, controllable=True),
            )
            for topic, ticks, ((u, w, v), state) in zip(
                self._motion_topics, physics.ticks(), physics.drives(), strict=True
            )
        ]
        if self._presented:
            poses, twists = physics.poses().tolist(), physics.twists().tolist()
            for i in self._presented:
                topic, motion = motions[i]
                motions[i] = Outgoing(topic, replace(motion, pose=tuple(poses[i]), twist=tuple(twists[i])))
        return motions

    def _sightings(self) -> list[Outgoing]:
        """What somebody who sees the robots says of where they are, as motion capture would."""
        poses = self._physics.poses()
        seen = []
        for i, topic, generator in self._watched:
            error = generator.standard_normal(3) * _SIGHT
            x, y, psi = (poses[i] + error).tolist()
            seen.append(Outgoing(topic, ExternalPose(pose=(x, y, wrap(psi)), sigma=_SIGHT)))
        return seen

    def _scans(self) -> list[Outgoing]:
        position, heading = self._physics.position(), self._physics.heading()
        self._scene.place(self._physics.centres(), heading)
        scans = [scan for bank in self._banks for scan in bank.scans(position, heading, self._scene)]
        if len(self._banks) > 1:
            scans.sort(key=lambda scan: scan[0])
        return [outgoing for _, outgoing in scans]

    def _truth(self) -> Outgoing:
        clearances, collisions, contacts = self._physics.contacts()
        sideways = self._physics.sideways()
        truth = Truth(
            robots=self._robots,
            poses=pack_floats(self._physics.poses()),
            velocities=pack_floats(self._physics.velocities()),
            clearances=pack_floats(clearances),
            collisions=collisions,
            contacts=contacts,
            sideways=b"" if sideways is None else pack_floats(sideways),
        )
        return Outgoing(topics.TRUTH, truth)


class ScanHeader(TypedDict):
    """The fields of a `Scan` that never change."""

    first_angle_rad: float
    increment_rad: float
    range_min_m: float
    range_max_m: float
    mount: tuple[float, float, float]
    beams: bytes
    cone_rad: float


class _SensorBank:
    """The range finders of one type: each of its eyes, the laser or the transducers, sweeps a fan.

    The cone of a transducer is sampled by a fan of rays, of which the shortest counts.
    """

    def __init__(self, scenario: Scenario, sensor: str) -> None:
        kind = scenario.sensors[sensor]
        carriers = [
            (i, robot)
            for i, robot in enumerate(scenario.robots)
            if robot.sensor == sensor and _scan_topic(robot)
        ]
        eyes = [kind.transducers or (scenario.model_of(robot).sensor_mount,) for _, robot in carriers]
        self._rows = np.array([i for i, _ in carriers])
        self._fan = Fan(cone_of(kind) if kind.transducers else kind)
        self._is_array = bool(kind.transducers)
        self._noise = RangeNoise(scenario.seed, [robot.id for _, robot in carriers], kind)
        self._offset = np.array([[complex(x, y) for x, y, _ in places] for places in eyes])
        self._turn = np.array([[turn for *_, turn in places] for places in eyes])
        self._own = np.repeat(self._rows, self._turn.shape[1])
        self._topics = tuple(_scan_topic(robot) for _, robot in carriers)
        self._headers = tuple(_header(kind, places[0]) for places in eyes)

    def scans(self, position: Complexes, heading: Floats, scene: Scene) -> list[tuple[int, Outgoing]]:
        """One sweep of each, from robots at `position` (m) and `heading` (rad), shape (n,), with the index
        of the robot."""
        heading = heading[self._rows, None]
        origin = position[self._rows, None] + self._offset * np.exp(1j * heading)
        ranges = sweep(self._fan, origin.ravel(), (heading + self._turn).ravel(), self._own, scene)
        if self._is_array:
            ranges = ranges.min(axis=1).reshape(self._turn.shape)
        readings = self._noise.apply(ranges).astype("<f4")
        return [
            (row, Outgoing(topic, Scan(ranges=reading.tobytes(), **header)))
            for row, topic, header, reading in zip(
                self._rows.tolist(), self._topics, self._headers, readings, strict=True
            )
        ]


def _scan_topic(robot: Robot) -> str:
    """Where the scans of a simulated range finder go; empty where something else brings the robot's scans."""
    if edges.has_vehicle(robot) and robot.scans != edges.SIMULATOR:
        return topics.simulated_scan(robot.id)
    return "" if edges.has_scanner(robot) else topics.scan(robot.id)


def cone_of(kind: RangeFinder) -> RangeFinder:
    """The fan of rays that samples the cone of a transducer, at most a degree apart."""
    gaps = max(math.ceil(kind.cone_rad / _RAYS_RAD), 1)
    return RangeFinder(
        beams=gaps + 1 if kind.cone_rad else 1,
        first_angle_rad=-0.5 * kind.cone_rad,
        increment_rad=kind.cone_rad / gaps or 1.0,
        range_max_m=kind.range_max_m,
    )


def _header(kind: RangeFinder, mount: PoseXY) -> ScanHeader:
    """The limits are what float32 makes of them, so that "nothing seen" equals `range_max_m` exactly."""
    return ScanHeader(
        first_angle_rad=kind.first_angle_rad,
        increment_rad=kind.increment_rad,
        range_min_m=kind.range_min_m,
        range_max_m=float(np.float32(kind.range_max_m)),
        mount=(0.0, 0.0, 0.0) if kind.transducers else mount,
        beams=pack_floats(kind.transducers) if kind.transducers else b"",
        cone_rad=kind.cone_rad,
    )
