"""The world in motion: drives, velocity dynamics, poses and contacts, advanced in whole steps.

Step k is due at start + k * period. Nothing needs it earlier than the next reading or report, so steps are
taken when somebody asks, as many at once as are due; what the drives were told meanwhile takes effect at
its own step. The result is that of a timer at the step rate.
"""

from typing import NamedTuple

import numpy as np

from maniple.control.limits import Velocity, curvature_max
from maniple.core.geometry import Floats, wrap_array
from maniple.core.messages import Drive, DriverState
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, period, to_seconds
from simulator.collisions import Collisions
from simulator.drives import Drives
from simulator.dynamics import VelocityDynamics, integrate
from simulator.encoders import Encoders
from simulator.world import Complexes, centres, outlines, shapes_of

_BATCH = 25
"""Most steps that are taken at once."""


class State(NamedTuple):
    """The vehicles between two steps."""

    velocity: Floats
    """Rows u (m/s), w (rad/s) and, where some robot moves sideways, v (m/s), shape (2 or 3, n)."""
    drive: Floats
    """What the references of the drives add to the velocities in one step, likewise."""
    braking: tuple[int, ...]
    """Robots whose drives brake and that still move."""
    travel: Floats
    """Rows way ahead (m), unwrapped heading (rad) and, likewise, way to the left (m)."""
    position: Complexes
    """x + iy, m, shape (n,)."""


class Course(NamedTuple):
    """What some steps do to everything but the poses."""

    velocities: Floats
    """At the start and after each of k steps, rows as in `State`, shape (k + 1, 2 or 3, n)."""
    drive: Floats
    """See `State`, after the last step; `braking` likewise."""
    braking: tuple[int, ...]
    used: int
    """How many changes of the drives took effect."""


