"""A whole run in virtual time against ir-sim's own loop, in simulated seconds per CPU second.

Ours: physics at 100 Hz, odometry and drives at 20 Hz, scans, avoidance and control at 10 Hz, every message
encoded, checked, decoded, journaled and recorded to a file. ir-sim: motion and the same lidar (181 beams)
at 10 Hz, headless, and nothing else: no controller, no messages, no recording. Both get the same robots
and obstacles. ir-sim is not needed: where it is not installed, only our figure is given.
"""

import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks import ir_sim
from benchmarks.common import Budget, Row, best_of, cpu_s, show
from maniple import run
from maniple.cli.loading import completed, load
from maniple.core.scenario.types import Circle, Formation, Line, Robot, Scenario, World

TITLE = "Virtual run, everything on, simulated seconds per CPU second"

PAPER = Path(__file__).parent.parent / "scenarios" / "paper-simulation-1.toml"
UNIT = "s/s"


class Size(NamedTuple):
    """How long a platoon is run, simulated s, and what it has to reach."""

    robots: int
    ours_s: float
    ir_sim_s: float
    budget: Budget | None = None


SIZES = (
    Size(6, 165.0, 20.0, Budget(100.0, "ours", "at least")),
    Size(50, 20.0, 2.0),
    Size(100, 10.0, 1.0),
)


def rows(quick: bool = False) -> list[Row]:
    """One row for each size of platoon."""
    sizes = [Size(6, 5.0, 1.0, SIZES[0].budget), Size(50, 1.0, 0.3)] if quick else SIZES
    return [_row(size, rounds=1 if quick else 2) for size in sizes]


def _row(size: Size, rounds: int) -> Row:
    scenario = load(PAPER) if size.robots == 6 else platoon(size.robots)
    name = f"{size.robots} robots"
    with tempfile.TemporaryDirectory() as folder:
        ours = partial(simulated_per_cpu, scenario, size.ours_s, Path(folder))
        if not ir_sim.IS_HERE:
            value = max(ours() for _ in range(rounds))
            return Row(name, value, UNIT, ir_sim.MISSING, None, size.budget)
        step = ir_sim_step(scenario, Path(folder))
        theirs = partial(ir_sim_per_cpu, step, size.ir_sim_s)
        value, reference = best_of(ours, theirs, rounds, max)
    return Row(name, value, UNIT, "ir-sim: motion, lidar", reference, size.budget)


def platoon(robots: int) -> Scenario:
    """A chain of `robots` in two columns along a line, with an obstacle beside the way of every other one,
    and the parameters of the paper's scene otherwise."""
    paper = load(PAPER)
    points = tuple((-0.8 * i, -0.9 if i % 2 else 0.9) for i in range(robots))
    obstacles = tuple(Circle(centre=(x + 1.1, math.copysign(0.45, y)), radius_m=0.15) for x, y in points[::2])
    scenario = Scenario(
        name=f"platoon-{robots}",
        robots=tuple(Robot(id=f"r{i}", control_point_m=0.3) for i in range(1, robots + 1)),
        formation=Formation(points=points),
        task=Line(start=(0.0, 0.0), end=(15.0, 0.0), speed_mps=0.1),
        world=World(obstacles=obstacles),
        controller=paper.controller,
        avoidance=paper.avoidance,
        placement=paper.placement,
        guard=paper.guard,
    )
    return completed(scenario)


def simulated_per_cpu(scenario: Scenario, duration_s: float, folder: Path) -> float:
    """Simulated seconds of a recorded virtual run per CPU second, start and summary included."""
    log = folder / "run.mcap"
    results = []
    spent = cpu_s(lambda: results.append(run(scenario, virtual=True, duration_s=duration_s, log=log)))
    log.unlink()
    return results[0].duration_s / spent


def ir_sim_per_cpu(step: Callable[[], object], duration_s: float) -> float:
    """Simulated seconds of ir-sim per CPU second."""
    steps = round(duration_s / ir_sim.STEP_S)

    def loop() -> None:
        for _ in range(steps):
            step()

    return steps * ir_sim.STEP_S / cpu_s(loop)


def ir_sim_step(scenario: Scenario, folder: Path) -> Callable[[], object]:
    """One step of ir-sim in the world of a scenario: all robots drive straight on."""
    first = scenario.robots[0]
    model = scenario.model_of(first)
    poses = [robot.pose for robot in scenario.robots if robot.pose is not None]
    body = ir_sim.Body(model.length_m, model.width_m)
    sensor = scenario.sensor_of(first)
    environment = ir_sim.environment(poses, body, sensor, scenario.world.obstacles, (200.0, 20.0), folder)
    return partial(environment.step, [[0.1, 0.0]] * len(poses), list(range(len(poses))))


if __name__ == "__main__":
    show(TITLE, rows())
