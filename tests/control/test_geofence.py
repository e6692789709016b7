import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.cli.loading import robot_models
from maniple.control import guard
from maniple.control.geofence import Fence, fence_of, is_out, seen_from
from maniple.control.limits import Limits, Velocity, limits_of
from maniple.control.returns import Returns
from maniple.core.geometry import Pose
from maniple.core.messages import Drive
from maniple.core.scenario.types import Avoidance, Formation, Line, Point, Robot, RobotModel, Scenario
from maniple.core.scenario.types import Guard as Law
from maniple.core.streams import stream
from maniple.core.time import MILLISECOND
from simulator.drives import Drives
from simulator.dynamics import VelocityDynamics, integrate
from tests.robot_agent.conftest import LASER

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
ANGLE = ((-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (0.5, 3.0), (0.5, -0.5), (-3.0, -0.5))
MODELS = robot_models()
STEP_S, TICK_STEPS = 0.01, 5
OPEN = Law(clearance=False)


def fence_with(corners: Sequence[Point]) -> Fence:
    fence = fence_of(corners)
    assert fence is not None
    return fence


def star(seed: int) -> list[Point]:
    """A simple polygon, seldom convex, round the origin, in either order."""
    random = stream(seed, "star")
    corners = int(random.integers(3, 12))
    angle = 2.0 * math.pi * (np.arange(corners) + random.uniform(-0.3, 0.3, corners)) / corners
    reach = random.uniform(1.0, 6.0, corners)
    points = list(zip((reach * np.cos(angle)).tolist(), (reach * np.sin(angle)).tolist(), strict=True))
    return points if random.random() < 0.5 else points[::-1]


def test_no_corners_no_fence() -> None:
    assert fence_of(()) is None


@pytest.mark.parametrize("corners", [SQUARE, SQUARE[::-1]])
def test_seen_from_inside_and_outside_and_on_it(corners: tuple[Point, ...]) -> None:
    fence = fence_with(corners)
    inside = seen_from(Pose(1.0, 2.0, math.pi / 2), fence)
    assert sorted(inside.distance.tolist()) == [1.0, 2.0, 2.0, 3.0]
    assert inside.bearing[int(inside.distance.argmin())] == pytest.approx(math.pi / 2)
    assert (inside.sees_ahead, inside.sees_behind, inside.half_cone) == (True, True, 0.0)
    outside = seen_from(Pose(-1.0, 2.0, math.pi / 2), fence)
    assert (outside.distance.tolist(), outside.bearing.tolist()) == ([-1.0], [pytest.approx(math.pi / 2)])
    on = seen_from(Pose(0.0, 2.0, 0.0), fence)
    assert on.distance.tolist() == [0.0]
    assert abs(on.bearing[0]) == pytest.approx(math.pi)
    assert is_out(inside, 1.1)
    assert not is_out(inside, 1.0)
    assert is_out(outside, 0.1)


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.integers(0, 10**6), st.floats(-7.0, 7.0), st.floats(-7.0, 7.0), st.floats(-4.0, 4.0), st.booleans())
def test_distances_and_sides_are_those_of_an_independent_geometry(
    seed: int, x: float, y: float, psi: float, level: bool
) -> None:
    """`level`: as far north as a corner, where a ray to the east meets two edges."""
    corners = star(seed)
    y = corners[0][1] if level else y
    polygon, point = shapely.Polygon(corners), shapely.Point(x, y)
    distance = polygon.exterior.distance(point)
    seen = seen_from(Pose(x, y, psi), fence_with(corners))
    if distance < 1e-7:
        return
    nearest = int(seen.distance.argmin())
    assert seen.distance[nearest] == pytest.approx(distance if polygon.contains(point) else -distance)
    reach, bearing = float(seen.distance[nearest]), psi + float(seen.bearing[nearest])
    foot = shapely.Point(x + reach * math.cos(bearing), y + reach * math.sin(bearing))
    assert polygon.exterior.distance(foot) < 1e-9


