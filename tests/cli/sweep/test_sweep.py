"""Whole sweeps, from the command line."""

import json
import math
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest

import maniple
from maniple.cli import main as program
from maniple.cli.sweep.folder import ROWS, TABLE, Folder
from maniple.cli.sweep.rows import columns
from maniple.recording.reader import read
from tests.cli.sweep.files import GRID, begin, rows_of, write_sweep
from tests.waiting import children_of, eventually, runs

MANY = GRID.replace("duration_s = 4", "duration_s = 8")


def finished(file: Path, out: Path, *options: object) -> Any:
    """The sweep's outcome."""
    with begin(file, out, "--json", *options) as process:
        said, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return json.loads(said)


def lines(out: Path) -> int:
    """Rows that are on disk."""
    return len((out / ROWS).read_bytes().splitlines()) - 1 if (out / ROWS).exists() else 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of an undisturbed sweep in one process."""
    folder = tmp_path_factory.mktemp("whole")
    outcome = finished(write_sweep(folder, MANY), folder / "out", "--jobs", 1)
    assert (outcome["runs"], outcome["made"], outcome["kept"], outcome["failed"]) == (8, 8, 0, 0)
    assert outcome["table"] == str(folder / "out" / TABLE)
    return folder / "out"


def test_a_row_is_what_the_same_run_alone_amounts_to(whole: Path, tmp_path: Path) -> None:
    scene = write_sweep(tmp_path, MANY).with_name("small.toml")
    rows = rows_of(whole)
    assert [(row["placement.robot_from"], row["loss"], row["seed"]) for row in rows] == [
        (layer, loss, seed) for layer in ("drive", "kinematics") for loss in (0.0, 0.4) for seed in (5, 3)
    ]
    for index in (1, 6):
        row, log = rows[index], tmp_path / f"{index}.mcap"
        result = maniple.run(
            scene, virtual=True, duration_s=8, seed=row["seed"], overrides=row["overrides"], log=log
        )
        table = msgspec.to_builtins(result)
        assert result.messages.lost_injected > 0 or row["loss"] == 0.0
        for column in columns():
            if column.path:
                value: Any = table
                for key in column.path:
                    value = value[key]
                assert row[column.name] == value, column.name
        assert 0.0 < row["task_share"] < 1.0
        assert row["mean_rate"] == pytest.approx(row["task_share"] * 20.0 / 8.0, abs=0.05)
        assert row["error"] is None


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_where_it_was(whole: Path, tmp_path: Path) -> None:
    """The same bytes as undisturbed in one process: neither the order nor the number of jobs matters."""
    file, out = write_sweep(tmp_path, MANY), tmp_path / "out"
    process = begin(file, out, "--jobs", 2)
    eventually(lambda: lines(out) >= 3)
    workers = children_of(process.pid)
    process.kill()
    process.communicate()
    eventually(lambda: not any(map(runs, workers)))
    assert not (out / TABLE).exists()
    before = lines(out)
    with (out / ROWS).open("ab") as rows:
        rows.write(b'{"id":"torn')
    outcome = finished(file, out, "--jobs", 2)
    assert (outcome["made"], outcome["kept"]) == (8 - before, before)
    assert (out / TABLE).read_bytes() == (whole / TABLE).read_bytes()
    assert (out / "errors.png").read_bytes() == (whole / "errors.png").read_bytes()


@pytest.mark.slow
def test_interrupted_it_says_so_and_goes_on(whole: Path, tmp_path: Path) -> None:
    file, out = write_sweep(tmp_path, MANY), tmp_path / "out"
    process = begin(file, out, "--jobs", 2)
    eventually(lambda: lines(out) >= 1)
    process.send_signal(signal.SIGINT)
    said, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err == ""
    assert "interrupted; the same command goes on from here" in said
    assert 1 <= lines(out) < 8
    finished(file, out)
    assert (out / TABLE).read_bytes() == (whole / TABLE).read_bytes()


@pytest.mark.slow
def test_more_seeds_need_only_the_new_runs(whole: Path, tmp_path: Path) -> None:
    file, out = write_sweep(tmp_path), tmp_path / "out"
    finished(file, out)
    assert lines(out) == 8
    outcome = finished(write_sweep(tmp_path, GRID.replace("[5, 3]", "[3, 5, 7]")), out)
    assert (outcome["runs"], outcome["made"], outcome["kept"]) == (12, 4, 8)
    assert [row["seed"] for row in rows_of(out)][:3] == [3, 5, 7]
    outcome = finished(file, out, "--fresh")
    assert (outcome["made"], lines(out)) == (12, 12)


def test_the_table_says_what_it_is(whole: Path) -> None:
    schema = pq.read_schema(whole / TABLE)
    assert schema.metadata[b"maniple"].decode() == maniple.__version__
    assert schema.metadata[b"sweep"].decode() == MANY
    kinds = {name: str(schema.field(name).type) for name in schema.names}
    assert (kinds["placement.robot_from"], kinds["loss"], kinds["seed"]) == ("string", "double", "int64")
    assert (kinds["completed"], kinds["collisions"]) == ("bool", "int64")
    assert kinds["tolerated_delay_s"] == "double"
    assert not any(math.isnan(row["tolerated_delay_s"]) for row in rows_of(whole))


def test_the_reference_names_every_column(whole: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "sweep.md").read_text()
    for name in pq.read_schema(whole / TABLE).names[2:]:
        assert f"`{name}`" in text, name


@pytest.mark.slow
def test_recordings_are_kept_if_asked_for(tmp_path: Path) -> None:
    text = (
        GRID.replace("[5, 3]", "1").replace("[0.0, 0.4]", "[0.4]").replace("duration_s = 4", "duration_s = 1")
    )
    file, out = write_sweep(tmp_path, text), tmp_path / "out"
    finished(file, out)
    outcome = finished(file, out, "--keep-logs")
    assert outcome["made"] == 2
    logs = sorted((out / "logs").iterdir())
    assert len(logs) == 2
    assert {read(log).scenario.placement.robot_from for log in logs} == {"drive", "kinematics"}


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """`maniple sweep` in this process: status, standard output, standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["maniple", "sweep", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            program.main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *capsys.readouterr()

    return call


@pytest.fixture
def refused(command: Command) -> Callable[..., str]:
    """What standard error says of bad input: one message and status 2."""

    def call(*arguments: object) -> str:
        status, said, err = command(*arguments)
        assert (status, said) == (2, "")
        assert err.startswith("error: ")
        return err

    return call


def test_other_folders_are_left_alone(tmp_path: Path, refused: Callable[..., str]) -> None:
    file, other = write_sweep(tmp_path), tmp_path / "other"
    other.mkdir()
    (other / "precious").write_text("x")
    assert "is not empty and holds no sweep" in refused(file, "--out", other)
    assert [path.name for path in other.iterdir()] == ["precious"]
    assert "is not a folder" in refused(file, "--out", other / "precious")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / ROWS).write_text('{"sweep":"another","version":"0","code":"0"}\n')
    assert "holds the sweep 'another'" in refused(file, "--out", mine)
    (mine / ROWS).write_text("what is this\n")
    assert "not rows of a sweep" in refused(file, "--out", mine)


def test_nothing_runs_where_a_combination_is_bad(tmp_path: Path, refused: Callable[..., str]) -> None:
    file = write_sweep(tmp_path, GRID.replace("[0.0, 0.4]", "[0.0, 4]"))
    message = refused(file, "--out", tmp_path / "out")
    assert "2 of 4 combinations can't run" in message
    assert "faults[0].loss = 4" in message
    assert not (tmp_path / "out").exists()


def test_two_sweeps_do_not_write_to_one_folder(tmp_path: Path, refused: Callable[..., str]) -> None:
    with Folder(tmp_path / "out", "small-sweep"):
        assert "another sweep is writing there" in refused(write_sweep(tmp_path), "--out", tmp_path / "out")


def test_check_runs_nothing(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    status, said, err = command(write_sweep(tmp_path), "--check", "--json")
    assert (status, err) == (0, "")
    assert json.loads(said) == {"sweep": "small-sweep", "runs": 8}
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("lacking", ["pyarrow", "matplotlib"])
def test_what_is_not_installed_is_said_before_anything_runs(
    tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, lacking: str
) -> None:
    monkeypatch.setitem(sys.modules, lacking, None)
    assert "pip install 'maniple[sweep]'" in refused(write_sweep(tmp_path), "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
