import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniple.control import unicycle
from maniple.core.geometry import Pose

angles = st.floats(-10.0, 10.0)
speeds = st.floats(-5.0, 5.0)


@settings(deadline=None, derandomize=True)
@given(angles, st.floats(0.05, 1.0), speeds, speeds)
def test_inverse_undoes_forward(psi: float, a: float, u: float, w: float) -> None:
    assert unicycle.inverse(psi, a, *unicycle.forward(psi, a, u, w)) == pytest.approx((u, w), abs=1e-12)


@settings(deadline=None, derandomize=True)
@given(angles, st.floats(0.05, 1.0), speeds, speeds)
def test_inverse_is_the_inverse_matrix_of_eq_2(psi: float, a: float, vx: float, vy: float) -> None:
    c, s = math.cos(psi), math.sin(psi)
    expected = np.linalg.solve(np.array([[c, -a * s], [s, a * c]]), [vx, vy])
    assert unicycle.inverse(psi, a, vx, vy) == pytest.approx(expected, abs=1e-11)


def test_forward_is_the_derivative_of_the_control_point() -> None:
    pose, a, u, w, dt = Pose(1.0, -2.0, 0.7), 0.3, 0.4, -0.9, 1e-6
    before = unicycle.control_point(pose.advance(-u * dt, -w * dt), a)
    after = unicycle.control_point(pose.advance(u * dt, w * dt), a)
    slope = [(q - p) / (2 * dt) for p, q in zip(before, after, strict=True)]
    assert unicycle.forward(pose.psi, a, u, w) == pytest.approx(slope, abs=1e-8)