class Body:
    """A robot with the dynamics of the simulator, and what it knows of itself: as it was up to `old` steps
    ago."""

    def __init__(self, model: RobotModel, pose: Pose, old: int) -> None:
        self._drives = Drives([model], 10 * MILLISECOND)
        self._dynamics = VelocityDynamics([model.theta], STEP_S, sideways=model.v_max_mps is not None)
        self._curvature = limits_for(model).curvature
        self._old = old
        self.velocity = np.zeros((3 if model.v_max_mps else 2, 1))
        self.past = [(pose, Velocity())]

    def known(self) -> tuple[Pose, Velocity]:
        return self.past[max(-1 - self._old, -len(self.past))]

    def follow(self, told: Velocity) -> list[Pose]:
        """Where it comes by in one tick."""
        order = Drive(u_mps=told.u, w_radps=told.w, v_mps=told.v, active=True)
        self._drives.command(0, order, 0)
        applied = self._drives.changes.pop().velocity
        push = self._dynamics.input_gain * np.array(applied[: len(self.velocity)])[:, None]
        for _ in range(TICK_STEPS):
            before, after = self.velocity, np.empty_like(self.velocity)
            self._dynamics.step(before, push, after)
            if self._curvature < math.inf:
                most = self._curvature * abs(after[0])
                after[1] = np.clip(after[1], -most, most)
            pose = self.past[-1][0]
            travel = np.zeros_like(before)
            travel[1] = pose.psi
            position = np.array([complex(pose.x, pose.y)])
            _, travels, positions = integrate(np.stack([before, after]), travel, position, STEP_S)
            self.velocity = after
            u, w, *v = after[:, 0].tolist()
            here = Pose(positions[-1, 0].real, positions[-1, 0].imag, float(travels[-1, 1, 0]))
            self.past.append((here, Velocity(u, w, v[0] if v else 0.0)))
        return [pose for pose, _ in self.past[-TICK_STEPS:]]


def limits_for(model: RobotModel) -> Limits:
    robot = Robot(id="r1", model="m", pose=(0.0, 0.0, 0.0))
    scenario = Scenario(
        name="test",
        robots=(robot,),
        formation=Formation(points=((0.0, 0.0),)),
        task=Line(start=(0.0, 0.0), end=(1.0, 0.0), speed_mps=0.1),
        avoidance=Avoidance(enabled=False),
        guard=Law(clearance=False),
        models={"m": model},
        sensors={"sick-lms200": LASER},
    )
    return limits_of(scenario, robot)


def drive_about(
    model: RobotModel, corners: Sequence[Point], seed: int, old: int, gamma: float, seconds: float = 15.0
) -> tuple[list[float], float, Limits]:
    """Distance to the fence (m, negative outside) of the middle of the circle all along a drive from inside
    it, with commands that jump or aim at the fence; the way it went in all (m), and its limits."""
    random = stream(seed, "fence")
    law, fence, polygon = (
        Law(clearance=False, gamma_per_s=gamma),
        fence_with(corners),
        shapely.Polygon(corners),
    )
    limits = limits_for(model)
    while True:
        x, y, psi = random.uniform((-6.0, -6.0, -math.pi), (6.0, 6.0, math.pi)).tolist()
        start = Pose(x, y, psi)
        middle = start.compose(Pose(limits.centre, 0.0, 0.0))
        seen = seen_from(middle, fence)
        if seen.distance.min() >= limits.radius:
            break
    body, state, command = Body(model, start, old), Velocity(), Velocity()
    gaps, way = [], 0.0
    for tick in range(round(seconds / (STEP_S * TICK_STEPS))):
        pose, measured = body.known()
        seen = seen_from(pose.compose(Pose(limits.centre, 0.0, 0.0)), fence)
        if tick % 10 == 0:
            nearest = float(seen.bearing[int(seen.distance.argmin())])
            speed, turn = (
                float(random.choice([-6.0, -0.3, 0.3, 6.0])),
                float(random.choice([-3.0, 0.0, 0.5, 3.0])),
            )
            side = float(random.choice([-1.0, 0.0, 1.0]))
            if random.random() < 0.6:
                speed, side = 6.0 * math.cos(nearest), 6.0 * math.sin(nearest)
                turn = 3.0 * float(np.sign(math.sin(nearest) * math.cos(nearest)))
            command = Velocity(speed, turn, side if limits.v_max else 0.0)
        state, _ = guard.step(law, limits, state, command, 0.0, None, STEP_S * TICK_STEPS, measured, seen)
        for before, after in pairwise([body.past[-1][0], *body.follow(state)]):
            way += math.dist(before[:2], after[:2])
            centre = shapely.Point(after.compose(Pose(limits.centre, 0.0, 0.0))[:2])
            gaps.append(polygon.exterior.distance(centre) * (1 if polygon.contains(centre) else -1))
    return gaps, way, limits


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    st.integers(0, 10**6),
    st.sampled_from(sorted(MODELS)),
    st.integers(0, 10),
    st.sampled_from([1.0, 4.0]),
)
def test_a_robot_of_the_simulator_never_leaves_whatever_it_is_told(
    seed: int, model: str, old: int, gamma: float
) -> None:
    """Whatever the shape; what it knows is up to 0.1 s old."""
    corners = [(1.5 * x, 1.5 * y) for x, y in star(seed)]
    largest = shapely.Polygon(corners).buffer(-0.6)
    if largest.area < 0.1:
        corners = list(ANGLE)
    gaps, _, limits = drive_about(MODELS[model], corners, seed, old, gamma, seconds=8.0)
    assert min(gaps) >= limits.radius


