import os
import signal
from pathlib import Path

import maniple
from maniple.cli.loading import load
from maniple.cli.sweep.rows import columns, figures
from maniple.cli.sweep.workers import Task, Worker, perform, rows
from maniple.core.scenario.parse import to_json
from maniple.recording.reader import read
from tests.cli.scenes import write
from tests.waiting import runs


def task(tmp_path: Path, name: str = "good", log: Path | None = None) -> Task:
    return Task(name, to_json(load(write(tmp_path))), 2.0, log)


def test_a_run_that_raises_is_a_row(tmp_path: Path) -> None:
    bad = Task("bad", b"{}", 2.0, None)
    found = {row.id: row for row in rows([bad, task(tmp_path)], 2, lambda: False)}
    assert found["bad"].error is not None
    assert found["bad"].error.startswith("ScenarioError: name: missing")
    assert found["bad"].figures == {}
    assert found["good"].error is None
    assert list(found["good"].figures) == [column.name for column in columns()]


def test_a_process_that_is_killed_is_a_row(tmp_path: Path) -> None:
    worker = Worker()
    pid = worker._process.pid
    assert pid is not None
    worker.give(task(tmp_path)._replace(duration_s=1e6))
    os.kill(pid, signal.SIGKILL)
    row = worker.take()
    worker.close()
    assert row is not None
    assert (row.id, row.error) == ("good", "its process died (SIGKILL)")
    assert worker.dead


def test_asked_to_stop_it_stops_in_the_middle_of_a_run(tmp_path: Path) -> None:
    asked = iter([False])
    endless = task(tmp_path)._replace(duration_s=1e6)
    assert list(rows([endless], 1, lambda: next(asked, True))) == []


def test_a_worker_that_is_closed_is_gone(tmp_path: Path) -> None:
    worker = Worker()
    worker.give(task(tmp_path)._replace(duration_s=1e6))
    worker.close()
    assert worker._process.pid is not None
    assert not runs(worker._process.pid)


def test_a_recording_is_kept_where_it_is_asked_for(tmp_path: Path) -> None:
    log = tmp_path / "kept.mcap"
    log.with_suffix(".part").write_text("of a killed run")
    assert perform(task(tmp_path, log=log)) == perform(task(tmp_path))
    assert read(log).complete
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.mcap", "small.toml"]


def test_figures_are_those_of_the_result(tmp_path: Path) -> None:
    result = maniple.run(write(tmp_path), virtual=True, log=tmp_path / "a.mcap", duration_s=2)
    found = figures(result, None)
    assert found["final_error_distance_m"] == result.final_error.distance_m
    assert found["messages_sent"] == result.messages.sent
    assert found["command_age_ms_p99"] == result.command_age_ms.p99
    assert (found["task_share"], found["mean_rate"]) == (0.0, 0.0)
