import json
import signal
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from typer.testing import CliRunner

import maniple
from maniple.cli.loading import loads
from maniple.cli.log.group import app
from maniple.cli.log.proving import groups
from maniple.core.errors import ArgumentError, ManipleError, RecordingError, ScenarioError
from maniple.core.time import SECOND
from maniple.recording.cut import cut
from maniple.recording.reader import Recorded, read
from maniple.recording.recover import recover
from maniple.recording.selection import Selection
from tests.cli.scenes import SMALL, start
from tests.host.recorded import flipped, rewrite, without

CHAOS = (
    SMALL
    + """
faults = [{ loss = 0.3, latency_s = 0.15, jitter_s = 0.15, corrupt = 0.05, duplicate = 0.1 }]
crashes = [
    { node = "r2", at_s = 2.1, restart_after_s = 1 },
    { node = "controller", at_s = 4, restart_after_s = 1 },
]
freezes = [{ node = "r3", at_s = 1.5, for_s = 1 }]
clocks = [{ node = "r1", offset_s = 100, skew_ppm = 100 }]
"""
)
SECONDS = 8.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots with all that goes wrong, in virtual time."""
    log = tmp_path_factory.mktemp("run") / "run.mcap"
    maniple.run(loads(CHAOS.encode()), virtual=True, duration_s=SECONDS, log=log)
    return log


def said(*arguments: object, status: int = 0) -> str:
    result = CliRunner().invoke(app, ["verify", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == status, result.output
    return result.stdout


def figures(*arguments: object, status: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(said(*arguments, "--json", status=status))
    return found


def same(record: Recorded) -> Iterable[Recorded]:
    return (record,)


def test_all_nodes_are_proved(run: Path) -> None:
    found = figures(run)
    assert found["holds"] is True
    assert (found["mode"], found["scenario"]) == ("virtual", "small")
    assert [(one["node"], one["incarnation"]) for one in found["lives"]] == [
        ("simulator", 1),
        ("controller", 1),
        ("controller", 2),
        ("r1", 1),
        ("r2", 1),
        ("r2", 2),
        ("r3", 1),
    ]
    assert {one["verdict"] for one in found["lives"]} == {"identical"}
    assert all(one["unproved_s"] <= 0.2 for one in found["lives"])
    assert (found["problems"], found["notes"], found["others"]) == ([], [], [])
    assert found["real_time_factor"] > 1


def test_for_people(run: Path) -> None:
    text = said(run)
    assert "identical" in text
    assert "r2 (life 1): killed, or the recording ends: its last 0." in text
    assert "proved: " in text
    assert "messages are identical; 7 lives of 5 nodes, 9." in text


def test_some_nodes_and_several_processes(run: Path) -> None:
    alone = figures(run, "--node", "r2", "--node", "controller", "--jobs", 1)
    together = figures(run, "--node", "r2", "--node", "controller", "--jobs", 2)
    for found in (alone, together):
        assert found["nodes"] == ["controller", "r2"]
        found.pop("wall_s"), found.pop("real_time_factor")
    assert alone == together


def test_a_gain_that_acted_and_one_that_did_not(run: Path, tmp_path: Path) -> None:
    scenario = read(run).scenario
    kappa = scenario.controller.kappa
    assert isinstance(kappa, float)
    altered = replace(scenario.controller, kappa=kappa * (1 + 1e-9))
    path = rewrite(run, tmp_path / "kappa.mcap", same, replace(scenario, controller=altered))
    found = figures(path, "--trace", 3, status=1)
    by_node = {(one["node"], one["incarnation"]): one for one in found["lives"]}
    assert by_node["simulator", 1]["verdict"] == "identical"
    first = by_node["controller", 1]["divergence"]
    assert first["topic"].endswith("/command")
    assert first["field"] == "values[0]"
    assert first["recomputed"] == pytest.approx(first["recorded"], rel=1e-8)
    assert first["recomputed"] != first["recorded"]
    assert (first["name"], len(first["trace"])) == ("control", 4)
    assert figures(path, "--tolerance", "1e-6")["lives"][1]["verdict"] == "within tolerance"
    text = said(path, "--trace", 3, status=1)
    assert "controller (life 1) first diverges at call" in text
    assert "values[0]: recorded " in text
    assert text.count("the calls up to then:") == 1
    assert "NOT proved, " in text

    unused = replace(scenario, guard=replace(scenario.guard, gamma_per_s=scenario.guard.gamma_per_s + 1e-9))
    found = figures(rewrite(run, tmp_path / "unused.mcap", same, unused))
    assert found["holds"] is True
    (note,) = [one for one in found["notes"] if "another scenario" in one]
    assert note.startswith("controller (life 1), controller (life 2), r1 (life 1), ")


def test_another_scenario_than_the_recording_says(run: Path, tmp_path: Path) -> None:
    scenario = read(run).scenario
    path = rewrite(run, tmp_path / "seed.mcap", same, replace(scenario, seed=scenario.seed + 1))
    found = figures(path, status=1)
    was, now = scenario.seed, scenario.seed + 1
    assert f"it says that its seed is {was}, the attached scenario says {now}" in found["problems"]


def test_a_bit_that_was_flipped(run: Path, tmp_path: Path) -> None:
    found = figures(rewrite(run, tmp_path / "a.mcap", flipped("hw/r1/drive", 20, -3)), status=1)
    verdicts = {one["node"]: one["verdict"] for one in found["lives"] if one["verdict"] != "identical"}
    assert verdicts.keys() <= {"r1", "simulator"}
    assert verdicts


def test_an_input_that_is_lacking(run: Path, tmp_path: Path) -> None:
    path = rewrite(run, tmp_path / "a.mcap", without("hw/r1/motion", 30))
    found = figures(path, status=1)
    lacking = [one for one in found["lives"] if one["verdict"] == "unproved"]
    assert [one["node"] for one in lacking] == ["r1"]
    assert "the recording lacks hw/r1/motion 30 of simulator (life 1)" in lacking[0]["reason"]
    assert "the recording lacks hw/r1/motion 30 of simulator (life 1)" in said(path, status=1)


def test_another_machine_and_version_are_told_of(run: Path, tmp_path: Path) -> None:
    from maniple.core.scenario.parse import to_json
    from maniple.recording.writer import RecordingWriter

    before = read(run)
    about = {**before.metadata, "maniple": "0.0.1", "numpy": "1.0", "cpu_features": "MMX"}
    with RecordingWriter(tmp_path / "a.mcap", to_json(before.scenario), about, prefix="maniple") as writer:
        for record in before.messages():
            writer.write(*record)
    notes = figures(tmp_path / "a.mcap")["notes"]
    assert notes[0].startswith("the recording was made by version 0.0.1, this is ")
    assert "it was made on another machine type (numpy 1.0, here " in notes[1]
    assert "CPU features only there MMX, only here " in notes[1]
    assert "use --tolerance" in notes[1]


def test_what_was_left_out_is_told_of(run: Path, tmp_path: Path) -> None:
    recording = read(run)
    cut(recording, Selection(end_ns=recording.start_ns + 2 * SECOND), tmp_path / "cut.mcap")
    found = figures(tmp_path / "cut.mcap")
    assert found["notes"] == ["left out on purpose: from 2.000 s: cut off"]


def test_a_recording_that_was_not_finished(run: Path, tmp_path: Path) -> None:
    data = run.read_bytes()
    path = tmp_path / "a.mcap"
    path.write_bytes(data[: len(data) * 2 // 3])
    found = figures(path)
    assert {one["ended"] for one in found["lives"]} == {"cut"}
    assert any("did not finish" in note for note in found["notes"])
    recovered = recover(path)
    assert recovered.lost_bytes > 0
    told = f"it was recovered from a file of which {recovered.lost_bytes} bytes were lost"
    assert told in figures(Path(recovered.out))["notes"]


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        (["--node", "r9"], ArgumentError, "no such node; it has simulator, controller, r1, r2, r3"),
        (["--tolerance", "much"], ArgumentError, "tolerance 'much': must be a number"),
        (["--tolerance", "x_m=-1"], ArgumentError, "FIELD=NUMBER"),
    ],
)
def test_bad_arguments(run: Path, arguments: list[str], error: type[ManipleError], text: str) -> None:
    result = CliRunner().invoke(app, ["verify", str(run), *arguments])
    assert isinstance(result.exception, error)
    assert text in str(result.exception)


def test_a_layer_that_is_not_installed(run: Path, tmp_path: Path) -> None:
    scenario = read(run).scenario
    foreign = replace(scenario, controller=replace(scenario.controller, law="my-own"))
    path = rewrite(run, tmp_path / "a.mcap", same, foreign)
    result = CliRunner().invoke(app, ["verify", str(path)])
    assert isinstance(result.exception, ScenarioError)
    assert "no such formation-law is installed" in str(result.exception)


def test_what_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"garbage")
    result = CliRunner().invoke(app, ["verify", str(path)])
    assert isinstance(result.exception, RecordingError)


def test_help_says_what_the_status_means() -> None:
    text = " ".join(CliRunner().invoke(app, ["verify", "--help"]).stdout.split())
    assert "Exit status: 0 all that they send is as recorded" in text


def test_work_is_shared_out_evenly() -> None:
    nodes = ("simulator", "controller", "r1", "r2", "r3", "r4")
    assert groups(nodes, 1) == [nodes]
    assert groups(nodes, 2) == [("simulator", "r1", "r3"), ("controller", "r2", "r4")]
    assert groups(("r1", "r2"), 8) == [("r1",), ("r2",)]
    assert groups(("simulator",), 2) == [("simulator",)]


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_ends_it_and_leaves_nothing(tmp_path: Path, jobs: int) -> None:
    log = tmp_path / "long.mcap"
    maniple.run(loads(SMALL.encode()), virtual=True, duration_s=60.0, log=log)
    with start("log", "verify", log, "--jobs", jobs, start_new_session=True) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.communicate(timeout=0.8)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert out == ""
