"""Real TCP over links that lose a fifth of their packets and take 0.1 s each way, and one that is cut."""

import shutil
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from maniple.cli.loading import load
from maniple.cli.outcome import figures_of
from maniple.report.summary import RunFigures
from tests.deploy import motion, scene
from tests.deploy.namespaces import HARDWARE, PORT, Namespaces, platoon
from tests.deploy.rights import require_root
from tests.waiting import eventually

pytestmark = pytest.mark.slow

DELAY_S, LOSS = 0.1, 0.2
CUT_S = 5.0
SETTLED_S = 12.0
"""Under way for so long, the platoon has its speed."""


class Run(NamedTuple):
    """What became of a run."""

    scenario: Path
    log: Path
    cut_at_s: float
    healed_at_s: float
    """Wall time, which is the time of the recording."""
    figures: RunFigures
    left_behind: list[str]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    require_root()
    missing = [program for program in ("ip", "iptables", "sysctl") if shutil.which(program) is None]
    assert not missing, f"not installed: {', '.join(missing)} (iproute2, iptables, procps)"
    folder = tmp_path_factory.mktemp("namespaces")
    scenario, log = scene.write(folder), folder / "run.mcap"
    networks = Namespaces(
        scene.ROBOTS, ("router", "controller", "recorder", "finish"), wired=("recorder", "finish")
    )
    with platoon(networks, folder, DELAY_S, LOSS) as processes:
        fleet, hardware = (f"tcp/{at}:{PORT}" for at in (networks.address("router"), f"{HARDWARE}.1"))
        common = ("--scenario", scenario, "--wait", 60)
        both = (*common, "--connect", fleet, "--hardware", hardware)
        processes.start("router", "router", "router", *common[:2], "--listen", fleet)
        processes.start("wires", "simulator", "router", *common[:2], "--listen", hardware)
        processes.listens("router")
        processes.listens("wires")
        processes.start("recorder", "recorder", "recorder", *both, "--log", log)
        eventually(log.exists)
        processes.start("simulator", "simulator", "simulator", *common, "--connect", hardware)
        for robot in scene.ROBOTS:
            processes.start(robot, robot, "agent", robot, *both)
        processes.start("controller", "controller", "controller", *common, "--connect", fleet)
        processes.start("finish", "finish", "finish", *both)
        eventually(lambda: "running" in processes.said("finish"), 120.0)
        time.sleep(SETTLED_S)
        networks.cut("r3", True)
        cut_at_s = time.time()
        time.sleep(CUT_S)
        healed_at_s = time.time()
        networks.cut("r3", False)
        assert processes.status("finish", 240.0) == 0, processes.said("finish")
        said = {name: processes.said(name) for name in scene.ROBOTS}
        assert not any(said.values()), said
        left_behind = [line for line in processes.said("finish").splitlines() if "left behind" in line]
    figures = figures_of([log], load(scenario))
    print(figures.command_age_ms, figures.messages)
    return Run(scenario, log, cut_at_s, healed_at_s, figures, left_behind)


def test_the_task_is_done_without_a_collision(run: Run) -> None:
    figures = run.figures
    assert figures.completed
    assert figures.collisions == 0
    assert figures.min_clearance_m is not None
    assert figures.min_clearance_m > 0.05
    assert run.left_behind == []


def test_the_links_were_as_bad_as_told(run: Run) -> None:
    """Where TCP sends lost packets again, what arrives is late: half of all is older than two ways, and a
    command period; what one robot was not told while it was cut off is missing."""
    ages, messages = run.figures.command_age_ms, run.figures.messages
    assert ages is not None
    assert ages.p50 is not None
    assert ages.p50 > 1000 * 2 * DELAY_S + 100
    assert messages.lost_injected == 0
    assert 0 < messages.lost_other < 0.2 * messages.sent


def test_the_robot_that_is_cut_off_stands_and_goes_on(run: Run) -> None:
    limits = motion.limits(run.scenario)
    stands_by_s = run.cut_at_s + limits.stop_s + 0.1 / limits.brake + 0.5
    assert stands_by_s < run.healed_at_s
    assert motion.fastest([run.log], "r3", stands_by_s, run.healed_at_s) < motion.STANDS_MPS
    assert motion.fastest([run.log], "r3", run.healed_at_s, run.healed_at_s + 30.0) > 0.05
