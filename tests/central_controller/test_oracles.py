"""The triangle's mathematics against SymPy, as the paper prints it."""

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest
import sympy
from numpy.testing import assert_allclose

from central_controller.triangle import apply_inverse_jacobian, f, f_inverse, jacobian
from maniple.core.geometry import Floats

Sequence = Literal["ABC", "ACB"]

THIRD = sympy.Rational(1, 3)


class Symbolic(NamedTuple):
    """Functions of six numbers, of positions x1 .. y3 or of x_F .. beta_F."""

    value: Callable[..., Any]
    """(6, 1)."""
    gradient: Callable[..., Any]
    """(6, 6)."""


def symbolic(rows: list[Any], symbols: tuple[Any, ...]) -> Symbolic:
    matrix = sympy.Matrix(rows)
    return Symbolic(
        sympy.lambdify(symbols, matrix, "numpy", cse=True),
        sympy.lambdify(symbols, matrix.jacobian(sympy.Matrix(symbols)), "numpy", cse=True),
    )


@cache
def forward(sign: int) -> Symbolic:
    """q = f(x), eqs. (3) and (4), beta_F times `sign`."""
    x1, y1, x2, y2, x3, y3 = x = sympy.symbols("x1 y1 x2 y2 x3 y3", real=True)
    p = sympy.sqrt((x1 - x2) ** 2 + (y1 - y2) ** 2)
    q = sympy.sqrt((x1 - x3) ** 2 + (y1 - y3) ** 2)
    r = sympy.sqrt((x2 - x3) ** 2 + (y2 - y3) ** 2)
    beta = sign * sympy.acos((p**2 + q**2 - r**2) / (2 * p * q))
    psi = sympy.atan2(2 * THIRD * x1 - THIRD * (x2 + x3), 2 * THIRD * y1 - THIRD * (y2 + y3))
    return symbolic([THIRD * (x1 + x2 + x3), THIRD * (y1 + y2 + y3), psi, p, q, beta], x)


@cache
def inverse(sequence: Sequence) -> Symbolic:
    """x = f^-1(q), eq. (5) for ABC and eq. (6) for ACB; beta_F is positive in both."""
    xf, yf, psi, p, q, beta = variables = sympy.symbols("x_F y_F psi p q beta", real=True)
    r2 = p**2 + q**2 - 2 * p * q * sympy.cos(beta)
    h = sympy.sqrt((p**2 + q**2 - r2 / 2) / 2)
    alpha = sympy.acos((p**2 + h**2 - r2 / 4) / (2 * p * h))
    x1, y1 = xf + 2 * THIRD * h * sympy.sin(psi), yf + 2 * THIRD * h * sympy.cos(psi)
    if sequence == "ABC":
        x2, y2 = x1 - p * sympy.sin(alpha + psi), y1 - p * sympy.cos(alpha + psi)
        x3, y3 = x1 + q * sympy.sin(beta - alpha - psi), y1 - q * sympy.cos(beta - alpha - psi)
    else:
        x2, y2 = x1 + p * sympy.sin(alpha - psi), y1 - p * sympy.cos(alpha - psi)
        x3, y3 = x1 - q * sympy.sin(beta - alpha + psi), y1 - q * sympy.cos(beta - alpha + psi)
    return symbolic([x1, y1, x2, y2, x3, y3], variables)


def triangles(sequence: Sequence, count: int = 300) -> Floats:
    """Random triangles of one sequence, (count, 3, 2), none near a singularity of the printed angle."""
    corners = np.random.default_rng(11).uniform(-4.0, 4.0, size=(4 * count, 3, 2))
    a, b, c = np.moveaxis(corners, 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    sizes = [np.linalg.norm(d, axis=1) for d in (b - a, c - a, a - (b + c) / 2)]
    fit = (np.min(sizes, axis=0) > 0.3) & ((area > 0.3) if sequence == "ABC" else (area < -0.3))
    assert fit.sum() >= count
    return np.asarray(corners[fit][:count])


SEQUENCES: tuple[Sequence, ...] = ("ABC", "ACB")


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_f_and_its_jacobian_are_the_derivatives_of_eqs_3_and_4(sequence: Sequence, signed: bool) -> None:
    corners, oracle = triangles(sequence), forward(-1 if signed and sequence == "ACB" else 1)
    for positions, q, matrix in zip(corners, f(corners, signed), jacobian(corners, signed), strict=True):
        assert_allclose(q, oracle.value(*positions.ravel())[:, 0], atol=1e-9)
        assert_allclose(matrix, oracle.gradient(*positions.ravel()), atol=1e-9)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_f_inverse_is_eq_5_or_6(sequence: Sequence) -> None:
    q = f(triangles(sequence))
    for variables, positions in zip(q, f_inverse(q), strict=True):
        printed = inverse(sequence).value(*variables[:5], abs(variables[5]))
        assert_allclose(positions.ravel(), printed[:, 0], atol=1e-9)


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_inverse_jacobian_is_the_derivative_of_eq_5_or_6(sequence: Sequence, signed: bool) -> None:
    """dx/dq of the printed inverse; there is "an inverse Jacobian matrix for the ABC sequence, and another
    for the ACB sequence". The signed angle of ACB grows as the printed one shrinks."""
    corners = triangles(sequence)
    q = f(corners)
    columns = [
        apply_inverse_jacobian(corners, np.broadcast_to(unit, q.shape), signed).reshape(-1, 6)
        for unit in np.eye(6)
    ]
    for variables, matrix in zip(q, np.stack(columns, axis=-1), strict=True):
        printed = inverse(sequence).gradient(*variables[:5], abs(variables[5]))
        if signed and sequence == "ACB":
            printed = printed * [1, 1, 1, 1, 1, -1]
        assert_allclose(matrix, printed, atol=1e-9)


@pytest.mark.parametrize("n", [3, 4, 6, 10])
def test_a_chain_has_2n_minus_3_shape_variables(n: int) -> None:
    """Of the 3(n - 2) shape variables, 2(n - 2) + 1 are free, for p of a triangle is r of the one before."""
    positions = np.random.default_rng(n).uniform(-3.0, 3.0, size=(n, 2))
    windows = np.stack([positions[j : j + 3] for j in range(n - 2)])
    gradients = np.zeros((n - 2, 3, 2 * n))
    for j, matrix in enumerate(jacobian(windows)):
        gradients[j, :, 2 * j : 2 * j + 6] = matrix[3:]
    assert np.linalg.matrix_rank(gradients.reshape(-1, 2 * n), tol=1e-9) == 2 * (n - 2) + 1
    shapes = f(windows)[:, 3:]
    between = np.linalg.norm(windows[:, 2] - windows[:, 1], axis=-1)
    assert_allclose(shapes[1:, 0], between[:-1])
