"""`maniple log rerun`: in an open loop, and in a closed one."""

import json
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from typer.testing import CliRunner, Result

import maniple
from maniple.cli import realtime
from maniple.cli.loading import loads
from maniple.cli.log.group import app
from maniple.cli.machine import describe_machine
from maniple.cli.operator import publish
from maniple.cli.outcome import Outcome
from maniple.cli.progress import Progress
from maniple.cli.virtual import run_virtual
from maniple.core import codec, topics
from maniple.core.envelope import Envelope, envelope_of
from maniple.core.errors import ArgumentError, ManipleError, RecordingError, ScenarioError
from maniple.core.messages import (
    EmergencyStop,
    FaultPlan,
    FormationState,
    Goal,
    Journal,
    Message,
    Odometry,
)
from maniple.core.scenario.types import Crash, Fault
from maniple.core.time import SECOND, VIRTUAL_EPOCH, Time
from maniple.recording.reader import read
from maniple.recording.writer import RecordingWriter
from maniple.transport.zenoh import ZenohSession
from tests.cli.scenes import write
from tests.report.recordings import SCENE, filtered, recorded
from tests.transport.test_zenoh import free_port


def rerun(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["rerun", *map(str, arguments)])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("a"))


def test_the_same_parameters_give_the_same_bytes(log: Path) -> None:
    found = json.loads(rerun(log, "--json").stdout)
    assert found["identical"]
    assert found["complete"]
    assert found["changes"] == []
    assert [run["node"] for run in found["nodes"]] == ["controller", "r1", "r2", "r3", "r4"]
    assert all(topic["identical"] == topic["a"] == topic["b"] > 0 for topic in found["messages"])
    said = {r.topic for r in read(log).messages()} - {"sim/truth", "faults/decisions"}
    kinds = ("journal/", "links/", "hw/")
    assert {topic["topic"] for topic in found["messages"]} >= {t for t in said if not t.startswith(kinds)}
    result = rerun(log)
    assert result.exit_code == 0
    assert "identical:" in result.stdout
    assert "over time" not in result.stdout


def test_another_gain_gives_other_commands(log: Path) -> None:
    found = json.loads(rerun(log, "--set", "controller.kappa=0.5", "--json").stdout)
    assert [(change["field"], change["a"], change["b"]) for change in found["changes"]] == [
        ("controller.kappa", 0.25, 0.5)
    ]
    differ = {topic["topic"] for topic in found["messages"] if topic["beyond"]}
    assert differ == {f"robot/r{index}/command" for index in range(1, 5)}  # what the robots got is recorded
    rows = {(row["name"], row["field"]): row for row in found["series"]}
    assert rows["robot/r1/command", "vx_mps"]["largest"] > 0.01
    assert rows["robot/r1/command", "vx_mps"]["rms"] > 0
    assert rows["robot/r1/drive", "u_mps"]["largest"] == 0
    text = rerun(log, "--set", "controller.kappa=0.5")
    assert text.exit_code == 0
    assert "robot/*/command:values is beyond 0" in text.stdout


def test_another_guard_changes_what_drives_are_told(log: Path) -> None:
    found = json.loads(rerun(log, "--set", "guard.stop_after_s=0.05", "--node", "r2", "--json").stdout)
    assert [run["node"] for run in found["nodes"]] == ["r2"]
    (effort,) = found["effort"]
    assert effort["robot"] == "r2"
    assert effort["guarded_b"] > 0.5 > effort["guarded_a"]
    rows = {(row["name"], row["field"]): row for row in found["series"]}
    assert rows["robot/r2/drive", "u_mps"]["largest"] > 0.05


def test_another_gain_in_a_platoon_that_was_checked_before_it_began(tmp_path: Path) -> None:
    log = recorded(tmp_path, "preflight.enabled=true", "preflight.estop=false")
    assert json.loads(rerun(log, "--json").stdout)["identical"]
    found = json.loads(rerun(log, "--set", "controller.kappa=0.5", "--json").stdout)
    topics_of = {topic["topic"]: topic for topic in found["messages"]}
    assert {name for name, topic in topics_of.items() if topic["beyond"]} == {
        f"robot/r{index}/command" for index in range(1, 5)
    }
    assert not any(topic["only_a"] or topic["only_b"] for topic in topics_of.values())
    assert topics_of["robot/r1/status"]["identical"] == topics_of["robot/r1/status"]["a"]


