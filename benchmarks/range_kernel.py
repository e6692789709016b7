"""The range kernel against one plain C loop over every beam and object, compiled on the spot.

Both run in this process on the same scenes and must agree; times are user + system. Small: 6 robots,
5 circles, 4 walls. Big: 100 robots, 50 circles, 4 walls. Robots are rectangles of four edges to both.
Where ir-sim is installed, its lidar is timed on the same number of robots and obstacles.
"""

import ctypes
import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import ir_sim
from benchmarks.common import Budget, Row, best_of, cpu_us, show
from maniple.core.geometry import Floats
from maniple.core.scenario.types import Circle, Obstacle, RangeFinder, Wall
from simulator.range_finder import Fan, sweep
from simulator.world import Complexes, Scene

TITLE = "Range kernel, one sweep of all robots"

SENSOR = RangeFinder(beams=181, first_angle_rad=-math.pi / 2, increment_rad=math.pi / 180, range_max_m=8.0)
BODY = 0.2555 + 0.2125j
SCENES = ((6, 5, 10.0, 3.0), (100, 50, 40.0, 0.1))
"""Robots, circles, side of the walled square (m), budget."""
IR_SIM_BUDGET = Budget(1.0 / 40.0, "ratio")

C_SOURCE = r"""
#include <math.h>

/* edges: ax ay bx by owner; circles: x y r; sensors: x y heading owner */
void scan(int sensors, const double *s, int beams, double first, double increment, double range_max,
          int circles, const double *c, int edges, const double *e, double *out)
{
    for (int i = 0; i < sensors; i++) {
        const double ox = s[4 * i], oy = s[4 * i + 1];
        for (int k = 0; k < beams; k++) {
            const double angle = s[4 * i + 2] + first + k * increment;
            const double dx = cos(angle), dy = sin(angle);
            double best = range_max;
            for (int j = 0; j < circles; j++) {
                const double x = c[3 * j] - ox, y = c[3 * j + 1] - oy, r = c[3 * j + 2];
                const double b = x * dx + y * dy, q = b * b - (x * x + y * y - r * r);
                if (q >= 0.0) {
                    const double t = b - sqrt(q);
                    if (t >= 0.0 && t < best) best = t;
                }
            }
            for (int j = 0; j < edges; j++) {
                if (e[5 * j + 4] == s[4 * i + 3]) continue;
                const double ax = e[5 * j] - ox, ay = e[5 * j + 1] - oy;
                const double ex = e[5 * j + 2] - e[5 * j], ey = e[5 * j + 3] - e[5 * j + 1];
                const double cross = dx * ey - dy * ex;
                const double t = (ax * ey - ay * ex) / cross, share = (ax * dy - ay * dx) / cross;
                if (share >= 0.0 && share <= 1.0 && t >= 0.0 && t < best) best = t;
            }
            out[i * beams + k] = best;
        }
    }
}
"""


