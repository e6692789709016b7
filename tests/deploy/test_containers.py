"""The platoon of `docker-compose.yml`, for real: an image built here, a container for each node, a robot cut
off from the fleet network, nodes killed from outside and by the plan. It goes on, and ends by itself."""

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from maniple.cli.loading import load
from maniple.cli.outcome import figures_of
from maniple.core import codec, topics
from maniple.core.messages import FormationState
from maniple.recording.reader import read
from maniple.report.summary import RunFigures
from maniple.transport.zenoh import DEFAULT_PORT, ZenohSession
from tests.deploy import motion, scene
from tests.deploy.engine import IMAGE, Compose, Images, answers, engine, missing, told
from tests.deploy.rights import require_root
from tests.waiting import eventually

pytestmark = pytest.mark.slow

CUT_S = 5.0
SETTLED_S = 8.0
"""Under way for so long, the platoon has its speed."""
RECOVERS_WITHIN_S = 30.0
NODES = {"router", "hardware-router", "recorder", "simulator", "controller", "finish", *scene.ROBOTS}
USER = (10001, 10001) if os.geteuid() == 0 else (os.getuid(), os.getgid())
"""Whose the recordings are to be: nobody's that the tests run as, where they may choose."""


class Ear:
    """What the controller says, heard from outside."""

    def __init__(self, endpoint: str) -> None:
        self.state: FormationState | None = None
        self._session = ZenohSession.client(endpoint, "maniple")
        self._session.subscribe(topics.FORMATION_STATE, self._heard)

    def _heard(self, topic: str, data: bytes, *_: Any) -> None:
        state = codec.decode(topic, data)
        assert isinstance(state, FormationState)
        self.state = state

    def under_way(self, life: int = 1) -> bool:
        """Whether the reference moves and all follow, as this life of the controller says."""
        state = self.state
        return (
            state is not None
            and state.incarnation >= life
            and state.phase == "running"
            and not state.waits_for
            and set(state.chain) == set(scene.ROBOTS)
        )

    def waits_for(self, robot: str) -> bool:
        return self.state is not None and robot in self.state.waits_for

    def close(self) -> None:
        self._session.close()


class Story(NamedTuple):
    """What was done to the platoon, and what became of it."""

    scenario: Path
    logs: list[Path]
    cut_at_s: float
    healed_at_s: float
    """Wall time, which is the time of the recording."""
    status: int
    states: dict[str, Any]
    figures: RunFigures
    said: str
    plan: str
    who: dict[str, Any]


@pytest.fixture(scope="module")
def environment() -> Iterator[dict[str, str]]:
    if not answers():
        require_root()
        assert not missing(), (
            f"no container engine answers, and to start one these are not there: {missing()}"
        )
    with engine() as found:
        yield found


@pytest.fixture(scope="module")
def compose(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Compose]:
    Images(environment).make()
    folder = tmp_path_factory.mktemp("containers")
    logs = folder / "logs"
    logs.mkdir()
    for path in (folder, *folder.parents[:2]):
        path.chmod(0o755)
    os.chown(logs, *USER)
    platoon = Compose(environment, f"maniple{os.getpid()}", scene.write(folder), logs, USER)
    try:
        yield platoon
    finally:
        platoon.down()


