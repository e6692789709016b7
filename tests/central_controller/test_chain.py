import math

import numpy as np
from numpy.testing import assert_allclose

from central_controller.chain import Chain
from central_controller.triangle import f, f_inverse
from maniple.core.geometry import Pose, wrap_array
from tests.central_controller.places import placed

POINTS = [(0.0, 0.0), (-1.0, 0.6), (-1.0, -0.6), (-2.0, 0.5), (-2.5, -0.7)]
POSE = Pose(4.0, -1.0, 2.0)


def test_triangle_j_is_robots_j_to_j_plus_2() -> None:
    positions = np.random.default_rng(0).normal(size=(5, 2))
    expected = np.concatenate([f(positions[None, j : j + 3]) for j in range(3)])
    assert_allclose(Chain(POINTS).triangles(positions).variables(), expected, rtol=0, atol=0)


def test_only_the_leader_triangle_commands_three() -> None:
    wanted = np.arange(3 * 3 * 2.0).reshape(3, 3, 2)
    told = Chain(POINTS).select(wanted)
    assert_allclose(told, [*wanted[0], wanted[1, 2], wanted[2, 2]], rtol=0, atol=0)


def test_platoons_can_be_stacked() -> None:
    chain = Chain(POINTS)
    positions = np.random.default_rng(0).normal(size=(4, 5, 2))
    stacked = chain.triangles(positions).variables()
    assert stacked.shape == (4, 3, 6)
    assert_allclose(stacked[2], chain.triangles(positions[2]).variables(), rtol=0, atol=0)
    assert chain.select(np.zeros((4, 3, 3, 2))).shape == (4, 5, 2)


def test_desired_variables_are_those_of_the_desired_points() -> None:
    for signed in (True, False):
        chain = Chain(POINTS, signed)
        desired = chain.desired(POSE, (0.1, 0.2, 0.3))
        difference = desired.q - chain.triangles(placed(POINTS, POSE)).variables()
        difference[:, 2::3] = wrap_array(difference[:, 2::3])
        assert_allclose(difference, 0.0, atol=1e-12)


def test_desired_rates_are_the_change_of_the_desired_variables() -> None:
    chain, (vx, vy, w), step = Chain(POINTS), (0.1, -0.2, 0.3), 1e-6
    before, after = (
        chain.desired(Pose(POSE.x + vx * t, POSE.y + vy * t, POSE.psi + w * t), (vx, vy, w)).q
        for t in (-step, step)
    )
    rates = chain.desired(POSE, (vx, vy, w)).rates
    assert_allclose(rates, (after - before) / (2 * step), atol=1e-8)
    assert_allclose(rates[:, 3:], 0.0, atol=0)
    assert math.copysign(1.0, rates[0, 2]) == -1.0


def test_neighbours_are_where_they_should_be_when_everybody_is() -> None:
    for signed in (True, False):
        positions = placed(POINTS, POSE)
        usual = Chain(POINTS, signed).desired(POSE, (0.1, -0.2, 0.3), positions)
        leaning = Chain(POINTS, signed, neighbours=True).desired(POSE, (0.1, -0.2, 0.3), positions)
        assert_allclose(wrap_array(leaning.q - usual.q), 0.0, atol=1e-12)
        assert_allclose(leaning.rates, usual.rates, atol=1e-12)


def test_a_later_triangle_leans_on_its_first_two_robots_wherever_they_are() -> None:
    chain = Chain(POINTS, neighbours=True)
    positions = placed(POINTS, POSE) + np.random.default_rng(5).normal(scale=0.1, size=(5, 2))
    desired = chain.desired(POSE, (0.1, 0.0, 0.0), positions).q
    shape = f(np.array(POINTS)[None, 1:4])[0]
    corners = f_inverse(desired[1:2])[0]
    assert_allclose(corners[:2], positions[1:3], atol=1e-9)
    assert_allclose(desired[1, 4:], shape[4:], atol=1e-12)
    assert_allclose(desired[0], Chain(POINTS).desired(POSE, (0.1, 0.0, 0.0)).q[0], atol=0)
