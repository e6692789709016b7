"""Goals, as they are read and as a real controller answers them."""

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from central_controller.node import CentralController
from maniple.cli import goal_command
from maniple.cli.goal_command import GoalTables, app, load, tables_of
from maniple.cli.loading import loads
from maniple.core import codec, topics
from maniple.core.errors import ManipleError, RunError, ScenarioError
from maniple.core.scenario.types import Formation, Line, Positioning, Samples, Shape
from maniple.core.time import SECOND
from maniple.host.clock import Anchor
from maniple.host.realtime import RealtimeHost
from maniple.host.router import serve
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import SMALL
from tests.transport.test_zenoh import DEADLINE_S, free_port


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def asked(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Any:
    """(hold, tables, connect, prefix, json, timeout) of a command that would be sent."""
    sent: list[Any] = []
    monkeypatch.setattr(goal_command, "_order", lambda *what: sent.append(what))
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    return sent[0]


# -- what is asked for


def test_hold_and_resume(monkeypatch: pytest.MonkeyPatch) -> None:
    assert asked(monkeypatch, "hold")[:2] == (True, GoalTables())
    assert asked(monkeypatch, "resume", "--prefix", "a/b", "--timeout", 2, "--json")[2:] == (
        "tcp/127.0.0.1:7447",
        "a/b",
        True,
        2.0,
    )


def test_the_platoon_is_found_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MANIPLE_CONNECT", "tcp/10.0.0.1:1")
    assert asked(monkeypatch, "hold")[2] == "tcp/10.0.0.1:1"
    assert asked(monkeypatch, "hold", "--connect", "tcp/10.0.0.2:1")[2] == "tcp/10.0.0.2:1"


def test_targets_may_be_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    (_, tables, *_) = asked(monkeypatch, "target", "-1.5", "2", "-0.5", "--tolerance-m", 0.1, "--settle", 3)
    assert tables.task == Positioning(target=(-1.5, 2.0, -0.5), tolerance_m=0.1, settle_s=3.0)


def test_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    (_, tables, *_) = asked(monkeypatch, "line", "-1", "-2", "3", "4", "--speed", "0.1")
    assert tables.task == Line(start=(-1, -2), end=(3, 4), speed_mps=0.1)


def test_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    (_, tables, *_) = asked(monkeypatch, "shape", "vee", "--spacing", 1.5)
    assert tables == GoalTables(formation=Formation(shape=Shape(kind="vee", spacing_m=1.5)))


def test_a_file_has_a_task_a_formation_or_both(tmp_path: Path) -> None:
    path = tmp_path / "goal.toml"
    path.write_text('[task]\nkind = "csv"\nfile = "way.csv"\n[formation]\npoints = [[1, 0], [0, 1], [0, -1]]')
    (tmp_path / "way.csv").write_text("t_s,x_m,y_m\n0,0,0\n9,1,0\n")
    assert load(path) == GoalTables(
        task=Samples(times_s=(0, 9), poses=((0, 0, 0), (1, 0, 0))),
        formation=Formation(points=((1, 0), (0, 1), (0, -1))),
    )


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "has neither [task] nor [formation]; must have one of them, or both"),
        ({"name": "x"}, "name: unknown field; valid: task, formation"),
        ({"task": {"kind": "arc"}}, "task.kind = 'arc': must be one of line, "),
        (
            {"task": {"kind": "line", "start": [0, 0], "end": [0, 0], "speed_mps": 1}},
            "task.end = [0.0, 0.0]: is where task.start is",
        ),
        (
            {"formation": {"shape": {"kind": "star", "spacing_m": 1}}},
            "formation.shape.kind = 'star': must be",
        ),
    ],
)
def test_what_can_be_refused_before_it_is_sent(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        tables_of(data)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("line", 0, 0, 1, 0, "--speed", -1), "task.speed_mps = -1.0: must be a finite number > 0"),
        (("target", "nan", 0, 0), "task.target[0] = nan: must be a finite number"),
        (("shape", "vee", "--spacing", 0), "formation.shape.spacing_m = 0.0: must be a finite number > 0"),
        (("hold", "--prefix", "a//b"), "prefix = 'a//b': must be text that matches"),
    ],
)
def test_units_and_bounds_are_those_of_scenarios(arguments: tuple[object, ...], message: str) -> None:
    result = invoke(*arguments)
    assert isinstance(result.exception, ScenarioError)
    assert str(result.exception).startswith(message)


@pytest.mark.parametrize(
    "arguments",
    [
        ("target", 1, 2),
        ("target", 1, 2, "north"),
        ("line", 0, 0, 1, 1),
        ("target", 1, 2, 3, "--tolerence-m", 1),
        ("hold", "--timeout", 0),
        ("hold", "--connect", "localhost"),
        ("wait",),
    ],
)
def test_wrong_usage_is_status_2(arguments: tuple[object, ...]) -> None:
    assert invoke(*arguments).exit_code == 2


