"""Ground truth against the desired formation, from what was said alone.

`formation/state` tells the chain, where its control points are to be and in which frame: whatever task, goal,
lost robot or new order led to it. Between two states that differ only by motion the desired formation is
interpolated.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby, zip_longest
from typing import NamedTuple

import numpy as np

from central_controller.triangle import f
from maniple.core.geometry import Floats, Pose, wrap_array
from maniple.core.messages import FormationState, Truth, unpack_floats
from maniple.core.scenario.types import Robot, Scenario
from maniple.core.time import Time
from maniple.report.samples import Stamps


class Ground(NamedTuple):
    """Where the robots of a scenario, in its order, really are. NaN for one that no message knows."""

    stamps: Stamps
    """(k,), ns, rising."""
    poses: Floats
    """(k, n, 3): middle of the axle in the world, m, m, rad."""
    velocities: Floats
    """(k, n, 3): u, w and v (m/s, rad/s, m/s to the left); v is 0 where no robot can go sideways."""
    clearances: Floats
    """(k, n), m."""


class Stretch(NamedTuple):
    """Triangles over a time in which the chain stays the same and where it is to be changes steadily."""

    chain: tuple[str, ...]
    stamps: Stamps
    """(k,), ns, rising."""
    desired: Floats
    """(k, m, 6): q of the m triangles as they are to be, in the frame that the controller works in."""
    errors: Floats
    """(k, m, 6): desired minus actual; angles wrapped. The shape angle is signed, whatever the controller
    uses: a mirrored triangle is an error. NaN for a triangle of which not all three are known; at every
    moment one is."""


def ground_of(truths: Sequence[Truth], scenario: Scenario) -> Ground:
    """Messages, in the order of their stamps, as arrays."""
    ids = tuple(robot.id for robot in scenario.robots)
    poses = np.full((len(truths), len(ids), 3), np.nan)
    velocities = np.full((len(truths), len(ids), 3), np.nan)
    clearances = np.full((len(truths), len(ids)), np.nan)
    for row, truth in enumerate(truths):
        here = [index for index, name in enumerate(ids) if name in truth.robots]
        there = here if truth.robots == ids else [truth.robots.index(ids[index]) for index in here]
        poses[row, here] = unpack_floats(truth.poses, 3)[there]
        velocities[row, here, :2] = unpack_floats(truth.velocities, 2)[there]
        velocities[row, here, 2] = unpack_floats(truth.sideways)[there] if truth.sideways else 0.0
        clearances[row, here] = unpack_floats(truth.clearances)[there]
    stamps = np.array([truth.stamp_ns for truth in truths], dtype=np.int64)
    return Ground(stamps, poses, velocities, clearances)


def control_points(poses: Floats, scenario: Scenario) -> Floats:
    """Control points (..., n, 2) of the scenario's robots at `poses` (..., n, 3)."""
    arms = np.array([robot.control_point_m for robot in scenario.robots])
    heading = np.stack([np.cos(poses[..., 2]), np.sin(poses[..., 2])], axis=-1)
    return np.asarray(poses[..., :2] + arms[:, None] * heading)


def origin_of(frame: str, scenario: Scenario) -> Pose:
    """Where a frame that the controller works in lies in the world: a robot's own begins at its initial
    pose."""
    poses = {robot.id: robot.pose for robot in scenario.robots}
    return Pose(*(poses.get(frame) or (0.0, 0.0, 0.0)))


def without_truth(ground: Ground, scenario: Scenario) -> list[str]:
    """The robots that no ground truth tells of."""
    known = np.asarray(np.isfinite(ground.poses[..., 0]).any(axis=0))
    return [robot.id for robot, told in zip(scenario.robots, known, strict=True) if not told]


def stretches(ground: Ground, states: Sequence[FormationState], scenario: Scenario) -> list[Stretch]:
    """The errors of every triangle at each ground truth from the first of `states`, which are in the order
    of their stamps, on. Times without a triangle of three robots that are known are left out."""
    groups = [list(group) for _, group in groupby(states, _kind)]
    found = []
    for group, following in zip_longest(groups, groups[1:]):
        end = following[0].stamp_ns if following else np.iinfo(np.int64).max
        rows = np.flatnonzero((ground.stamps >= group[0].stamp_ns) & (ground.stamps < end))
        if len(rows) and len(group[0].chain) >= 3:
            steady = following and _way(following[0]) == _way(group[0])
            found.append(_stretch(ground, rows, group, following[0] if steady else group[-1], scenario))
    return [stretch for stretch in found if stretch is not None]


def desired_points(
    group: Sequence[FormationState], after: FormationState, stamps: Stamps, scenario: Scenario
) -> Floats | None:
    """Control points (k, c, 2) of the chain as desired, interpolated between the states of a group, in the
    frame of their `reference`; None where neither they nor the scenario say. `after` is the last state, or
    the one after that if only the chain is another."""
    poses = unwrapped(np.array([state.reference for state in (*group, after)]))
    told = group[0].points or np.array(scenario.formation.points, dtype="<f4").tobytes()
    places = np.array([unpack_floats(state.points or told, 2) for state in group])
    if places.shape[1] != len(group[0].chain):
        return None
    times = np.array([state.stamp_ns for state in group], dtype=np.int64)
    pose = _between(np.append(times, after.stamp_ns), poses, stamps)
    place = _between(times, places, stamps)
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = place[..., 0], place[..., 1]
    return np.stack([pose[:, :1] + c * x - s * y, pose[:, 1:2] + s * x + c * y], axis=-1)


