import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from maniple.control.kinematics import Kinematics, kinematics_of
from maniple.control.limits import Velocity, curvature_max
from maniple.core.geometry import Pose
from maniple.core.scenario.types import RobotModel
from maniple.core.streams import stream
from tests.pioneer import PIONEER

DRIVES: dict[str, dict[str, Any]] = {
    "differential": {},
    "omnidirectional": {"v_max_mps": 0.75},
    "car": {"wheelbase_m": 0.33, "steer_max_rad": 0.4189},
}
A = 0.33

angles = st.floats(-10.0, 10.0)
speeds = st.floats(-2.0, 2.0)


def model(drive: str) -> RobotModel:
    return replace(PIONEER, drive=drive, **DRIVES[drive])


def kinematics(drive: str) -> Kinematics:
    return kinematics_of(model(drive), A)


@pytest.mark.parametrize("drive", DRIVES)
def test_forward_is_the_derivative_of_the_control_point(drive: str) -> None:
    robot, pose, dt = kinematics(drive), Pose(1.0, -2.0, 0.7), 1e-6
    u, w, v = velocity = Velocity(0.4, -0.9, 0.2 if drive == "omnidirectional" else 0.0)
    points = []
    for sign in (-1, 1):
        vx, vy = pose.rotate(u, v)
        points.append(
            robot.point(Pose(pose.x + sign * vx * dt, pose.y + sign * vy * dt, pose.psi + sign * w * dt))
        )
    slope = [(q - p) / (2 * dt) for p, q in zip(*points, strict=True)]
    assert robot.forward(pose.psi, velocity) == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize("drive", ["differential", "omnidirectional"])
@settings(deadline=None, derandomize=True)
@given(angles, speeds, speeds, st.floats(-1.0, 1.0))
def test_forward_undoes_inverse(drive: str, psi: float, vx: float, vy: float, turn: float) -> None:
    robot = kinematics(drive)
    velocity = robot.inverse(psi, vx, vy, turn)
    assert robot.forward(psi, velocity) == pytest.approx((vx, vy), abs=1e-12)
    if drive == "omnidirectional":
        assert velocity.w == turn
    else:
        assert velocity.v == 0.0


@settings(deadline=None, derandomize=True, max_examples=300)
@given(angles, st.lists(st.tuples(speeds, speeds), min_size=1, max_size=8))
def test_a_car_does_what_it_can_and_never_goes_away_from_where_it_is_to_go(
    psi: float, wanted: list[tuple[float, float]]
) -> None:
    car, most = kinematics("car"), curvature_max(model("car"))
    g = math.atan(A * most)
    for vx, vy in wanted:
        velocity = car.inverse(psi, vx, vy, 0.3)
        assert abs(velocity.w) <= most * abs(velocity.u) * (1 + 1e-9)
        got, speed = car.forward(psi, velocity), math.hypot(vx, vy)
        assert math.hypot(*got) == pytest.approx(speed, abs=1e-9)
        assert got[0] * vx + got[1] * vy >= (math.sin(g / 2) - 1e-9) * speed * speed


def test_a_car_changes_gear_only_once_the_target_is_well_behind() -> None:
    car = kinematics("car")
    half = 0.5 * math.atan(A * curvature_max(model("car")))
    for degrees, gear in (
        (0, 1),
        (90, 1),
        (90 + math.degrees(half) - 1, 1),
        (90 + math.degrees(half) + 1, -1),
    ):
        angle = math.radians(degrees)
        assert math.copysign(1, car.inverse(0.0, math.cos(angle), math.sin(angle), 0.0).u) == gear
    assert car.inverse(0.0, 0.0, 1.0, 0.0).u < 0.0
    assert car.inverse(0.0, 0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
    assert car.inverse(0.0, 1.0, 0.1, 0.0) == pytest.approx((1.0, 0.1 / A, 0.0))


@pytest.mark.parametrize("lag_s", [0.0, 0.3])
def test_a_car_reaches_any_target(lag_s: float) -> None:
    """From anywhere, facing anywhere, also with a drive that follows late: eq. (7) for one point."""
    random, most, dt = stream(1, "car"), curvature_max(model("car")), 0.05
    share = 1.0 - math.exp(-dt / lag_s) if lag_s else 1.0
    for _ in range(60):
        car = kinematics("car")
        tx, ty, psi = (random.uniform(-1, 1, 3) * (2.0, 2.0, math.pi)).tolist()
        pose, u, w, t = Pose(0.0, 0.0, psi), 0.0, 0.0, 0.0
        before = math.inf
        while (left := math.dist(car.point(pose), (tx, ty))) > 0.01:
            assert t < 120.0
            assert lag_s or left <= before + 1e-6
            speed = 0.1 * math.tanh(2.5 * left) / left
            x, y = car.point(pose)
            wanted = car.inverse(pose.psi, speed * (tx - x), speed * (ty - y), 0.0)
            u += share * (wanted.u - u)
            w += share * (wanted.w - w)
            w = max(-most * abs(u), min(most * abs(u), w))
            pose = pose.advance(u * dt, w * dt)
            t, before = t + dt, left