def test_a_file_that_is_wrong_is_named(tmp_path: Path) -> None:
    path = tmp_path / "goal.toml"
    for text, message in (("task = 3", "task = 3: must be a table"), ("task = ", "not valid TOML")):
        path.write_text(text)
        with pytest.raises(ScenarioError) as caught:
            load(path)
        assert str(caught.value).startswith(f"{path}: {message}")
    with pytest.raises(ScenarioError, match=r"no\.toml: can't be read: No such file"):
        load(tmp_path / "no.toml")


# -- what a controller answers


@pytest.fixture(scope="module")
def platoon() -> Iterator[str]:
    """The endpoint of a router with a controller whose robots are not there yet."""
    scenario = loads(SMALL.encode())
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohSession.router(endpoint, "maniple") as router:
        serve(router)
        with ZenohSession.client(endpoint, "maniple") as session:
            host = RealtimeHost(CentralController(scenario), 1, scenario, Anchor.here(), session, session)
            alive: SimpleQueue[str] = SimpleQueue()
            router.watch(lambda node, *_: alive.put(node))
            thread = threading.Thread(target=host.run)
            thread.start()
            try:
                while alive.get(timeout=DEADLINE_S) != "controller":
                    pass
                yield endpoint
            finally:
                host.stop()
                thread.join()


def answered(endpoint: str, *arguments: object) -> tuple[int, dict[str, Any]]:
    result = invoke(*arguments, "--connect", endpoint, "--timeout", 20, "--json")
    assert not isinstance(result.exception, ManipleError), result.exception
    return result.exit_code, json.loads(result.stdout)


def test_goals_are_accepted_and_refused_by_a_real_controller(platoon: str) -> None:
    status, first = answered(platoon, "hold")
    assert (status, first["accepted"], first["refused"]) == (0, True, "")
    status, line = answered(platoon, "line", 0, 0, 2, 0, "--speed", 0.1)
    assert (status, line["task_duration_s"]) == (0, pytest.approx(20.0))
    assert line["goal"] != first["goal"]
    assert line["connect"] == platoon
    status, refused = answered(platoon, "line", 0, 0, 2, 0, "--speed", 5)
    assert (status, refused["accepted"]) == (1, False)
    assert refused["refused"].startswith("task.speed_mps = 5.0: too fast for robots[0] (r1)")
    assert answered(platoon, "shape", "wedge", "--spacing", 1.2)[0] == 0
    assert answered(platoon, "resume")[0] == 0


def test_people_are_told_in_words(platoon: str) -> None:
    accepted = invoke("target", 1, 0, 0, "--connect", platoon, "--timeout", 20)
    assert accepted.exit_code == 0
    assert accepted.stdout.startswith("accepted: waiting, at 0.0 of ")
    assert accepted.stdout.endswith(f" s ({platoon})\n")
    refused = invoke("shape", "vee", "--spacing", 90_000, "--connect", platoon, "--timeout", 20)
    assert refused.exit_code == 1
    assert refused.stdout.startswith("refused: formation.points[")
    assert refused.stdout.endswith(f" ({platoon})\n")


def test_nobody_there_is_a_failure_not_a_mistake(platoon: str) -> None:
    alone = invoke("hold", "--connect", platoon, "--prefix", "other", "--timeout", 1)
    assert isinstance(alone.exception, RunError)
    assert str(alone.exception) == f"{platoon}: no controller is running there"
    nowhere = invoke("hold", "--connect", "tcp/127.0.0.1:1", "--timeout", 0.3)
    assert isinstance(nowhere.exception, RunError)
    assert "can't reach a router at tcp/127.0.0.1:1" in str(nowhere.exception)


def test_a_controller_that_says_nothing_is_given_up() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohSession.router(endpoint, "maniple") as router,
        ZenohSession.client(endpoint, "maniple") as mute,
    ):
        serve(router)
        mute.announce("controller", 1)
        result = invoke("hold", "--connect", endpoint, "--timeout", 1.2)
    assert isinstance(result.exception, RunError)
    assert str(result.exception) == f"{endpoint}: the controller did not answer within 1.2 s"


def test_goals_carry_the_time_of_the_run() -> None:
    """Of one that began at 7 s, twice as fast as the wall clock."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    goals: SimpleQueue[bytes] = SimpleQueue()
    clock = Anchor(7 * SECOND, time.monotonic_ns(), 2.0)
    with (
        ZenohSession.router(endpoint, "maniple") as router,
        ZenohSession.client(endpoint, "maniple") as mute,
    ):
        serve(router, clock)
        mute.announce("controller", 1)
        mute.subscribe(topics.FORMATION_GOAL, lambda _, data: goals.put(data))
        mute.settle()
        invoke("hold", "--connect", endpoint, "--timeout", 1.2)
        message = codec.decode(topics.FORMATION_GOAL, goals.get(timeout=DEADLINE_S))
        assert 7 * SECOND < message.stamp_ns < clock.now()
