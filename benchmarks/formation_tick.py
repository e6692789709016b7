"""One tick of the formation law for n robots, against a loop that solves a 6x6 for each triangle."""

import math

import numpy as np

from benchmarks.common import Budget, Row, best_of, cpu_us, show
from central_controller import formation
from central_controller.chain import Chain
from central_controller.formation import Gains
from maniple.core.geometry import Floats, Pose, rotation, wrap
from maniple.core.scenario.types import Controller

TITLE = "Formation tick"
BUDGETS = {6: Budget(60.0, "ours"), 1000: Budget(250.0, "ours")}
"""By the number of robots."""
SIZES = (3, 6, 10, 100, 1000, 10_000)
QUICK_SIZES = (3, 6, 100)

POSE = Pose(1.0, 2.0, 0.3)
VELOCITY = (0.1, 0.05, 0.02)


def rows(quick: bool = False) -> list[Row]:
    """One row for each size of platoon.

    Raises:
        AssertionError: tick and loop disagree.
    """
    return [_row(n, rounds=1 if quick or n > 1000 else 5) for n in (QUICK_SIZES if quick else SIZES)]


def _row(n: int, rounds: int) -> Row:
    rng = np.random.default_rng(n)
    points = np.column_stack([-0.8 * np.arange(n), np.where(np.arange(n) % 2, 0.6, -0.6)])
    chain, gains = Chain(points), Gains.of(Controller())
    positions = points @ rotation(POSE.psi).T + POSE[:2] + rng.normal(scale=0.3, size=(n, 2))
    shape = [_variables(*points[j : j + 3]) for j in range(n - 2)]

    def tick() -> Floats:
        return formation.step(chain, gains, positions, chain.desired(POSE, VELOCITY)).velocities

    def loop() -> Floats:
        return loop_over_triangles(positions, shape)

    np.testing.assert_allclose(tick(), loop(), rtol=1e-6, atol=1e-9)
    ours, reference = best_of(lambda: cpu_us(tick), lambda: cpu_us(loop), rounds)
    return Row(f"{n} robots", ours, "us", "6x6 per triangle", reference, BUDGETS.get(n))


def loop_over_triangles(positions: Floats, shape: list[list[float]]) -> Floats:
    """The same tick, triangle by triangle: f, the law, the 6x6 Jacobian, and its solution."""
    out = np.zeros_like(positions)
    c, s = math.cos(POSE.psi), math.sin(POSE.psi)
    vx, vy, w = VELOCITY
    for j, (cx, cy, *own) in enumerate(shape):
        ax, ay = c * cx - s * cy, s * cx + c * cy
        desired = [POSE.x + ax, POSE.y + ay, own[0] - POSE.psi, own[1], own[2], own[3]]
        rates = [vx - w * ay, vy + w * ax, -w, 0.0, 0.0, 0.0]
        corners = positions[j], positions[j + 1], positions[j + 2]
        q = _variables(*corners)
        for i in range(6):
            error = desired[i] - q[i]
            rates[i] += 0.1 * math.tanh(0.25 / 0.1 * (wrap(error) if i in (2, 5) else error))
        solution = np.linalg.solve(_jacobian(*corners), rates).reshape(3, 2)
        if j == 0:
            out[:3] = solution
        else:
            out[j + 2] = solution[2]
    return out


def _variables(r1: Floats, r2: Floats, r3: Floats) -> list[float]:
    x, y = (r1 + r2 + r3) / 3
    mx, my = r1 - (r2 + r3) / 2
    d2, d3 = r2 - r1, r3 - r1
    beta = math.atan2(d2[0] * d3[1] - d2[1] * d3[0], d2[0] * d3[0] + d2[1] * d3[1])
    return [x, y, math.atan2(mx, my), math.hypot(*d2), math.hypot(*d3), beta]


def _jacobian(r1: Floats, r2: Floats, r3: Floats) -> Floats:
    (mx, my), (ax, ay), (bx, by) = r1 - (r2 + r3) / 2, r2 - r1, r3 - r1
    m2, p2, q2 = mx * mx + my * my, ax * ax + ay * ay, bx * bx + by * by
    p, q, k = math.sqrt(p2), math.sqrt(q2), 1 / 3
    return np.array(
        [
            [k, 0, k, 0, k, 0],
            [0, k, 0, k, 0, k],
            [my / m2, -mx / m2, -my / m2 / 2, mx / m2 / 2, -my / m2 / 2, mx / m2 / 2],
            [-ax / p, -ay / p, ax / p, ay / p, 0, 0],
            [-bx / q, -by / q, 0, 0, bx / q, by / q],
            [by / q2 - ay / p2, ax / p2 - bx / q2, ay / p2, -ax / p2, -by / q2, bx / q2],
        ]
    )


if __name__ == "__main__":
    show(TITLE, rows())