def test_it_goes_up_to_the_fence_and_along_it() -> None:
    """A guard that let nothing pass would keep every robot inside."""
    ways = {name: drive_about(MODELS[name], ANGLE, 3, 5, 1.0)[1] for name in MODELS}
    assert min(ways.values()) > 0.5
    limits = limits_for(MODELS["pioneer-3dx"])
    body, state, fence = Body(MODELS["pioneer-3dx"], Pose(0.0, -2.0, 0.0), 5), Velocity(), fence_with(ANGLE)
    for _ in range(600):
        pose, measured = body.known()
        seen = seen_from(pose, fence)
        state, reason = guard.step(OPEN, limits, state, Velocity(0.5), 0.0, None, 0.05, measured, seen)
        body.follow(state)
    left = 3.0 - body.past[-1][0].x - limits.radius
    assert OPEN.margin_m <= left < OPEN.margin_m + 0.01
    assert reason == "fence"


@pytest.mark.parametrize("model", sorted(MODELS))
@pytest.mark.parametrize("psi", [0.0, 0.5, 2.0, math.pi])
def test_outside_it_only_comes_back_and_slowly(model: str, psi: float) -> None:
    """It wants in, and out, and anywhere, by turns."""
    limits, fence, polygon = limits_for(MODELS[model]), fence_with(SQUARE), shapely.Polygon(SQUARE)
    body, state = Body(MODELS[model], Pose(-0.8, 2.0, psi), 5), Velocity()
    random, out, fastest = stream(7, f"out/{model}/{psi}"), [], 0.0
    reasons = set()
    for tick in range(1200):
        pose, measured = body.known()
        middle = pose.compose(Pose(limits.centre, 0.0, 0.0))
        if tick % 20 == 0:
            home = math.atan2(2.0 - pose.y, 2.0 - pose.x) - pose.psi
            wild = tick % 40 == 0
            u, w, v = random.uniform(-2.0, 2.0, 3).tolist()
            if not wild:
                u, w, v = math.cos(home), 1.5 * math.sin(home), math.sin(home)
            command = Velocity(u, w, v if limits.v_max else 0.0)
        state, reason = guard.step(
            OPEN, limits, state, command, 0.0, None, 0.05, measured, seen_from(middle, fence)
        )
        reasons.add(reason)
        for after in body.follow(state):
            at = after.compose(Pose(limits.centre, 0.0, 0.0))
            centre = shapely.Point(at[:2])
            if not polygon.contains(centre):
                fastest = max(fastest, math.hypot(state.u, state.v))
                out.append(polygon.exterior.distance(centre))
    assert "fence" in reasons
    assert fastest <= 0.11
    assert max(out) <= out[0] + 5e-3
    assert polygon.contains(centre)


@pytest.mark.parametrize("model", ["robotino", "pioneer-3dx"])
def test_between_a_fence_and_a_thing_it_touches_neither(model: str) -> None:
    limits, fence, law = limits_for(MODELS[model]), fence_with(SQUARE), Law()
    post = np.array([0.9, 2.4])
    body, state = Body(MODELS[model], Pose(0.8, 1.0, math.pi / 2), 0), Velocity()
    reasons = set()
    for tick in range(400):
        pose, measured = body.known()
        gap = post - pose[:2]
        bearing = math.atan2(gap[1], gap[0]) - pose.psi
        seen = Returns(np.array([np.hypot(*gap)]), np.array([bearing]), True, True)
        left = 0.4 if limits.v_max and tick > 100 else 0.0
        command = Velocity(0.4, 0.0 if limits.v_max else 0.1 * math.sin(tick / 30.0), left)
        around = seen_from(pose, fence)
        state, reason = guard.step(law, limits, state, command, 0.0, seen, 0.05, measured, around)
        reasons.add(reason)
        for after in body.follow(state):
            assert math.dist(after[:2], post) >= limits.radius
            assert seen_from(after, fence).distance.min() >= limits.radius
    assert "clearance" in reasons
    if limits.v_max:
        assert "fence" in reasons