def test_a_layer_that_is_left_out_does_not_hear_what_it_needed(tmp_path: Path) -> None:
    log = recorded(tmp_path, "placement.robot_from=drive")
    found = json.loads(rerun(log, "--set", "avoidance.enabled=false", "--json").stdout)
    assert found["complete"]
    assert not found["identical"]
    other = recorded(_folder(tmp_path, "b"), "placement.robot_from=drive", "avoidance.enabled=false")
    result = rerun(other, "--set", "avoidance.enabled=true")
    assert isinstance(result.exception, ArgumentError)
    assert "controller would need robot/r1/ranges" in str(result.exception)


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("rates.control_hz=20", "how often everybody is called is recorded"),
        ("network.fleet_latency_s=0.1", "when each message arrived is recorded"),
        ("faults.0.loss=0.5", "what the network did"),
        ("seed=2", "what chance did is recorded"),
        ("placement.robot_from=drive", "for the layers as they were placed"),
        ("robots.r4.id=r5", "those that were there"),
        ("preflight.enabled=true", "what the pre-flight check goes by"),
        ("robots.r2.driver=ros2", "who brought what each robot measured"),
        ("robots.r3.scans=ros2", "who brought what each robot sensed"),
    ],
)
def test_what_inputs_that_are_recorded_leave_no_room_for(log: Path, override: str, why: str) -> None:
    result = rerun(log, "--set", override)
    assert isinstance(result.exception, ArgumentError)
    assert why in str(result.exception)
    assert "use --closed-loop" in str(result.exception)


@pytest.mark.parametrize(
    ("arguments", "kind", "told"),
    [
        (["--node", "r9"], ArgumentError, "--node r9: must be one of controller, r1, r2, r3, r4, simulator"),
        (["--out", "x.mcap"], ArgumentError, "--closed-loop"),
        (["--closed-loop", "--node", "r1"], ArgumentError, "all nodes run"),
        (["--closed-loop", "--set", "robots.r1.driver=ros2"], ArgumentError, "robots.r1.driver=simulator"),
        (["--set", "controller.kapa=1"], ScenarioError, "controller.kapa"),
        (["--set", "kappa"], ScenarioError, "must be key=value"),
        (["--closed-loop", "--out", __file__], RecordingError, "exists already"),
        (["--closed-loop", "--out", "/nowhere/x.mcap"], RecordingError, "can't create"),
    ],
)
def test_bad_input_is_one_message(
    log: Path, arguments: list[str], kind: type[ManipleError], told: str
) -> None:
    result = rerun(log, *arguments)
    assert isinstance(result.exception, kind)
    assert told in str(result.exception)
    assert result.stdout == ""