@pytest.fixture(scope="module")
def story(compose: Compose) -> Story:
    compose.up()
    eventually(lambda: compose.states().keys() >= NODES, 120.0)
    ear = Ear(f"tcp/{compose.address('router')}:{DEFAULT_PORT}")
    try:
        eventually(ear.under_way)
        time.sleep(SETTLED_S)
        compose.docker("network", "disconnect", "{}-fleet", "{}-r3")
        cut_at_s = time.time()
        time.sleep(CUT_S)
        healed_at_s = time.time()
        compose.docker("network", "connect", "{}-fleet", "{}-r3")
        eventually(ear.under_way, RECOVERS_WITHIN_S)

        compose.docker("kill", "{}-r5")
        eventually(lambda: ear.waits_for("r5"), 15.0)
        compose.docker("start", "{}-r5")
        eventually(ear.under_way, RECOVERS_WITHIN_S)

        plan = compose.shell("maniple", "fault", "crash", "r2", "--restart-after", "2")
        eventually(lambda: ear.waits_for("r2"), 15.0)
        eventually(ear.under_way, RECOVERS_WITHIN_S)

        compose.docker("kill", "{}-controller")
        compose.docker("start", "{}-controller")
        eventually(lambda: ear.under_way(life=2), RECOVERS_WITHIN_S)
        who = msgspec.json.decode(compose.shell("maniple", "status", "--json"))
    except AssertionError as error:
        raise AssertionError(
            f"{error}; the controller: {ear.state}; compose:\n{compose.said()[-5000:]}"
        ) from error
    finally:
        ear.close()
    status = compose.ended(150.0)
    logs = sorted(compose.logs.glob("*.mcap"))
    scenario = compose.scene
    figures = figures_of(logs, load(scenario))
    print(figures.command_age_ms, figures.messages)
    return Story(
        scenario, logs, cut_at_s, healed_at_s, status, compose.states(), figures, compose.said(), plan, who
    )


def test_up_ends_by_itself_when_the_task_is_done(story: Story) -> None:
    assert story.status == 0, story.said
    assert "the task is done" in story.said
    assert "left behind" not in story.said
    ended = {node: state["ExitCode"] for node, state in story.states.items() if node in NODES}
    assert ended == dict.fromkeys(NODES, 0)


def test_the_task_is_done_without_a_collision(story: Story) -> None:
    assert story.figures.completed
    assert story.figures.collisions == 0
    assert story.figures.min_clearance_m is not None
    assert story.figures.min_clearance_m > 0.05


def test_the_recording_is_whole(story: Story) -> None:
    [log] = story.logs
    assert "truncated" not in told([sys.executable, "-m", "maniple", "log", "info", str(log)], 60.0)
    assert (log.stat().st_uid, log.stat().st_gid) == USER
    lives = {
        (entry.message.source, entry.message.incarnation)
        for entry in read(log).messages()
        if entry.message is not None
    }
    assert {("controller", 1), ("controller", 2), ("r5", 2), ("r2", 2), ("r3", 1)} <= lives
    assert ("r3", 2) not in lives


def test_the_robot_that_is_cut_off_keeps_its_wheels_and_stands(story: Story) -> None:
    limits = motion.limits(story.scenario)
    stands_by_s = story.cut_at_s + limits.stop_s + 0.1 / limits.brake + 0.5
    assert stands_by_s < story.healed_at_s
    assert motion.fastest(story.logs, "r3", stands_by_s, story.healed_at_s) < motion.STANDS_MPS
    assert motion.fastest(story.logs, "r3", story.cut_at_s + 0.5, story.cut_at_s + 1.5) > 0.05


def test_the_shell_reaches_the_platoon(story: Story) -> None:
    assert "r2" in story.plan
    assert set(scene.ROBOTS) <= set(str(story.who).replace("'", " ").split())


def test_the_image_runs_without_rights(compose: Compose) -> None:
    image = compose.image()
    assert image["Config"]["User"] not in ("", "0", "root")
    assert image["Config"]["Healthcheck"]["Test"] == ["CMD", "healthy"]
    print(f"{image['Size'] / 1e6:.0f} MB")


def test_a_process_that_is_frozen_or_not_connected_is_not_healthy(compose: Compose) -> None:
    check = "sleep 60 & kill -STOP $!; sleep 0.1; healthy; echo $?; kill -KILL $!; healthy; echo $?"
    options = ("--rm", "--network", "none", "--entrypoint", "sh")
    said = compose.docker("run", *options, IMAGE, "-c", check)
    assert said.splitlines() == ["frozen", "1", "not connected to a router", "1"]
