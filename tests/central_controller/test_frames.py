import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from central_controller.frames import Mounting, propagated
from maniple.core.geometry import Floats, Pose
from maniple.core.messages import Odometry

MOUNTING = Mounting(Pose(3.0, -1.0, 2.0), control_point_m=0.3)


def odometry(own: Pose, u: float = 0.0, w: float = 0.0) -> Odometry:
    return Odometry(frame_id="r1/odometry", x_m=own.x, y_m=own.y, psi_rad=own.psi, u_mps=u, w_radps=w)


def test_at_the_start_the_control_point_is_ahead_of_the_initial_pose() -> None:
    expected = (3.0 + 0.3 * math.cos(2.0), -1.0 + 0.3 * math.sin(2.0))
    assert MOUNTING.point(Pose(0.0, 0.0, 0.0)) == pytest.approx(expected)


def test_the_own_frame_is_turned_and_shifted_by_the_initial_pose() -> None:
    one_ahead = Mounting(Pose(3.0, -1.0, math.pi / 2), 0.5).point(Pose(1.0, 0.0, -math.pi / 2))
    assert one_ahead == pytest.approx((3.5, 0.0))


def test_velocities_turn_with_the_frame() -> None:
    """The control point of a robot that does what it is told moves as wanted in the formation frame."""
    wanted, own, step = (0.3, -0.2), Pose(0.4, 0.5, 0.6), 1e-6
    vx, vy = MOUNTING.velocity_in_own(*wanted)
    before = MOUNTING.point(own)
    after = MOUNTING.point(Pose(own.x + step * vx, own.y + step * vy, own.psi))
    assert_allclose((np.array(after) - before) / step, wanted, atol=1e-8)


@pytest.mark.parametrize(("u", "w"), [(0.5, 0.0), (0.5, 0.8), (-0.3, -1.5), (0.0, 1.0)])
def test_propagation_goes_straight_on_and_turns(u: float, w: float) -> None:
    start = Pose(1.0, 2.0, 0.5)

    def motion(_t: float, _x: Floats) -> list[float]:
        return [u * math.cos(start.psi), u * math.sin(start.psi), w]

    expected = solve_ivp(motion, (0.0, 0.4), start, rtol=1e-10, atol=1e-12).y[:, -1]
    assert_allclose(propagated(odometry(start, u, w), 0.4), expected, atol=1e-9)


def test_fresh_odometry_is_taken_as_it_is() -> None:
    start = Pose(1.0, 2.0, 0.5)
    assert propagated(odometry(start, 0.5, 0.5), 0.0) == start