class Physics:
    """All robots of a resolved scenario.

    Raises:
        ScenarioError: a model's theta is no stable drive.
    """

    def __init__(self, scenario: Scenario) -> None:
        robots = scenario.robots
        models = [scenario.model_of(robot) for robot in robots]
        self.robots = tuple(robot.id for robot in robots)
        self._period = period(scenario.rates.physics_hz)
        self._step_s = to_seconds(self._period)
        self._start: Time = 0
        self._tick = 0
        self._sideways = any(m.drive == "omnidirectional" for m in models)
        self._dynamics = VelocityDynamics([m.theta for m in models], self._step_s, self._sideways)
        self._input_gain: list[list[float]] = self._dynamics.input_gain.T.tolist()
        self._cars = np.flatnonzero([m.drive == "car" for m in models])
        self._curvature = np.array([curvature_max(models[i]) for i in self._cars])
        self._brakes = tuple(
            (m.brake_mps2 * self._step_s, m.w_accel_radps2 * self._step_s, m.brake_mps2 * self._step_s)
            for m in models
        )
        self._drives = Drives(models, self._period)

        pose = np.array([robot.pose for robot in robots], dtype=np.float64).T
        still = np.zeros((3 if self._sideways else 2, len(robots)))
        travel = still.copy()
        travel[1] = pose[2]
        position = pose[0] + 1j * pose[1]
        self._state = State(still, still, (), travel, position)
        self._encoders = Encoders(models, pose[2], scenario.seed, self.robots)
        half = outlines(models)
        self._offset = np.array([m.body_offset_m for m in models])
        self._arm = np.abs(half) + np.abs(self._offset)
        speeds = [
            m.u_max_mps + (m.v_max_mps or 0.0) + m.w_max_radps * arm
            for m, arm in zip(models, self._arm.tolist(), strict=True)
        ]
        stride = max(speeds) * self._step_s
        self._collisions = Collisions(
            self.robots, half, shapes_of(scenario.world.obstacles), self.centres(), pose[2], stride
        )

    def start(self, now: Time) -> None:
        """Time begins."""
        self._start = now

    def command(self, robot: int, order: Drive, now: Time) -> None:
        """Give a drive an order, to be followed from the first step that is due after `now`."""
        self._drives.command(robot, order, now - self._start)

    def advance(self, now: Time) -> None:
        """Take all steps that are due up to `now`."""
        elapsed = now - self._start
        self._drives.expire(elapsed)
        last = elapsed // self._period
        while self._tick < last:
            steps = min(last - self._tick, _BATCH)
            if steps == _BATCH and self._stands() and (quiet := self._quiet_until(last)) > self._tick:
                self._tick = quiet
                continue
            course = self._roll(steps)
            arcs, travels, positions = integrate(
                course.velocities, self._state.travel, self._state.position, self._step_s
            )
            moved = self._outline_motion(arcs)
            if self._collisions.clear(moved):
                self._accept(course, arcs, travels[-1], positions[-1])
                heading = travels[1:, 1]
                self._collisions.record(centres(positions[1:], heading, self._offset), heading, moved)
            else:
                for _ in range(steps):
                    self._careful_step()

    def position(self) -> Complexes:
        """x + iy of the middle of each axle, m, shape (n,)."""
        return self._state.position

    def centres(self) -> Complexes:
        """x + iy of the middle of each body, m, shape (n,)."""
        return centres(self._state.position, self._state.travel[1], self._offset)

    def heading(self) -> Floats:
        """Unwrapped, rad, shape (n,)."""
        return np.asarray(self._state.travel[1])

    def poses(self) -> Floats:
        """(x m, y m, heading rad in (-pi, pi]) of the middle of each axle, shape (n, 3)."""
        position = self._state.position
        return np.stack([position.real, position.imag, wrap_array(self._state.travel[1])], axis=1)

    def velocities(self) -> Floats:
        """(u m/s, w rad/s), shape (n, 2)."""
        return np.asarray(self._state.velocity[:2].T)

    def twists(self) -> Floats:
        """(u m/s, w rad/s, v m/s), shape (n, 3)."""
        twists = np.zeros((len(self.robots), 3))
        twists[:, : len(self._state.velocity)] = self._state.velocity.T
        return twists

    def sideways(self) -> Floats | None:
        """v of each robot, m/s, shape (n,); None where none can."""
        return np.asarray(self._state.velocity[2]) if self._sideways else None

    def ticks(self) -> list[tuple[int, ...]]:
        """Encoder counts of each robot."""
        return self._encoders.ticks(self._state.travel)

    def drives(self) -> list[tuple[Velocity, DriverState]]:
        """What each drive applies, and where it is in its life cycle."""
        rows, drives = self._state.velocity.T.tolist(), self._drives
        return [(drives.reference(i) or Velocity(*row), drives.state(i)) for i, row in enumerate(rows)]

    def contacts(self) -> tuple[Floats, int, tuple[str, ...]]:
        """Least clearance (m) of each robot since the last call, onsets of contact so far, contacts now."""
        clearances, names = self._collisions.report()
        return clearances, self._collisions.count, names

    def _roll(self, steps: int) -> Course:
        """What the next steps do if nothing gets in the way."""
        velocity, drive, braking, _, _ = self._state
        velocities = np.empty((steps + 1, *velocity.shape))
        velocities[0] = velocity
        changes, used = self._drives.changes, 0
        due = changes[0].tick if changes else self._tick + steps + 1
        if due <= self._tick + steps:
            drive = drive.copy()
        for k in range(steps):
            tick = self._tick + k + 1
            while due <= tick:
                _, robot, wanted, brakes = changes[used]
                for row, gain in enumerate(self._input_gain[robot]):
                    drive[row, robot] = gain * wanted[row]
                if braking or brakes:
                    braking = tuple(i for i in braking if i != robot) + ((robot,) if brakes else ())
                used += 1
                due = changes[used].tick if used < len(changes) else self._tick + steps + 1
            self._dynamics.step(velocities[k], drive, velocities[k + 1])
            if braking:
                braking = tuple(i for i in braking if self._brake(i, velocities[k], velocities[k + 1]))
            if self._cars.size:
                self._steer(velocities[k + 1])
        return Course(velocities, drive, braking, used)

    def _brake(self, robot: int, before: Floats, after: Floats) -> bool:
        """Let a robot's velocities go towards zero at a constant rate; whether it still moves."""
        moves = False
        for row, step in enumerate(self._brakes[robot][: len(before)]):
            speed = float(before[row, robot])
            speed = max(speed - step, 0.0) if speed > 0.0 else min(speed + step, 0.0)
            after[row, robot] = speed
            moves = moves or speed != 0.0
        return moves

    def _steer(self, velocity: Floats) -> None:
        """Cars turn no tighter than their steering allows, and not at all where they stand."""
        most = self._curvature * np.abs(velocity[0, self._cars])
        velocity[1, self._cars] = np.clip(velocity[1, self._cars], -most, most)

    def _outline_motion(self, arcs: Floats) -> Floats:
        """How far (m) any point of each outline moves at most along arcs of shape (k, 2 or 3, n)."""
        ways = np.add.reduce(np.abs(arcs), axis=0)
        moved = ways[0] + self._arm * ways[1]
        return np.asarray(moved + ways[2] if self._sideways else moved)

    def _accept(self, course: Course, arcs: Floats, travel: Floats, position: Complexes) -> None:
        self._encoders.roll(arcs)
        self._state = State(course.velocities[-1], course.drive, course.braking, travel, position)
        self._tick += len(course.velocities) - 1
        if course.used:
            del self._drives.changes[: course.used]

    def _careful_step(self) -> None:
        """One step, which robots that it would make overlap something do not take: they stand."""
        course = self._roll(1)
        before = self._state
        arcs, travels, positions = integrate(course.velocities, before.travel, before.position, self._step_s)
        velocity, travel, position = course.velocities[1], travels[1], positions[1]
        moved = self._outline_motion(arcs)
        if not self._collisions.clear(moved):
            stopped: set[int] = set()
            while robots := self._refused(position, travel[1]) - stopped:
                stopped |= robots
                rows = sorted(robots)
                velocity[:, rows] = 0.0
                travel[:, rows] = before.travel[:, rows]
                arcs[0][:, rows] = 0.0
                position[rows] = before.position[rows]
        self._accept(course, arcs, travel, position)
        self._collisions.record(centres(position, travel[1], self._offset)[None], travel[None, 1], moved)

    def _refused(self, position: Complexes, heading: Floats) -> set[int]:
        """Robots that would overlap something there; notes the contacts."""
        pairs = self._collisions.overlaps(centres(position, heading, self._offset), heading)
        for pair in pairs:
            self._collisions.stop(pair)
        return {i for pair in pairs for i in pair if i < len(self.robots)}

    def _stands(self) -> bool:
        return not (self._state.velocity.any() or self._state.drive.any())

    def _quiet_until(self, last: int) -> int:
        """The last step up to `last` before the drives are told something else."""
        changes = self._drives.changes
        return min(last, changes[0].tick - 1) if changes else last
