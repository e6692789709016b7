"""`python -m benchmarks.errata [NAME ...]`: misprints and contradictions of the paper, shown by figures."""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Literal, TypeAlias

import numpy as np

from benchmarks.evidence.platoons import (
    DT_S,
    KAPPA,
    SATURATION,
    SLOW,
    Case,
    Platoons,
    headings,
    places,
    starts,
)
from benchmarks.evidence.study import converge, exact_bound, pushed
from benchmarks.lone_robot import drive_past, seen
from central_controller import formation
from central_controller.chain import Chain
from central_controller.formation import Gains
from central_controller.triangle import f, f_inverse, jacobian
from maniple.control import avoidance, unicycle
from maniple.core.geometry import Pose
from maniple.core.scenario.types import Avoidance, Controller

Lines: TypeAlias = Iterator[str]

GAINS = Gains.of(Controller(kappa=KAPPA, saturation=SATURATION))


def position() -> Lines:
    """Eq. (2) maps the velocity of h_i; as printed it maps the position."""
    yield "robot at h = (10, 5) m, heading 0.6 rad, a = 0.2 m; h' = (0.10, 0.00) m/s is wanted"
    for name, x, y in (("K^-1 h' (meant)", 0.10, 0.0), ("K^-1 h (printed)", 10.0, 5.0)):
        u, w = unicycle.inverse(0.6, 0.2, x, y)
        vx, vy = unicycle.forward(0.6, 0.2, u, w)
        yield f"{name}: u = {u:.3f} m/s, w = {w:.3f} rad/s, which moves h at ({vx:.2f}, {vy:.2f}) m/s"


def arctangent() -> Lines:
    """Eq. (3): an arctangent of a quotient can't tell a triangle from the same one turned by half a turn."""
    corners = np.array([[[0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]]])
    for name, positions in (("pointing along +y", corners), ("turned by 180 degrees", -corners)):
        (x1, y1), (x2, y2), (x3, y3) = positions[0]
        quotient = math.atan((2 * x1 / 3 - (x2 + x3) / 3) / (2 * y1 / 3 - (y2 + y3) / 3))
        q = f(positions)
        printed = q.copy()
        printed[0, 2] = quotient
        back = [np.abs(f_inverse(each) - positions).max() for each in (q, printed)]
        yield (
            f"{name}: psi_F by two arguments {q[0, 2]:.3f}, by the quotient {quotient:.3f}; "
            f"f^-1(f(x)) is off by {back[0]:.3f} and {back[1]:.3f} m"
        )


def wrapping() -> Lines:
    """Eq. (7) with an angle error that is not wrapped turns the formation the long way round."""
    chain = Chain(places(3))
    begin = f_inverse(np.array([[0.0, 0.0, -3.0, 1.5, 1.5, 1.0]]))[0]
    wanted = np.array([[0.0, 0.0, 3.0, 1.5, 1.5, 1.0]])
    for name in ("wrapped to (-pi, pi]", "not wrapped"):
        x, turned, q_before = begin.copy(), 0.0, -3.0
        for step in range(2000):
            triangles = chain.triangles(x)
            q = triangles.variables()
            error = formation.errors(wanted, q) if name.startswith("wrapped") else wanted - q
            seconds = step * DT_S
            turned += abs(math.remainder(float(q[0, 2]) - q_before, 2 * math.pi))
            q_before = float(q[0, 2])
            if np.abs(formation.errors(wanted, q)).max() < 0.01:
                break
            x = x + DT_S * chain.select(triangles.velocities(formation.law(np.zeros((1, 6)), error, GAINS)))
        yield f"from psi_F = -3.0 to 3.0 rad, {name}: turns by {turned:.2f} rad in {seconds:.0f} s"


def near() -> Lines:
    """Eq. (9) says nothing for d < d_min; here the force stays at F_max of eq. (10)."""
    parameters = Avoidance()
    for d in (1.00, 0.95, 0.60, 0.30, 0.29, 0.10, 0.0):
        defined = d >= parameters.d_min_m
        printed = f"{avoidance.force(parameters, d):.4f}" if defined else "undefined"
        yield f"d = {d:.2f} m: printed {printed}, here {avoidance.force(parameters, d):.4f}"


def sine() -> Lines:
    """Eq. (13) with sin(beta) against the text: "reduce the linear velocity (except if parallel)"."""
    load = 0.2
    yield f"u_cor at rest under a force of {load} at bearing beta; positive slows"
    for degrees in (-90, -45, 0, 45, 90):
        side = avoidance.Force(load, math.radians(degrees))
        right, left = (side, avoidance.NO_FORCE) if degrees <= 0 else (avoidance.NO_FORCE, side)
        sides = avoidance.Sides(right, left)
        sin = avoidance.step(Avoidance(form="sin"), avoidance.REST, sides, 1e3).u_cor
        cos = avoidance.step(Avoidance(form="cos"), avoidance.REST, sides, 1e3).u_cor
        yield f"beta = {degrees:+3d} degrees: printed {sin:+.4f} m/s, cos {cos:+.4f} m/s"


