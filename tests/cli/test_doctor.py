"""What `maniple doctor` finds."""

import json
import socket
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from maniple.cli import doctor
from maniple.cli.doctor import Check, Requirement, requirement_of
from maniple.cli.program import app


def test_this_machine_can_run_a_platoon() -> None:
    """It is running the tests."""
    result = CliRunner().invoke(app, ["doctor", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["ok"] is True
    checks = {check["name"]: check for check in found["checks"]}
    assert {"python", "eclipse-zenoh", "numpy", "cores", "zenoh round trip", "timer lateness", "disk"} <= set(
        checks
    )
    assert "hypothesis" not in checks
    assert "ms median" in checks["zenoh round trip"]["found"]


def test_what_is_missing_is_told_and_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = Check("numpy", "missing", "absent", "needs [1.26] or newer")
    monkeypatch.setattr(doctor, "checks", lambda: iter([Check("python", "ok", "3.12"), bad]))
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "needs [1.26] or newer" in result.stdout
    assert "can't run a platoon" in result.stdout


def test_an_old_python() -> None:
    assert doctor.python((3, 10, 9)).state == "missing"
    assert doctor.python((3, 11, 0)).state == "ok"
    assert doctor.python((4, 0, 0)).state == "ok"


@pytest.mark.parametrize(
    ("line", "requirement"),
    [
        ("eclipse-zenoh<2,>=1.10", Requirement("eclipse-zenoh", "1.10", "")),
        ("rich >= 13", Requirement("rich", "13", "")),
        ("numpy", Requirement("numpy", "0", "")),
        ("scipy>=1.11; extra == 'planning'", Requirement("scipy", "1.11", "planning")),
        ('mypy>=1.13; extra == "dev"', None),
        ("maniple[report]; extra == 'all'", None),
    ],
)
def test_requirements(line: str, requirement: Requirement | None) -> None:
    assert requirement_of(line) == requirement


def test_packages_are_there_and_new_enough() -> None:
    there = {"a": "1.10.2", "b": "1.9", "c": "2.0rc1"}
    asked = [
        Requirement(name, "1.10", extra) for name, extra in zip("abcde", ("", "", "", "", "x"), strict=True)
    ]
    found = list(doctor.packages(asked, there.get))
    assert [check.state for check in found] == ["ok", "missing", "ok", "missing", "poor"]
    assert found[3].advice == "needs 1.10 or newer: pip install 'd>=1.10'"
    assert found[4].advice == "for x: pip install 'maniple[x]'"
    assert doctor.requirements("no-such-distribution") == []


def test_what_several_parts_need_is_told_once() -> None:
    asked = [Requirement("a", "1", "x"), Requirement("a", "1", "y"), Requirement("b", "1", "x")]
    assert [check.name for check in doctor.packages(asked, {"a": "1", "b": "1"}.get)] == ["a", "b"]


def test_a_port_that_is_taken_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        number = taken.getsockname()[1]
        assert doctor.port(number).state == "poor"
    assert doctor.port(number).state == "ok"


def test_few_cores_no_proc(tmp_path: Path) -> None:
    assert [doctor.cores(count).state for count in (1, 2)] == ["poor", "ok"]
    assert doctor.proc(tmp_path / "stat").state == "poor"


def test_a_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.disk(tmp_path / "logs" / "deep").found.endswith(f"free in {tmp_path}")
    monkeypatch.setattr(doctor, "LEAST_FREE_GB", 1e9)
    assert doctor.disk(tmp_path).state == "poor"
    monkeypatch.setattr("os.access", lambda *_: False)
    assert doctor.disk(tmp_path).state == "missing"


def test_a_network_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_round_trips", lambda rounds: [])
    assert doctor.round_trip().found == "no answer"
    monkeypatch.setattr(doctor, "_round_trips", lambda rounds: [0.1] * 90 + [50.0] * 10)
    assert doctor.round_trip().state == "poor"

    def fail(rounds: int) -> list[float]:
        raise OSError("no loopback")

    monkeypatch.setattr(doctor, "_round_trips", fail)
    assert doctor.round_trip() == Check(
        "zenoh round trip", "missing", "no loopback", "processes on this machine can't talk"
    )
    assert threading.active_count() < 50
