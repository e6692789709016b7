import math
from functools import cache

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from central_controller.triangle import (
    Triangles,
    apply_inverse_jacobian,
    carried,
    f,
    f_inverse,
    jacobian,
)
from maniple.core.geometry import Floats, Pose, rotation, wrap_array


def random_triangles(count: int, seed: int = 0, least_m: float = 0.1) -> Floats:
    """(count, 3, 2), none of them near a singularity."""
    positions = np.random.default_rng(seed).uniform(-3.0, 3.0, size=(2 * count, 3, 2))
    r1, r2, r3 = positions[:, 0], positions[:, 1], positions[:, 2]
    lengths = [np.linalg.norm(d, axis=1) for d in (r2 - r1, r3 - r1, r1 - (r2 + r3) / 2)]
    kept = positions[np.min(lengths, axis=0) > least_m][:count]
    assert len(kept) == count
    return np.asarray(kept)


def mirrored(positions: Floats) -> Floats:
    return np.asarray(positions * (-1.0, 1.0))


def printed_f(positions: Floats) -> Floats:
    """Eqs. (3) and (4), word for word."""
    (x1, y1), (x2, y2), (x3, y3) = np.moveaxis(positions, (1, 2), (0, 1))
    p = np.sqrt((x1 - x2) ** 2 + (y1 - y2) ** 2)
    q = np.sqrt((x1 - x3) ** 2 + (y1 - y3) ** 2)
    r = np.sqrt((x2 - x3) ** 2 + (y2 - y3) ** 2)
    psi = np.arctan2(2 / 3 * x1 - (x2 + x3) / 3, 2 / 3 * y1 - (y2 + y3) / 3)
    beta = np.arccos((p**2 + q**2 - r**2) / (2 * p * q))
    return np.column_stack([(x1 + x2 + x3) / 3, (y1 + y2 + y3) / 3, psi, p, q, beta])


def printed_f_inverse(q: Floats, sequence: str) -> Floats:
    """Eqs. (5) and (6), word for word; beta unsigned."""
    x_f, y_f, psi, p, q_f, beta = q.T
    r2 = p**2 + q_f**2 - 2 * p * q_f * np.cos(beta)
    h = np.sqrt(0.5 * (p**2 + q_f**2 - 0.5 * r2))
    alpha = np.arccos((p**2 + h**2 - r2 / 4) / (2 * p * h))
    x1, y1 = x_f + 2 / 3 * h * np.sin(psi), y_f + 2 / 3 * h * np.cos(psi)
    if sequence == "ABC":
        x2, y2 = x1 - p * np.sin(alpha + psi), y1 - p * np.cos(alpha + psi)
        x3, y3 = x1 + q_f * np.sin(beta - alpha - psi), y1 - q_f * np.cos(beta - alpha - psi)
    else:
        x2, y2 = x1 + p * np.sin(alpha - psi), y1 - p * np.cos(alpha - psi)
        x3, y3 = x1 - q_f * np.sin(beta - alpha + psi), y1 - q_f * np.cos(beta - alpha + psi)
    return np.stack([x1, y1, x2, y2, x3, y3], axis=-1).reshape(-1, 3, 2)


def test_f_of_a_known_triangle() -> None:
    """R1 north of R2 (west) and R3 (east): psi_F = 0, counter-clockwise R1 R2 R3."""
    positions = np.array([[[0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]]])
    side = math.sqrt(2)
    assert_allclose(f(positions), [[0, 1 / 3, 0, side, side, math.pi / 2]], atol=1e-15)
    assert_allclose(f(mirrored(positions)), [[0, 1 / 3, 0, side, side, -math.pi / 2]], atol=1e-15)


def test_psi_is_clockwise_from_north() -> None:
    positions = np.array([[[1.0, 0.0], [0.0, 0.5], [0.0, -0.5]]])  # points east
    assert f(positions)[0, 2] == pytest.approx(math.pi / 2)


def test_f_is_as_printed() -> None:
    positions = random_triangles(500)
    printed = printed_f(positions)
    assert_allclose(f(positions, signed=False), printed, atol=1e-9)
    signed = f(positions)
    assert_allclose(np.abs(signed[:, 5]), printed[:, 5], atol=1e-7)
    r1, r2, r3 = positions[:, 0], positions[:, 1], positions[:, 2]
    cross = (r2 - r1)[:, 0] * (r3 - r1)[:, 1] - (r2 - r1)[:, 1] * (r3 - r1)[:, 0]
    assert (np.sign(signed[:, 5]) == np.sign(cross)).all()


def test_one_inverse_formula_is_both_printed_ones() -> None:
    q = f(random_triangles(500))
    unsigned = np.column_stack([q[:, :5], np.abs(q[:, 5])])
    abc = q[:, 5] > 0
    assert 100 < abc.sum() < 400
    assert_allclose(f_inverse(q)[abc], printed_f_inverse(unsigned, "ABC")[abc], atol=1e-6)
    assert_allclose(f_inverse(q)[~abc], printed_f_inverse(unsigned, "ACB")[~abc], atol=1e-6)


def test_positions_survive_the_round_trip() -> None:
    positions = random_triangles(2000)
    assert_allclose(f_inverse(f(positions)), positions, atol=1e-12)