def test_an_input_that_the_recording_lacks_is_told(log: Path, tmp_path: Path) -> None:
    lame = filtered(log, tmp_path / "l.mcap", lambda r: not (r.topic == "hw/r2/motion" and r.sequence == 40))
    result = rerun(lame, "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout)
    assert not found["complete"]
    problems = {run["node"]: run["problem"] for run in found["nodes"]}
    assert "lacks hw/r2/motion 40" in problems["r2"]
    assert not problems["r1"]
    assert "r2 (life 1): could be run up to call" in rerun(lame).stdout
    mute = filtered(log, tmp_path / "m.mcap", lambda r: r.topic != "journal/r3")
    assert "no journal of r3" in str(rerun(mute).exception)


def test_a_closed_loop_without_changes_gives_the_same_file(log: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    result = rerun(log, "--closed-loop", "--out", again)
    assert result.exit_code == 0, result.output
    assert "messages identical" in result.stdout
    assert again.read_bytes() == log.read_bytes()


def test_a_closed_loop_that_is_interrupted_leaves_nothing(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any) -> Outcome:
        return run_virtual(*arguments)._replace(interrupted=True)

    monkeypatch.setattr("maniple.cli.virtual.run_virtual", interrupted)
    assert rerun(log, "--closed-loop", "--out", tmp_path / "again.mcap").exit_code == 130
    assert not [*tmp_path.iterdir()]


def test_a_closed_loop_with_another_gain(log: Path) -> None:
    found = json.loads(rerun(log, "--closed-loop", "--set", "controller.kappa=0.5", "--json").stdout)
    beside = log.with_name("short-rerun.mcap")
    assert read(beside).scenario.controller.kappa == 0.5
    assert (found["by"], found["b"]) == ("time", str(beside))
    rows = {row["field"]: row for row in found["outcome"]}
    assert rows["peak_error.position_m"]["difference"] != 0
    assert "exists already" in str(rerun(log, "--closed-loop").exception)


PLAN = FaultPlan(since_ns=VIRTUAL_EPOCH)
SAID: tuple[tuple[float, str, Message], ...] = (
    (2.0, topics.FORMATION_GOAL, Goal(id="wait", hold=True)),
    (3.0, topics.PLAN, replace(PLAN, faults=(Fault(source="r1", loss=0.4),))),
    (4.0, topics.FORMATION_GOAL, Goal(id="go", hold=False)),
    (5.0, topics.PLAN, replace(PLAN, crashes=(Crash(node="r4", at_s=5.5, restart_after_s=1.0),))),
    (8.0, topics.STOP, EmergencyStop(stopped=True)),
    (9.0, topics.STOP, EmergencyStop(stopped=False)),
)


def _input(at_s: float, life: int, topic: str, message: Message) -> tuple[Time, Envelope]:
    now = VIRTUAL_EPOCH + round(at_s * SECOND)
    sent = replace(message, source="operator", incarnation=life, stamp_ns=now)
    return now, envelope_of(topic, codec.encode(sent))


def operated(path: Path, duration_s: float = 14.0) -> Path:
    """A virtual run, ended early, in which operators said a good deal."""
    scenario = loads(SCENE.encode())
    inputs = [_input(at_s, life, topic, said) for life, (at_s, topic, said) in enumerate(SAID, 1)]
    run_virtual(
        scenario, path, describe_machine(scenario, "virtual"), duration_s, lambda _: None, inputs=inputs
    )
    return path


def test_what_operators_said_is_said_again(tmp_path: Path) -> None:
    log = operated(tmp_path / "a.mcap")
    held = [m.phase for _, m in read(log).decoded(FormationState) if m.phase == "holding"]
    assert 15 <= len(held) <= 25
    assert {m.incarnation for _, m in read(log).decoded(Odometry) if m.source == "r4"} == {1, 2}
    assert rerun(log, "--closed-loop", "--out", tmp_path / "b.mcap").exit_code == 0
    assert (tmp_path / "b.mcap").read_bytes() == log.read_bytes()
    found = json.loads(rerun(log, "--json").stdout)
    assert found["identical"]
    assert [(run["node"], run["incarnation"]) for run in found["nodes"]][-2:] == [("r4", 1), ("r4", 2)]


def test_a_run_by_the_wall_clock_is_moved_to_virtual_time(tmp_path: Path) -> None:
    """The same recording, as if the run had begun at another time: what operators said comes as late as it
    was recorded, and the end is where it was."""
    later = 700_000_000 * SECOND
    log = operated(tmp_path / "a.mcap")
    moved = _moved(log, tmp_path / "moved.mcap", later)
    result = rerun(moved, "--closed-loop", "--out", tmp_path / "b.mcap", "--json")
    assert result.exit_code == 0, result.output
    again = read(tmp_path / "b.mcap")
    goals = [m.stamp_ns - VIRTUAL_EPOCH for _, m in again.decoded(Goal)]
    assert goals == [pytest.approx(at, abs=2_000_000) for at in (2 * SECOND, 4 * SECOND)]
    plans = [m for _, m in again.decoded(FaultPlan)]
    assert [m.since_ns for m in plans] == [VIRTUAL_EPOCH] * 2
    ends = [max(r.publish_time_ns for r in one.messages()) for one in (read(log), again)]
    assert ends[0] == pytest.approx(ends[1], abs=SECOND // 10)


@pytest.mark.slow
def test_a_real_run_in_which_an_operator_spoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Open loop: the same bytes. Closed loop: the platoon holds as long after the start as it did."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    monkeypatch.setattr(realtime, "free_endpoint", lambda: endpoint)
    words = [Goal(id="wait", hold=True), Goal(id="go", hold=False)]

    def speak(progress: Progress) -> None:
        if words and progress.task_time_s > 2.0 and (progress.phase == "holding") == (len(words) == 1):
            with ZenohSession.client(endpoint, "maniple") as session:
                publish(session, topics.FORMATION_GOAL, words.pop(0), 30.0)

    log = tmp_path / "real.mcap"
    assert maniple.run(write(tmp_path), speed=2.0, log=log, on_progress=speak).completed
    assert not words
    found = json.loads(rerun(log, "--json").stdout)
    assert found["identical"]
    assert found["complete"]
    assert rerun(log, "--closed-loop", "--out", tmp_path / "again.mcap").exit_code == 0
    runs = read(log), read(tmp_path / "again.mcap")
    begin = next(m.since_ns for _, m in runs[0].decoded(FaultPlan))
    said, again = ([(r.log_time_ns, m.id) for r, m in run.decoded(Goal)] for run in runs)
    assert [name for _, name in again] == [name for _, name in said]
    assert [at - VIRTUAL_EPOCH for at, _ in again] == pytest.approx([at - begin for at, _ in said], abs=2e6)
    assert "holding" in {m.phase for _, m in runs[1].decoded(FormationState)}


def _moved(source: Path, target: Path, by: int) -> Path:
    """A recording as if of a realtime run that began later, with the plan that its router begins with."""
    recording = read(source)
    metadata = {**recording.metadata, "mode": "realtime"}
    metadata.pop("prefix")
    begin = VIRTUAL_EPOCH + by
    plan = replace(PLAN, since_ns=begin, source="router", incarnation=1, stamp_ns=begin)
    with RecordingWriter(target, recording.scenario_json, metadata, prefix=recording.prefix) as writer:
        writer.write(topics.PLAN, codec.encode(plan), begin, begin, 0)
        for record in recording.messages():
            message = _later(record.decode(), by)
            data, sent = codec.encode(message), message.stamp_ns
            writer.write(record.topic, data, record.log_time_ns + by, sent, record.sequence)
    return target


def _later(message: Message, by: int) -> Message:
    message = replace(message, stamp_ns=message.stamp_ns + by)
    match message:
        case Journal(calls=calls):
            return replace(message, calls=tuple(replace(call, now_ns=call.now_ns + by) for call in calls))
        case FaultPlan(since_ns=since):
            return replace(message, since_ns=since + by)
        case _:
            return message


def _folder(parent: Path, name: str) -> Path:
    (parent / name).mkdir()
    return parent / name