class World:
    """Robots, circles and four walls at random places, none overlapping."""

    def __init__(self, robots: int, circles: int, side_m: float) -> None:
        random = np.random.default_rng(5)
        places: list[complex] = []
        while len(places) < robots + circles:
            place = complex(*random.uniform(-0.5 * side_m + 0.5, 0.5 * side_m - 0.5, 2))
            if all(abs(place - other) > 0.75 for other in places):
                places.append(place)
        h = 0.5 * side_m
        ends = ((-h, -h), (h, -h), (h, h), (-h, h))
        discs = [Circle(centre=(z.real, z.imag), radius_m=0.2) for z in places[robots:]]
        walls = [Wall(start=ends[i], end=ends[(i + 1) % 4]) for i in range(4)]
        self.obstacles: list[Obstacle] = [*discs, *walls]
        self.position: Complexes = np.array(places[:robots])
        self.heading: Floats = random.uniform(-math.pi, math.pi, robots)
        self.own = np.arange(robots)
        self.fan = Fan(SENSOR)
        self.scene = Scene(self.obstacles, np.full(robots, BODY))

    def kernel(self) -> Floats:
        """What the simulator does for a sweep of all robots."""
        self.scene.place(self.position, self.heading)
        return sweep(self.fan, self.position, self.heading, self.own, self.scene)

    def c_loop(self, library: ctypes.CDLL) -> Callable[[], Floats]:
        """The C loop over the same world."""
        self.scene.place(self.position, self.heading)
        scene, z = self.scene, self.position
        start, end = scene.middle - scene.half, scene.middle + scene.half
        owner = (scene.shape - scene.first_robot).astype(np.float64)
        sensors = np.stack([z.real, z.imag, self.heading, self.own.astype(np.float64)], axis=1)
        circles = np.stack([scene.circles.real, scene.circles.imag, scene.radii], axis=1)
        edges = np.stack([start.real, start.imag, end.real, end.imag, owner], axis=1)
        out = np.empty((len(z), SENSOR.beams))
        arrays = [np.ascontiguousarray(a) for a in (sensors, circles, edges)]
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (*arrays, out)]
        fan = (SENSOR.first_angle_rad, SENSOR.increment_rad, SENSOR.range_max_m)
        arguments = [
            *(ctypes.c_int(len(z)), pointers[0], ctypes.c_int(SENSOR.beams)),
            *(ctypes.c_double(number) for number in fan),
            *(ctypes.c_int(len(circles)), pointers[1], ctypes.c_int(len(edges)), *pointers[2:]),
        ]

        def run(_keep: list[Floats] = arrays) -> Floats:
            library.scan(*arguments)
            return out

        return run


def compiled(folder: Path) -> ctypes.CDLL:
    """The C loop as a library."""
    source, library = folder / "scan.c", folder / "scan.so"
    source.write_text(C_SOURCE)
    command = ["cc", "-O3", "-march=native", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def timed(kernel: Callable[[], object], reference: Callable[[], object], rounds: int) -> tuple[float, float]:
    """The least CPU time (us) of one call of each."""
    return best_of(lambda: cpu_us(kernel, 0.1), lambda: cpu_us(reference, 0.1), rounds)


def rows(quick: bool = False) -> list[Row]:
    """CPU time of a sweep of all robots, against the C loop and ir-sim, each where it can be had.

    Raises:
        AssertionError: kernel and C loop disagree.
    """
    table = []
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder)) if shutil.which("cc") else None
        for robots, circles, side_m, limit in SCENES:
            world = World(robots, circles, side_m)
            table.append(_against_c(world, library, Budget(limit, "ratio"), 1 if quick else 7))
            if not quick:
                table.append(_against_ir_sim(world, side_m, Path(folder)))
    return table


def _against_c(world: World, library: ctypes.CDLL | None, budget: Budget, rounds: int) -> Row:
    name = f"{len(world.own)} robots"
    if library is None:
        return Row(name, cpu_us(world.kernel), "us", "C loop: no compiler cc", None, budget)
    c_loop = world.c_loop(library)
    differences = np.abs(world.kernel() - c_loop())
    assert (differences > 1e-6).sum() <= 2, f"kernel and C loop disagree by {differences.max()} m"
    ours, reference = timed(world.kernel, c_loop, rounds)
    return Row(name, ours, "us", "C loop", reference, budget)


def _against_ir_sim(world: World, side_m: float, folder: Path) -> Row:
    name = f"{len(world.own)} robots"
    if not ir_sim.IS_HERE:
        return Row(name, cpu_us(world.kernel), "us", ir_sim.MISSING, None, IR_SIM_BUDGET)
    ours, reference = timed(world.kernel, ir_sim_sweep(world, side_m, folder), 2)
    return Row(name, ours, "us", "ir-sim", reference, IR_SIM_BUDGET)


def ir_sim_sweep(world: World, side_m: float, folder: Path) -> Callable[[], object]:
    """One step of the lidars of all robots of the same world in ir-sim."""
    poses = [
        (z.real, z.imag, psi) for z, psi in zip(world.position.tolist(), world.heading.tolist(), strict=True)
    ]
    body = ir_sim.Body(2 * BODY.real, 2 * BODY.imag)
    robots = ir_sim.environment(poses, body, SENSOR, world.obstacles, (side_m, side_m), folder).robot_list

    def run() -> None:
        for member in robots:
            member.sensor_step()

    return run


if __name__ == "__main__":
    show(TITLE, rows())