def drift(
    ground: Ground,
    odometry: Mapping[str, tuple[Stamps, Floats]],
    chain: Sequence[str],
    scenario: Scenario,
    end: Time,
    in_world: Collection[str] = (),
) -> float | None:
    """Largest distance (m) at `end`, over the robots of the chain, from where the control point is to where
    its odometry puts it; of a robot not heard that long, when it was heard last.

    `odometry` has (stamps, (k, 3) poses) of each robot, in its own frame, or in the world where it is one of
    `in_world`. None where nothing can be compared.
    """
    found = []
    for index, robot in enumerate(scenario.robots):
        stamps, own = odometry.get(robot.id, (np.empty(0, dtype=np.int64), np.empty((0, 3))))
        truth = ground.poses[:, index]
        known = np.isfinite(truth[:, 0])
        if robot.id not in chain or not len(stamps) or not known.any():
            continue
        at = np.array([min(end, int(stamps[-1]), int(ground.stamps[known][-1]))], dtype=np.int64)
        origin = frame_of_odometry(robot, robot.id in in_world)
        reckoned = estimated_poses(origin, _between(stamps, unwrapped(own), at))
        actual = _between(ground.stamps[known], unwrapped(truth[known]), at)
        both = np.stack([reckoned[0], actual[0]])
        ahead = robot.control_point_m * np.stack([np.cos(both[:, 2]), np.sin(both[:, 2])], axis=-1)
        found.append(float(np.hypot(*np.subtract(*(both[:, :2] + ahead)))))
    return max(found, default=None)


def frame_of_odometry(robot: Robot, in_world: bool) -> Pose:
    """Where the frame of a robot's odometry lies in the world, of a resolved scenario: at its initial pose,
    unless the odometry is given `in_world`."""
    return Pose(0.0, 0.0, 0.0) if in_world or robot.pose is None else Pose(*robot.pose)


def estimated_poses(origin: Pose, own: Floats) -> Floats:
    """Poses (k, 3) in the world of a robot at `own` (k, 3) in its frame, which lies at `origin`."""
    c, s = np.cos(origin.psi), np.sin(origin.psi)
    x, y, psi = own.T
    return np.stack([origin.x + c * x - s * y, origin.y + s * x + c * y, origin.psi + psi], axis=-1)


def unwrapped(poses: Floats) -> Floats:
    """Poses (k, 3) whose headings do not jump."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def differences(desired: Floats, actual: Floats) -> Floats:
    """Desired minus actual q (..., 6), angles wrapped."""
    errors = desired - actual
    errors[..., 2::3] = wrap_array(errors[..., 2::3])
    return errors


def _kind(state: FormationState) -> tuple[object, ...]:
    """What two states share between which the desired formation moves and deforms steadily."""
    return _way(state), state.chain, len(state.points)


def _way(state: FormationState) -> tuple[object, ...]:
    """What two states share between which the reference does not jump."""
    return state.frame, state.leg, state.goal


def _stretch(
    ground: Ground, rows: Stamps, group: Sequence[FormationState], after: FormationState, scenario: Scenario
) -> Stretch | None:
    """The errors while the states of one group hold."""
    index = {robot.id: place for place, robot in enumerate(scenario.robots)}
    chain = group[0].chain
    if any(name not in index for name in chain):
        return None
    origin = origin_of(group[0].frame, scenario)
    actual = control_points(ground.poses[rows], scenario)[:, [index[name] for name in chain]]
    told = np.asarray(np.isfinite(actual).all(axis=-1))
    known = (told[:, :-2] & told[:, 1:-1] & told[:, 2:]).any(axis=1)
    rows, actual = rows[known], actual[known]
    desired = desired_points(group, after, ground.stamps[rows], scenario)
    if desired is None or not len(rows):
        return None
    c, s = np.cos(origin.psi), np.sin(origin.psi)
    actual = (actual - origin[:2]) @ np.array([[c, -s], [s, c]])
    wanted = f(_triangles(desired))
    return Stretch(chain, ground.stamps[rows], wanted, differences(wanted, f(_triangles(actual))))


def _triangles(points: Floats) -> Floats:
    """Points (k, c, 2) of a chain as triangles (k, c - 2, 3, 2)."""
    return np.stack([points[:, :-2], points[:, 1:-1], points[:, 2:]], axis=2)


def _between(times: Stamps, values: Floats, at: Stamps) -> Floats:
    """Rows of `values` at `times` (rising), interpolated at `at`; before the first and after the last as
    there."""
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    span = np.maximum(times[after] - times[before], 1)
    share = np.clip((at - times[before]) / span, 0.0, 1.0).reshape(-1, *([1] * (values.ndim - 1)))
    return np.asarray(values[before] + share * (values[after] - values[before]))