def twice() -> Lines:
    """One object dead ahead gives two forces that cancel, return by return; "only F_R is generated"."""
    returns = seen(Pose(0.0, 0.0, 0.0), (0.7, 0.0))
    splits: tuple[Literal["returns", "objects"], ...] = ("returns", "objects")
    for split in splits:
        parameters = Avoidance(split=split)
        right, left = avoidance.forces(parameters, returns)
        clearance = drive_past(parameters, 0.05, 0.3, 0.0).clearance_m
        yield (
            f"{split}: F_R = {right.force:.4f}, F_L = {left.force:.4f}, "
            f"F_R - F_L = {right.force - left.force:.4f}; "
            f"driven at it at 0.05 m/s the smallest clearance is {clearance:+.2f} m"
        )


def gains() -> Lines:
    """Section 6, "guaranteeing that the entire formation avoids the obstacles": printed gains are weak."""
    parameters = Avoidance()
    largest = avoidance.force(parameters, 0.0)
    angular = parameters.angular
    pole = np.roots([angular.inertia, angular.damping, angular.stiffness]).real.max()
    yield (
        f"F_max = {largest:.4f}; u_cor <= {largest / parameters.linear.stiffness:.3f} m/s, "
        f"w_cor <= {largest / angular.stiffness:.2f} rad/s with a time constant of {-1.0 / pole:.1f} s"
    )
    yield "smallest clearance (m) of a 0.25 m robot from a disc of 0.15 m in its way; negative is a collision"
    for beside in (0.0, 0.15, 0.3):
        for speed in (0.05, 0.075, 0.10, 0.15):
            cells = (
                f"a = {a:.2f}: {drive_past(parameters, speed, a, beside).clearance_m:+.2f}"
                for a in (0.15, 0.2, 0.3)
            )
            yield f"disc {beside:.2f} m beside the line, {speed:.3f} m/s: {', '.join(cells)}"


def mirror() -> Lines:
    """ "Globally asymptotically stable" holds in q: eq. (4) can't tell a triangle from its mirror image."""
    for case in (Case(3, signed=False), Case(3)):
        outcome = converge(case, 0, 200, 200.0)
        platoons = Platoons(case, starts(case, 200), headings(case, 200))
        for _ in range(2000):
            platoons.step(platoons.desired())
        errors = np.abs(platoons.told(platoons.desired()).errors).max()
        there = int(np.isfinite(outcome.time_s).sum())
        yield f"{case.variant}: 200 starts, largest |q~| at the end {errors:.1e}, in formation {there}"


def collinear() -> Lines:
    """Section 4.1: J is singular "when two robots are in the same position" or "when all are aligned"."""
    shapes: Mapping[str, list[tuple[float, float]]] = {
        "equilateral": [(0.0, 0.0), (1.0, 0.0), (0.5, math.sqrt(0.75))],
        "in a line, R1 at the end (beta = 0)": [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)],
        "in a line, R1 inside (beta = 180 degrees)": [(0.0, 0.0), (1.0, 0.0), (-2.0, 0.0)],
        "R2 where R3 is": [(0.0, 0.0), (1.0, 0.0), (1.0, 0.0)],
        "R1 1 cm from R2": [(0.0, 0.0), (0.01, 0.0), (1.0, 1.0)],
        "R1 1 cm from the middle between R2 and R3": [(0.01, 0.0), (1.0, 0.0), (-1.0, 0.0)],
        "R1 1 mm from the middle between R2 and R3": [(0.001, 0.0), (1.0, 0.0), (-1.0, 0.0)],
    }
    for name, corners in shapes.items():
        matrix = jacobian(np.array([corners]))[0]
        smallest = np.linalg.svd(matrix, compute_uv=False)[-1]
        yield (
            f"{name}: |det J| = {abs(np.linalg.det(matrix)):.3g}, smallest singular value {smallest:.3g}, "
            f"largest entry of J^-1 {np.abs(np.linalg.inv(matrix)).max():.3g}"
        )
    yield "across the line the printed beta' changes its sign; with the signed angle nothing happens"


def matrices() -> Lines:
    """Kappa and L "in R^6" are diagonal 6x6 matrices, and "the 3x3 Jacobian" of the introduction is 6x6."""
    q = f(places(3)[None])
    yield f"q has {q.shape[-1]} components, J is {' x '.join(map(str, jacobian(places(3)[None]).shape[1:]))}"
    kappa, saturation = KAPPA * np.eye(6), SATURATION * np.eye(6)
    error = np.linspace(-0.5, 0.5, 6)
    matrix = saturation @ np.tanh(np.linalg.inv(saturation) @ kappa @ error)
    here = formation.law(np.zeros(6), error, GAINS)
    yield f"L tanh(L^-1 kappa q~) with matrices and as it is here differ by {np.abs(matrix - here).max():.1e}"