angles = st.floats(-3.1, 3.1)
lengths = st.floats(0.1, 10.0)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(st.floats(-50, 50), st.floats(-50, 50), angles, lengths, lengths, angles)
def test_variables_survive_the_round_trip(
    x: float, y: float, psi: float, p: float, q: float, beta: float
) -> None:
    variables = np.array([[x, y, psi, p, q, beta]])
    back = f(f_inverse(variables))
    difference = back - variables
    difference[:, 2::3] = wrap_array(difference[:, 2::3])
    if math.hypot(p + q * math.cos(beta), q * math.sin(beta)) < 1e-3:
        difference[0, 2] = 0.0  # R1 midway between the others: psi_F means nothing
    assert_allclose(difference, 0.0, atol=1e-9)


def test_any_leading_shape() -> None:
    positions = random_triangles(12)
    grid = positions.reshape(2, 2, 3, 3, 2)
    rates = np.random.default_rng(3).normal(size=(12, 6))
    assert_allclose(f(grid).reshape(12, 6), f(positions), rtol=0, atol=0)
    assert_allclose(jacobian(grid).reshape(12, 6, 6), jacobian(positions), rtol=0, atol=0)
    moved = apply_inverse_jacobian(grid, rates.reshape(2, 2, 3, 6))
    assert_allclose(moved.reshape(12, 3, 2), apply_inverse_jacobian(positions, rates), rtol=0, atol=0)


def test_whole_numbers_and_strided_arrays_serve_too() -> None:
    whole = np.array([[[0, 1], [-1, 0], [1, 0]]])
    strided = np.asfortranarray(whole.astype(np.float64))
    assert_allclose(f(whole), f(strided), rtol=0, atol=0)


@pytest.mark.parametrize("signed", [True, False])
def test_jacobian_is_the_finite_difference(signed: bool) -> None:
    positions = random_triangles(300)
    step = 1e-6
    numeric = np.empty((300, 6, 6))
    for column in range(6):
        change = np.zeros(6)
        change[column] = step
        shift = change.reshape(3, 2)
        difference = f(positions + shift, signed) - f(positions - shift, signed)
        difference[:, 2::3] = wrap_array(difference[:, 2::3])
        numeric[:, :, column] = difference / (2 * step)
    assert_allclose(jacobian(positions, signed), numeric, atol=1e-6)


@cache
def symbolic_jacobian() -> tuple[tuple[sympy.Symbol, ...], sympy.Matrix]:
    x1, y1, x2, y2, x3, y3 = x = sympy.symbols("x1 y1 x2 y2 x3 y3", real=True)
    ax, ay, bx, by = x2 - x1, y2 - y1, x3 - x1, y3 - y1
    q = sympy.Matrix(
        [
            (x1 + x2 + x3) / 3,
            (y1 + y2 + y3) / 3,
            sympy.atan2(2 * x1 / 3 - (x2 + x3) / 3, 2 * y1 / 3 - (y2 + y3) / 3),
            sympy.sqrt(ax**2 + ay**2),
            sympy.sqrt(bx**2 + by**2),
            sympy.atan2(ax * by - ay * bx, ax * bx + ay * by),
        ]
    )
    return x, q.jacobian(sympy.Matrix(x))


def test_jacobian_is_the_symbolic_one() -> None:
    x, matrix = symbolic_jacobian()
    evaluate = sympy.lambdify(x, matrix, "numpy")
    positions = random_triangles(50, seed=4)
    for corners in positions:
        assert_allclose(jacobian(corners[None])[0], evaluate(*corners.ravel()), atol=1e-12)


@pytest.mark.parametrize("signed", [True, False])
def test_closed_form_solves_the_6x6(signed: bool) -> None:
    positions = random_triangles(2000)
    rates = np.random.default_rng(1).normal(size=(2000, 6))
    solved = np.linalg.solve(jacobian(positions, signed), rates[..., None])[..., 0]
    moved = apply_inverse_jacobian(positions, rates, signed)
    assert_allclose(moved.reshape(-1, 6), solved, rtol=1e-9, atol=1e-9)


def test_robots_in_a_line_are_not_singular() -> None:
    line = np.array([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]])
    assert abs(np.linalg.det(jacobian(line)[0])) > 0.1
    rates = np.arange(6.0)[None]
    assert_allclose(jacobian(line)[0] @ apply_inverse_jacobian(line, rates).ravel(), rates[0], atol=1e-12)


@pytest.mark.parametrize(
    "positions",
    [
        [[0, 0], [0, 0], [1, 0]],
        [[0, 0], [1, 0], [0, 0]],
        [[0, 0], [1, 0], [-1, 0]],
        [[0, 0], [0, 0], [0, 0]],
    ],
)
def test_singular_triangles_get_finite_velocities(positions: list[list[float]]) -> None:
    triangles = Triangles(np.array([positions], dtype=np.float64))
    assert np.isfinite(triangles.variables()).all()
    assert np.abs(triangles.velocities(np.ones((1, 6)))).max() < 100.0


def test_carried_is_the_triangle_in_the_moved_frame() -> None:
    positions = random_triangles(20, seed=5)
    pose, (vx, vy, w) = Pose(3.0, -2.0, 0.7), (0.3, -0.1, 0.25)
    here = positions @ rotation(pose.psi).T + (pose.x, pose.y)
    q, rates = carried(f(positions), pose, (vx, vy, w))
    difference = f(here) - q
    difference[:, 2::3] = wrap_array(difference[:, 2::3])
    assert_allclose(difference, 0.0, atol=1e-12)
    arms = here - (pose.x, pose.y)
    velocities = np.stack([vx - w * arms[..., 1], vy + w * arms[..., 0]], axis=-1)
    assert_allclose(apply_inverse_jacobian(here, rates), velocities, atol=1e-12)
