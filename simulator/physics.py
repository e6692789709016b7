"""The world in motion: drives, velocity dynamics, poses and contacts, advanced in whole steps.

Step k is due at start + k * period. Nothing needs it earlier than the next reading or report, so steps are
taken when somebody asks, as many at once as are due; what the drives were told meanwhile takes effect at
its own step. The result is that of a timer at the step rate.
"""

from typing import NamedTuple

import numpy as np

from maniple.core.geometry import Floats, wrap_array
from maniple.core.messages import Drive, DriverState
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, period, to_seconds
from simulator.collisions import Collisions
from simulator.drives import Drives
from simulator.dynamics import VelocityDynamics, integrate
from simulator.encoders import Encoders
from simulator.world import Complexes, outlines, shapes_of

_BATCH = 25
"""Most steps that are taken at once."""


class State(NamedTuple):
    """The vehicles between two steps."""

    velocity: Floats
    """Rows u (m/s), w (rad/s), shape (2, n)."""
    drive: Floats
    """What the references of the drives add to the velocities in one step, likewise."""
    braking: tuple[int, ...]
    """Robots whose drives brake and that still move."""
    travel: Floats
    """Rows path length (m), unwrapped heading (rad), shape (2, n)."""
    position: Complexes
    """x + iy, m, shape (n,)."""


class Course(NamedTuple):
    """What some steps do to everything but the poses."""

    velocities: Floats
    """At the start and after each of k steps, rows u, w, shape (k + 1, 2, n)."""
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
        self._dynamics = VelocityDynamics([m.theta for m in models], self._step_s)
        self._input_gain = tuple((u, w) for u, w in self._dynamics.input_gain.T.tolist())
        self._brakes = tuple((m.brake_mps2 * self._step_s, m.w_accel_radps2 * self._step_s) for m in models)
        self._drives = Drives(models, self._period)

        pose = np.array([robot.pose for robot in robots], dtype=np.float64).T
        still = np.zeros((2, len(robots)))
        travel = np.stack([np.zeros(len(robots)), pose[2]])
        position = pose[0] + 1j * pose[1]
        self._state = State(still, still, (), travel, position)
        self._encoders = Encoders(models, pose[2])
        half = outlines(models)
        self._arm = np.abs(half)
        speeds = [
            m.u_max_mps + m.w_max_radps * arm for m, arm in zip(models, self._arm.tolist(), strict=True)
        ]
        stride = max(speeds) * self._step_s
        self._collisions = Collisions(
            self.robots, half, shapes_of(scenario.world.obstacles), position, pose[2], stride
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
                self._accept(course, travels[-1], positions[-1])
                self._collisions.record(positions[1:], travels[1:, 1], moved)
            else:
                for _ in range(steps):
                    self._careful_step()

    def position(self) -> Complexes:
        """x + iy of the middle of each axle, m, shape (n,)."""
        return self._state.position

    def heading(self) -> Floats:
        """Unwrapped, rad, shape (n,)."""
        return np.asarray(self._state.travel[1])

    def poses(self) -> Floats:
        """(x m, y m, heading rad in (-pi, pi]) of the middle of each axle, shape (n, 3)."""
        position = self._state.position
        return np.stack([position.real, position.imag, wrap_array(self._state.travel[1])], axis=1)

    def velocities(self) -> Floats:
        """(u m/s, w rad/s), shape (n, 2)."""
        return np.asarray(self._state.velocity.T)

    def ticks(self) -> list[tuple[int, int]]:
        """Encoder counts, left and right, of each robot."""
        return self._encoders.ticks(self._state.travel)

    def drives(self) -> list[tuple[tuple[float, float], DriverState]]:
        """What each drive applies, (u m/s, w rad/s), and where it is in its life cycle."""
        us, ws = self._state.velocity.tolist()
        drives = self._drives
        return [(drives.reference(i) or (us[i], ws[i]), drives.state(i)) for i in range(len(us))]

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
                _, robot, u, w, brakes = changes[used]
                u_gain, w_gain = self._input_gain[robot]
                drive[0, robot] = u_gain * u
                drive[1, robot] = w_gain * w
                if braking or brakes:
                    braking = tuple(i for i in braking if i != robot) + ((robot,) if brakes else ())
                used += 1
                due = changes[used].tick if used < len(changes) else self._tick + steps + 1
            self._dynamics.step(velocities[k], drive, velocities[k + 1])
            if braking:
                braking = tuple(i for i in braking if self._brake(i, velocities[k], velocities[k + 1]))
        return Course(velocities, drive, braking, used)

    def _brake(self, robot: int, before: Floats, after: Floats) -> bool:
        """Let a robot's velocities go towards zero at a constant rate; whether it still moves."""
        u_step, w_step = self._brakes[robot]
        u, w = float(before[0, robot]), float(before[1, robot])
        after[0, robot] = u = max(u - u_step, 0.0) if u > 0.0 else min(u + u_step, 0.0)
        after[1, robot] = w = max(w - w_step, 0.0) if w > 0.0 else min(w + w_step, 0.0)
        return u != 0.0 or w != 0.0

    def _outline_motion(self, arcs: Floats) -> Floats:
        """How far (m) any point of each outline moves at most along arcs of shape (k, 2, n)."""
        path, turn = np.add.reduce(np.abs(arcs), axis=0)
        return np.asarray(path + self._arm * turn)

    def _accept(self, course: Course, travel: Floats, position: Complexes) -> None:
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
                position[rows] = before.position[rows]
        self._accept(course, travel, position)
        self._collisions.record(position[None], travel[None, 1], moved)

    def _refused(self, position: Complexes, heading: Floats) -> set[int]:
        """Robots that would overlap something there; notes the contacts."""
        pairs = self._collisions.overlaps(position, heading)
        for pair in pairs:
            self._collisions.stop(pair)
        return {i for pair in pairs for i in pair if i < len(self.robots)}

    def _stands(self) -> bool:
        return not (self._state.velocity.any() or self._state.drive.any())

    def _quiet_until(self, last: int) -> int:
        """The last step up to `last` before the drives are told something else."""
        changes = self._drives.changes
        return min(last, changes[0].tick - 1) if changes else last