def saturation() -> Lines:
    """Section 4.2: tanh keeps q_ref' "below the bounds of the robot actuators", not the robots' speeds."""
    for n in (3, 6, 20):
        case = Case(n)
        platoons = Platoons(case, starts(case, 500), headings(case, 500))
        told = platoons.told(platoons.desired())
        speeds = np.hypot(*np.moveaxis(told.velocities, -1, 0)).max(axis=-1)
        yield (
            f"n = {n}, 500 starts: every |q_ref'| <= {SATURATION} m/s, rad/s; the fastest control point is "
            f"told {np.median(speeds):.2f} m/s in the median, more than 0.75 m/s in {(speeds > 0.75).sum()}"
        )


def linearised() -> Lines:
    """Section 4.2: the error is "ultimately bounded by ||delta_v|| / lambda_min(kappa)": tanh gives more."""
    for delta in (0.01, 0.05, 0.08, 0.099):
        error = 0.0
        for _ in range(100_000):
            error += 0.01 * (delta - SATURATION * math.tanh(KAPPA / SATURATION * error))
        exact = float(exact_bound(np.array(delta)))
        yield (
            f"constant delta_v = {delta:.3f} in one component: error {error:.3f}, printed bound "
            f"{delta / KAPPA:.3f}, (L/kappa) atanh(delta_v/L) = {exact:.3f}"
        )


def later() -> Lines:
    """Section 4.3: "convergence of the errors of each triangle": V of the later ones rises meanwhile."""
    outcome = converge(Case(6), 0, 200, 200.0)
    for triangle, rise in enumerate(outcome.rise.T):
        settled = outcome.settled_rise[:, triangle]
        after = f", after the robots before stand in {(settled > 1e-9).sum()}" if triangle else ""
        yield f"n = 6, triangle {triangle + 1}: V rises in {(rise > 1e-9).sum()} of 200 starts{after}"


def thrown() -> Lines:
    """Section 4.3, "the whole structure will converge": long chains are thrown apart by saturated angles."""
    for case in (Case(6), Case(20), Case(50), Case(50, assigned=True), Case(50, slow_angles=True)):
        outcome = converge(case, 0, 20, 300.0)
        there, farthest = np.isfinite(outcome.time_s).sum(), np.median(outcome.farthest_m, axis=0)
        shown = ", ".join(f"R{k} {farthest[k - 1]:.2g} m" for k in (3, 6, 10, 20, 30, 40, 50) if k <= case.n)
        entries = SLOW if case.slow_angles else SATURATION
        yield f"n = {case.n}, {case.variant}, L = {entries}: {there} of 20 in formation after 300 s"
        yield f"  farthest from its place, median: {shown}"


def reference() -> Lines:
    """Section 4.3: "dynamically defined from the desired formation": in it, or built on the neighbours."""
    spread = pushed()
    for name, moved in zip(spread._fields, spread, strict=True):
        shown = " ".join(f"{distance:.2f}" for distance in moved)
        yield f"R3 of twelve pushed by 0.3 m, {name}: farthest from its place, R1 to R12: {shown} m"
    for case in (Case(6), Case(6, neighbours=True)):
        times = converge(case, 0, 200, 300.0).time_s
        there, median = int(np.isfinite(times).sum()), np.nanmedian(times)
        yield f"n = 6, 200 starts, {case.variant}: {there} in formation, median {median:.0f} s"


def units() -> Lines:
    """Section 7 gives I in s^3, B in s^2 and K in s for both impedances: one force can't have both units."""
    yield "eq. (13): I_u u_cor'' is s^3 m/s^3 = m, so F has to be in m, and b = 1 in 1/m"
    yield "eq. (14): I_w w_cor'' is s^3 rad/s^3 = rad, so the same F has to be without a unit"
    stiffness = Avoidance().angular.stiffness
    for scale, unit in ((1.0, "m"), (100.0, "cm")):
        force = scale * avoidance.force(Avoidance(), 0.5)
        yield f"F at 0.5 m is {force:.4f} {unit}: w_cor would rest at {force / stiffness:.2f} rad/s"


ERRATA: Mapping[str, Callable[[], Lines]] = {
    each.__name__: each
    for each in (
        position,
        arctangent,
        matrices,
        wrapping,
        mirror,
        collinear,
        saturation,
        linearised,
        later,
        thrown,
        reference,
        near,
        sine,
        twice,
        gains,
        units,
    )
}


def main(arguments: list[str] | None = None) -> None:
    """Print the figures of the named errata, or of all."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.errata", description="Errata of the paper, shown."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ERRATA)}; all by default")
    asked = parser.parse_args(arguments)
    if unknown := [name for name in asked.names if name not in ERRATA]:
        parser.error(f"no erratum {', '.join(unknown)}; there are {', '.join(ERRATA)}")
    for name in asked.names or ERRATA:
        print(f"{name}: {ERRATA[name].__doc__}")
        for line in ERRATA[name]():
            print(f"  {line}")


if __name__ == "__main__":
    main()
